"""A substitute for Autoware drives with only the topics and the map folder of Autoware."""

from __future__ import annotations

import lzma
import os
from pathlib import Path

import numpy as np
import pytest

from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import MapError
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network

pytest.importorskip("rosbags", reason="needs the extra 'ros2'")
pytest.importorskip("cyclonedds", reason="needs the extra 'ros2'")

from benchmarks.map_driver import MapDriver, Seen
from benchmarks.ros2_driving import drive_by_topics
from benchmarks.vector_map import MapLanelet, VectorMap
from cavmarl.cosim.stack.stack_types import EgoPose
from cavmarl.maps.exports.lanelet import FIRST_LIGHT, write_map_folder

DOMAIN = 10 + os.getpid() % 80
EXPORTED = Path(__file__).parent / "data" / "grid4x4.osm.xz"
RED, GREEN = frozenset({1}), frozenset({3})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a stored map folder that `cavmarl map export grid4x4 --autoware` has written."""
    place = tmp_path_factory.mktemp("map")
    (place / "lanelet2_map.osm").write_bytes(lzma.decompress(EXPORTED.read_bytes()))
    (place / "map_projector_info.yaml").write_text("projector_type: Local\n")
    return place


@pytest.fixture(scope="module")
def grid(folder: Path) -> VectorMap:
    return VectorMap(folder)


def test_the_stored_map_folder_equals_a_new_export(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("lanelet2", reason="needs the extra 'lanelet2'")
    write_map_folder(load_network(find_map("grid4x4")), tmp_path)
    for name in ("lanelet2_map.osm", "map_projector_info.yaml"):
        assert (tmp_path / name).read_text() == (folder / name).read_text()


def test_all_roads_of_the_map_are_connected(grid: VectorMap) -> None:
    network = load_network(find_map("grid4x4"))
    assert len(grid.lanelets) == len(network.lanes)
    assert sum(len(one.after) for one in grid.lanelets) == 576
    lights = sorted(light for one in grid.lanelets for light in one.lights)
    assert lights == [FIRST_LIGHT + link for link in range(len(network.links))]
    # the goal can be reached from all roads except those that lead out of the grid
    leaving = [one for one in grid.lanelets if not one.after]
    assert len(leaving) == 32
    goal = next(one for one in leaving if one.centre[-1][0] > 599.0)
    costs = grid.costs_to(goal.centre[-1], 0.0)
    unreached = {one.id for one in grid.lanelets} - costs.keys()
    assert {one.id for one in leaving} - unreached == {goal.id, *(one.id for one in goal.beside)}
    assert all(one.is_turn or not one.after for one in grid.lanelets if one.id in unreached)


def ahead_of_light(grid: VectorMap) -> tuple[MapDriver, EgoPose, MapLanelet]:
    """Return a driver, its pose 16 m before a light at 8 m/s, and the lanelet behind the light."""
    turn = next(
        one
        for one in grid.lanelets
        if one.lights and not one.yields_to and one.length_m > 15.0 and not one.after[0].is_turn
    )
    before = turn.before[0]
    driver = MapDriver(grid, 0.1)
    goal = turn.after[0]
    end = goal.centre[-1] - goal.centre[-2]
    driver.begin(goal.centre[-1], float(np.arctan2(end[1], end[0])))
    s = before.length_m - 16.0
    x, y = (float(np.interp(s, before.along_m, axis)) for axis in before.centre.T)
    heading = before.project(np.array([x, y]))[2]
    return driver, EgoPose(x, y, heading, 8.0), turn


def test_the_driver_stops_at_red_and_goes_at_green(grid: VectorMap) -> None:
    driver, pose, turn = ahead_of_light(grid)
    (light,) = turn.lights
    accel, _ = driver.drive(pose, [], {light: RED})
    assert driver.reason == "light"
    assert accel < 0.0
    accel, steering = driver.drive(pose, [], {light: GREEN})
    assert accel > 0.3
    assert abs(steering) < 0.05
    # the driver treats a light without a message as red
    assert driver.drive(pose, [], {})[0] < 0.0


def test_the_driver_brakes_for_a_vehicle_ahead_and_not_for_one_beside(grid: VectorMap) -> None:
    driver, pose, turn = ahead_of_light(grid)
    lights = {turn.lights[0]: GREEN}
    ahead = np.array([np.cos(pose.heading_rad), np.sin(pose.heading_rad)])
    front = Seen(np.array([pose.x_m, pose.y_m]) + 14.0 * ahead, pose.heading_rad, 2.0, 5.0, 2.0)
    accel, _ = driver.drive(pose, [front], lights)
    assert driver.reason == "gap"
    assert accel < -2.0
    left = np.array([-ahead[1], ahead[0]])
    beside = front._replace(place=front.place + 3.2 * left)
    driver.drive(pose, [beside], lights)
    assert driver.reason != "gap"


def test_a_map_with_another_projector_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "map_projector_info.yaml").write_text("projector_type: MGRS\n")
    with pytest.raises(MapError, match="must be of type Local"):
        VectorMap(tmp_path)


@pytest.mark.integration
def test_the_substitute_arrives_without_an_incident(folder: Path) -> None:
    spec = WorldSpec.of("grid4x4", background=16, seed=4, overrides={"traffic.max_trip_m": 300})
    found = drive_by_topics(spec, folder, episodes=1, step_s=0.1, domain=DOMAIN)
    (row,) = found["rows"]
    assert (row["outcome"], row["events"]) == ("arrived", "1 arrived")
    assert row["distance_m"] > 150.0
    controls = found["controls"]
    assert controls["used"] == row["steps"]
    assert controls["late"] == controls["held"] == controls["invalid"] == 0
    assert found["reasons"]["light"] > 0
    assert sum(found["reasons"].values()) == row["steps"]
