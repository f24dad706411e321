"""Rows that mirror SUMO's vehicles, compared with a slow, plain version for random positions."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.codes import DRIVER_BACKGROUND, DRIVER_SUMO, EVENT_ARRIVED
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.shards.shard import make_zone_state
from cavmarl.traffic.demand import STOP
from cavmarl.traffic.kernels.mirroring import Paths, list_others, mirror
from cavmarl.traffic.scenarios.movement_scripts import NO_SCRIPTS
from cavmarl.traffic.sumo.sumo_history import SEEN
from tests.naive import mirroring as naive

LENGTH_M = 7.0
DT = 0.1


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_world("grid4x4").network


def fronts(network: RoadNetwork, number: int) -> np.ndarray:
    """Return SEEN (number,) with random front bumpers on lanes, many near the start of a lane."""
    random = np.random.default_rng(3)
    seen = np.zeros(number, dtype=SEEN)
    seen["number"] = np.sort(random.permutation(10 * number)[:number])
    seen["lane"] = random.integers(len(network.lanes), size=number)
    edges = network.edges["length_m"][network.lanes["edge"][seen["lane"]]]
    seen["pos"] = edges * random.random(number) ** 3
    seen["x"], seen["y"], seen["z"] = random.normal(0.0, 100.0, (3, number))
    seen["angle"] = random.uniform(0.0, 360.0, number)
    seen["speed"] = random.uniform(0.0, 20.0, number)
    seen["lat"] = random.normal(0.0, 0.3, number)
    seen["signals"] = random.integers(4, size=number)
    return seen


def nowhere(network: RoadNetwork) -> tuple[TripTables, Paths]:
    """Return tables of routes that lead nowhere, and one path of one edge."""
    steps = np.zeros(2 * len(network.lanes), dtype=PLAN)
    steps["next"] = -1
    stops = np.zeros(0, dtype=STOP)
    travel = TripTables(
        generated_types(),
        steps,
        stops,
        0,
        0.0,
        100.0,
        100.0,
        len(steps),
        NO_SCRIPTS,
        np.zeros(1, dtype=np.int64),
    )
    first = np.array([0, 1], dtype=np.int64)
    return travel, Paths(first, np.array([-1], dtype=np.int32), np.zeros(1, dtype=np.int64), 0)


def test_positions_of_mirrored_rows_equal_those_of_the_plain_version(network: RoadNetwork) -> None:
    seen = fronts(network, 200)
    zoned = make_zone_state(2, 1, 300)
    travel, paths = nowhere(network)
    for n, number in enumerate(seen["number"]):
        zone = n % 2
        zoned.rows[0, zone, 0, zoned.num_owned[zone, 0]] = blank_vehicle()[0]
        row = zoned.rows[0, zone, 0, zoned.num_owned[zone, 0]]
        row["driver"], row["order"], row["id"] = DRIVER_SUMO, number, n
        row["length"], row["speed"], row["link"] = LENGTH_M, 3.0, came_by(network, seen[n])
        zoned.num_owned[zone, 0] += 1
    before = zoned.rows.copy()
    gone = mirror(network.arrays, travel, paths, seen[:-10], zoned, 0, 0, DT)
    assert gone == 10
    elsewhere = 0
    for zone in range(2):
        for old, row in zip(
            before[0, zone, 0, : zoned.num_owned[zone, 0]], zoned.rows[0, zone, 0], strict=False
        ):
            (place,) = np.flatnonzero(seen["number"] == row["order"])
            if place >= len(seen) - 10:
                assert row["events"] == EVENT_ARRIVED
                assert row["x"] == old["x"]
                continue
            one = seen[place]
            assert (row["x"], row["y"], row["heading"]) == pytest.approx(
                naive.centre(one, LENGTH_M), abs=1e-9
            )
            lane, s, d = naive.place(network, one, LENGTH_M, int(old["link"]))
            assert row["lane"] == lane
            assert (row["s"], row["d"]) == pytest.approx((s, d), abs=1e-9)
            assert row["speed"] == one["speed"]
            assert row["accel"] == pytest.approx((one["speed"] - 3.0) / DT)
            assert row["blinker"] == (1 if one["signals"] & 2 else -int(one["signals"] & 1))
            assert row["tick"] == old["tick"] + 1
            elsewhere += lane != one["lane"]
    assert elsewhere > 20


def came_by(network: RoadNetwork, seen: np.void) -> int:
    """Return a link that leads to the lane of the vehicle's front, or -1."""
    found = np.flatnonzero(network.links["to_lane"] == seen["lane"])
    return int(found[0]) if len(found) else -1


def test_vehicles_that_sumo_does_not_move_are_listed(network: RoadNetwork) -> None:
    zoned = make_zone_state(3, 2, 10)
    for zone in range(3):
        for n in range(zone + 2):
            row = zoned.rows[0, zone, 1, n]
            row["id"] = 10 * zone + n
            row["driver"] = DRIVER_SUMO if n == 0 else DRIVER_BACKGROUND
        zoned.num_owned[zone, 1] = zone + 2
    out = np.zeros(10, dtype=zoned.rows.dtype)
    assert list_others(zoned, 0, 0, out) == 0
    assert list_others(zoned, 0, 1, out) == 6
    assert sorted(out["id"][:6].tolist()) == [1, 11, 12, 21, 22, 23]
