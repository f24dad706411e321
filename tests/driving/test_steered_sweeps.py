"""Areas that steered cars (agents) sweep in bends, and drivers that wait before these areas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, HOLD_NONE, HOLD_SIGNAL
from cavmarl.core.records.rows import STEERED
from cavmarl.driving.kernels.junctions.approach import APPROACH
from cavmarl.driving.kernels.junctions.swept_areas import MOST_BACK_M, room_m, stop_before_foe_sweep
from cavmarl.driving.kernels.lanes.adjacent_leaders import behind_askew
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.models.following import no_constraint
from cavmarl.driving.steered_sweeps import load_steered, with_steered_sweeps
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.junction_scenes import build_crossing
from tests.support.traffic import network as network_of
from tests.support.traffic import on_lane, scratch, travel

CAR = 0


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_crossing(tmp_path_factory.mktemp("crossing"), "traffic_light", side_lanes=2)


@pytest.fixture(scope="module")
def network(path: Path) -> RoadNetwork:
    return load_steered(path)


def rows_of(network: RoadNetwork, link: int) -> np.ndarray:
    row = network.links[link]
    return network.sweeps[row["first_sweep"] :][: row["num_sweeps"]]


def test_rows_of_steered_cars_are_added_behind_unchanged_rows_of_background_vehicles(
    path: Path, network: RoadNetwork
) -> None:
    plain = read_network(path)
    for link in range(len(plain.links)):
        found, before = rows_of(network, link), rows_of(plain, link)
        assert found[: len(before)].tobytes() == before.tobytes()
        assert (found["own"][len(before) :] == STEERED).all()
    assert len(network.sweeps) > len(plain.sweeps)
    for name in ("swept_m", "fork_m", "num_conflicts", "wait_m"):
        np.testing.assert_array_equal(network.links[name], plain.links[name])
    again = load_steered(path)  # the second call reads the cache
    assert again.sweeps.tobytes() == network.sweeps.tobytes()


def test_each_area_of_two_steered_cars_has_a_row_on_both_links(network: RoadNetwork) -> None:
    own = np.repeat(np.arange(len(network.links)), network.links["num_sweeps"])
    rows = {
        (int(link), *(row[name].item() for name in network.sweeps.dtype.names or ()))
        for link, row in zip(own, network.sweeps, strict=True)
        if row["own"] == row["other"] == STEERED
    }
    assert len(rows) > 3
    for link, foe, size, other, enter, leave, foe_enter, foe_leave in rows:
        assert (foe, link, other, size, foe_enter, foe_leave, enter, leave) in rows


@pytest.mark.parametrize("agents", [0, 1])
def test_only_maps_of_worlds_with_agents_have_rows_of_steered_cars(path: Path, agents: int) -> None:
    roads = load_world(str(path), agents=agents, background=4).network
    assert (roads.sweeps["own"] == STEERED).any() == (agents > 0)


def side_by_side(network: RoadNetwork) -> tuple[int, np.void]:
    """Return a link and its row of SWEEP for an area in which only steered cars would touch."""
    for link in range(len(network.links)):
        rows = rows_of(network, link)
        cars = set(rows["foe"][(rows["own"] == CAR) & (rows["other"] == CAR)])
        for row in rows[(rows["own"] == STEERED) & (rows["other"] == STEERED)]:
            if row["foe"] not in cars and row["enter_m"] > 1.0:
                return link, row
    raise AssertionError("no steered cars would touch")


@pytest.mark.parametrize(
    ("asks", "other", "waits"),
    [
        (DRIVER_AGENT, DRIVER_AGENT, True),
        (DRIVER_BACKGROUND, DRIVER_AGENT, False),
        (DRIVER_BACKGROUND, DRIVER_BACKGROUND, False),
    ],
)
def test_the_built_in_driver_of_an_agent_waits_before_an_area_occupied_by_an_agent(
    network: RoadNetwork, asks: int, other: int, waits: bool
) -> None:
    link, sweep = side_by_side(network)
    foe = int(sweep["foe"])
    lanes = [int(network.links[k]["from_lane"]) for k in (link, foe)]
    rows = np.concatenate(
        [on_lane(network, lane, 30.0, id=k, hold=HOLD_NONE, speed=3.0)
         for k, lane in enumerate(lanes)]
    )  # fmt: skip
    rows["driver"] = asks, other
    room = scratch(network, 2)
    room.approach[0] = np.zeros(1, APPROACH)[0]
    entry = room.approach[0]
    entry["link"], entry["row"], entry["id"], entry["half"] = foe, 1, 1, 2.5
    entry["dist"], entry["speed"] = 2.5 - (float(sweep["foe_enter_m"]) + 0.5), 3.0
    room.link_end[foe] = 1
    place = float(sweep["enter_m"]) - 2.0
    stop = stop_before_foe_sweep(network.arrays, rows, 0, link, place, -np.inf, room)
    assert stop == (sweep["enter_m"] if waits else np.inf)


@pytest.mark.parametrize(("driver", "back"), [(DRIVER_AGENT, True), (DRIVER_BACKGROUND, False)])
def test_a_steered_car_with_red_waits_further_before_a_line_that_foes_sweep_over(
    network: RoadNetwork, driver: int, back: bool
) -> None:
    own = np.repeat(np.arange(len(network.links)), network.links["num_sweeps"])
    over = (network.sweeps["own"] == STEERED) & (network.sweeps["enter_m"] < -0.5)
    over &= network.sweeps["enter_m"] > -MOST_BACK_M
    link = int(own[over][0])
    row = on_lane(network, int(network.links["from_lane"][link]), 30.0)
    row["driver"] = driver
    room = scratch(network, 1)
    held, goes = room_m(HOLD_SIGNAL, HOLD_NONE), room_m(HOLD_NONE, HOLD_NONE)
    stop = stop_before_foe_sweep(network.arrays, row, 0, link, -12.0, held, room)
    rows = rows_of(network, link)
    before = rows["enter_m"][(rows["own"] == STEERED) & (rows["enter_m"] > -MOST_BACK_M)]
    assert stop == (before.min() if back else np.inf)
    assert stop_before_foe_sweep(network.arrays, row, 0, link, -12.0, goes, room) == np.inf


@pytest.mark.parametrize(
    ("askew", "driver", "minds"),
    [(0.6, DRIVER_AGENT, True), (0.0, DRIVER_AGENT, False), (0.6, DRIVER_BACKGROUND, False)],
)
def test_a_slow_car_askew_on_an_adjacent_lane_is_a_leader(
    askew: float, driver: int, minds: bool
) -> None:
    roads, tables = network_of("merge"), travel("merge")
    lane = next(k for k, row in enumerate(roads.lanes) if row["left"] >= 0)
    left = int(roads.lanes["left"][lane])
    rows = np.concatenate(
        [on_lane(roads, lane, 20.0, tables, id=0, speed=10.0),
         on_lane(roads, left, 45.0, tables, id=1)]
    )  # fmt: skip
    rows["driver"] = DRIVER_AGENT, driver
    rows["heading"][1] += askew
    room = scratch(roads, 2)
    index_lanes(roads.arrays, tables, rows, 2, room)
    kind = generated_types()[0]
    found = behind_askew(roads.arrays, tables, rows, kind, rows[0], lane, 20.0, room)
    assert (found > no_constraint(kind)) == minds


def test_a_map_without_junctions_has_no_swept_areas() -> None:
    assert len(with_steered_sweeps(network_of("ring")).sweeps) == 0


def stop_for_a_fast_foe(
    network: RoadNetwork, link: int, sweep: np.void, place: float, front_m: float, speed: float
) -> float:
    """Return where a car at `place` of a link stops for a foe whose front is before its line."""
    lanes = [int(network.links[k]["from_lane"]) for k in (link, int(sweep["foe"]))]
    rows = np.concatenate([on_lane(network, lane, 30.0, id=k) for k, lane in enumerate(lanes)])
    rows["driver"], rows["hold"] = DRIVER_AGENT, HOLD_NONE
    rows["speed"] = 2.0, speed
    room = scratch(network, 2)
    entry = room.approach[0]
    entry["link"], entry["row"], entry["id"], entry["half"] = sweep["foe"], 1, -1, 2.5
    entry["dist"], entry["speed"] = front_m + 2.5, speed
    room.link_end[sweep["foe"]] = 1
    return stop_before_foe_sweep(network.arrays, rows, 0, link, place, -np.inf, room)


@pytest.mark.parametrize(("beyond_m", "goes_on"), [(0.5, True), (-0.5, False)])
def test_a_car_in_the_path_of_a_fast_foe_does_not_stop_for_it(
    network: RoadNetwork, beyond_m: float, goes_on: bool
) -> None:
    # The car has the right of way, so the fast foe has to brake in any case.
    found = None
    for link, row in enumerate(network.links):
        own = network.conflicts[row["first_conflict"] :][: row["num_conflicts"]]
        for sweep in rows_of(network, link):
            for conflict in own[(own["foe"] == sweep["foe"]) & ~own["must_yield"]]:
                foe = network.links[sweep["foe"]]
                theirs = network.conflicts[foe["first_conflict"] :][: foe["num_conflicts"]]
                yields = theirs["must_yield"][theirs["foe"] == link].any()
                steered = sweep["own"] == sweep["other"] == STEERED
                if yields and steered and 0.0 < conflict["enter_m"] + 1.0 < sweep["enter_m"]:
                    found = link, sweep, conflict
    assert found is not None, "no pair of links has a swept area beyond the shared area"
    link, sweep, conflict = found
    place = float(conflict["enter_m"]) + beyond_m
    stop = stop_for_a_fast_foe(network, link, sweep, place, front_m=20.0, speed=15.0)
    assert (stop == np.inf) == goes_on


@pytest.mark.parametrize(("place", "goes_on"), [(1.0, True), (-1.0, False)])
def test_a_yielding_car_does_not_stop_in_the_path_of_a_fast_foe(
    network: RoadNetwork, place: float, goes_on: bool
) -> None:
    # The car turns before a foe with the right of way. If it stopped, it would block the foe.
    found = None
    for link, row in enumerate(network.links):
        own = network.conflicts[row["first_conflict"] :][: row["num_conflicts"]]
        for sweep in rows_of(network, link):
            for conflict in own[(own["foe"] == sweep["foe"]) & own["must_yield"]]:
                steered = sweep["own"] == sweep["other"] == STEERED
                over = conflict["enter_m"] < sweep["enter_m"] < conflict["leave_m"] + 5.0
                if steered and over and sweep["enter_m"] > 5.0:
                    found = link, sweep
    assert found is not None, "no pair of links has a swept area in the middle of the yielding link"
    link, sweep = found
    stop = stop_for_a_fast_foe(network, link, sweep, place, front_m=60.0, speed=25.0)
    assert (stop == np.inf) == goes_on
