from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.traffic.kernels.way_requests import CLOSED_S, limit_speeds, sample_speeds, slow_lanes
from tests.naive import edge_speeds as naive
from tests.support.traffic import NAMES, network

SAMPLES = 3
PASSENGER, BUS = (1 << VEHICLE_CLASSES.index(name) for name in ("passenger", "bus"))


class Meter:
    """Speeds measured on the edges of one world; `see` adds the sample of one second."""

    def __init__(self, roads: RoadNetwork) -> None:
        self.roads = roads
        self.past = np.zeros((SAMPLES, len(roads.edges)), dtype=np.int32)
        self.sums = np.zeros(len(roads.edges), dtype=np.int64)
        self.number = 0
        limit_speeds(roads.arrays, self.past, self.sums)

    def see(self, rows: NDArray[np.void]) -> None:
        lanes = len(self.roads.lanes)
        room = np.full(lanes, 7, dtype=np.int64), np.full(lanes, 7, dtype=np.int64)
        sample_speeds(self.roads.arrays, rows, len(rows), self.number, self.past, self.sums, *room)
        self.number += 1


@st.composite
def vehicles(draw: st.DrawFn, lanes: int) -> NDArray[np.void]:
    rows = np.zeros(draw(st.integers(0, 12)), VEHICLE)
    # Few lanes, so that vehicles share them.
    some = draw(st.lists(st.integers(0, lanes - 1), min_size=1, max_size=4))
    for row in rows:
        row["lane"] = draw(st.sampled_from(some))
        row["speed"] = draw(st.floats(-2.0, 40.0))
        row["stopped_s"] = draw(st.sampled_from([0.0, 0.0, 3.0]))
    return rows


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_speed_sums_equal_the_sums_of_the_last_mean_speeds(name: str, data: st.DataObject) -> None:
    roads = network(name)
    meter, shuffled = Meter(roads), Meter(roads)
    means = [naive.mean_speeds(roads, np.zeros(0, VEHICLE))] * SAMPLES
    assert meter.sums.tolist() == np.sum(means, axis=0).tolist()
    for _ in range(SAMPLES + 2):
        rows = data.draw(vehicles(len(roads.lanes)))
        meter.see(rows)
        order = data.draw(st.permutations(range(len(rows))))
        shuffled.see(rows[list(order)])
        means = [*means[1:], naive.mean_speeds(roads, rows)]
        assert meter.sums.tolist() == np.sum(means, axis=0).tolist()
    np.testing.assert_array_equal(meter.sums, shuffled.sums)
    np.testing.assert_array_equal(meter.past, shuffled.past)


def test_travel_times_use_measured_speeds_and_the_closures_of_edges() -> None:
    roads = network("grid4x4")
    edge = int(np.flatnonzero(~roads.edges["internal"])[0])
    sums = np.full(len(roads.edges), 10**9, dtype=np.int64)
    sums[edge] = 5 * 2500
    closed = np.zeros(len(roads.edges), dtype=np.int64)
    lanes = roads.lanes.copy()
    now = roads.lanes.copy()

    def speeds(samples: int, permission: int = PASSENGER) -> NDArray[np.float64]:
        slow_lanes(roads.arrays, sums, samples, closed, now, permission, lanes)
        found: NDArray[np.float64] = lanes["speed_mps"].copy()
        return found

    mine = roads.lanes["edge"] == edge
    assert (speeds(5)[mine] == 2.5).all()
    assert (speeds(5)[~mine] == roads.lanes["speed_mps"][~mine]).all(), "a speed is above the limit"
    assert (speeds(0) == roads.lanes["speed_mps"]).all()
    sums[edge] = 0
    assert (speeds(5)[mine] > 0.0).all(), "a jam has no finite travel time"
    closed[edge] = PASSENGER
    np.testing.assert_allclose((roads.lanes["length_m"] / speeds(5))[mine], CLOSED_S)
    assert (speeds(0, BUS) == roads.lanes["speed_mps"]).all(), "the edge is closed to buses"
    assert (speeds(0, BUS | PASSENGER) == roads.lanes["speed_mps"]).all(), (
        "the edge is closed to a class that ignores permissions"
    )
