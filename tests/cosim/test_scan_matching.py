"""Localisation against a point-cloud map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.registry import find_entry
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.follower_client import sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.stack import REFERENCE_RIG, Stack, StackConfig, sensor_of, vehicle_of
from cavmarl.cosim.stack.stack_types import Mission
from cavmarl.maps.buildings import with_buildings
from cavmarl.maps.fidelity.cloud_files import Cloud, write_cloud
from cavmarl.maps.fidelity.map_surface import map_surface

pytest.importorskip("small_gicp", reason="needs the extra 'clouds'")

BIASED = {name: dict(keys) for name, keys in REFERENCE_RIG.items() if name != "markings"}
BIASED["gnss"]["bias"] = [2.0, 2.0, 0.0]


@pytest.fixture(scope="module")
def world() -> Any:
    overrides = {
        "rig": BIASED,
        "clock.ctrl_dt_s": 0.05,
        "map.buildings": "map/buildings.poly.xml",
    }
    return cavmarl.parallel_env("grid4x4", agents=2, background=0, overrides=overrides)


@pytest.fixture(scope="module")
def cloud(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map's own surface, as a cloud."""
    path = tmp_path_factory.mktemp("cloud") / "grid.ply"
    network = with_buildings(world.network, find_entry("grid4x4") / "map" / "buildings.poly.xml")
    surface, _ = map_surface(network, network.extent_m, 0.4)
    noise = np.random.default_rng(0).normal(0.0, 0.03, surface.points.shape)
    write_cloud(path, Cloud("grid", surface.points + noise))
    return path


@pytest.mark.slow
def test_scans_take_a_bias_of_gnss_away(world: Any, cloud: Path) -> None:
    from cavmarl.cosim.stack.scan_matching import ScanMatching

    world.reset(seed=3)
    sensors = [sensor_of(v.name, v.settings) for v in welcome_to(world, ["car_0"], 0).sensors]
    vehicle = vehicle_of(HdMap(world.network), sensors, 0.05, cloud)
    assert vehicle.geodesy is not None
    kept = (sensors, vehicle.geodesy, vehicle.hd_map, 0.05)
    before, after = GnssInertial(*kept), ScanMatching(*kept, cloud)
    off: dict[str, list[float]] = {"before": [], "after": []}
    for step in range(200):
        tick = int(world.worlds.ticks()[0])
        sight = sight_of(*take_snapshot(world, [0], SnapshotTime(step, 0, tick, False)))
        view = sight.snapshot.vehicles["car_0"]
        mission = Mission(0, view.vclass, view.length_m, view.width_m)
        rows = world.simulation.vehicles()
        row = rows[rows["agent"] == 0][0]
        for name, stage in (("before", before), ("after", after)):
            pose = stage.locate(sight.sensors["car_0"], mission, sight.snapshot.time_s)
            assert pose is not None
            off[name].append(math.hypot(pose.x_m - row["x"], pose.y_m - row["y"]))
        world.step(world.suggest_actions())
    assert after.matched > 50
    assert np.mean(off["before"][100:]) > 1.0
    assert np.mean(off["after"][100:]) < 0.8
    assert np.mean(off["after"][100:]) < 0.6 * np.mean(off["before"][100:])


def test_what_is_missing_is_said(world: Any, cloud: Path, tmp_path: Path) -> None:
    hd_map = HdMap(world.network)
    sensors = [sensor_of(v.name, v.settings) for v in welcome_to(world, ["car_0"], 0).sensors]

    def stack(chosen: Any, path: Path | None) -> Stack:
        return Stack(vehicle_of(hd_map, chosen, 0.05, path), StackConfig(**MATCHING))

    with pytest.raises(ConfigError, match="needs a point-cloud map"):
        stack(sensors, None)
    with pytest.raises(ConfigError, match="no lidar among the sensors"):
        stack([one for one in sensors if one.type != "lidar"], cloud)
    flat = tmp_path / "flat.csv"
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    ground = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    write_cloud(flat, Cloud("flat", ground))
    with pytest.raises(ConfigError, match="has no walls"):
        stack(sensors, flat)
    assert stack(sensors, cloud).pose is None


MATCHING = {"localisation": "scan_matching"}
