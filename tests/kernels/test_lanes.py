from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.kernels.arrays import Scratch
from cavmarl.kernels.lanes import index_lanes, last_on_lane, neighbor_ahead, neighbor_behind
from cavmarl.roads.network import RoadNetwork
from cavmarl.shard.vehicles import VEHICLE
from tests.kernels.traffic import NAMES, crowds_on_lanes, network, scratch
from tests.naive import lanes as naive

maps_with_crowds = st.sampled_from(NAMES).flatmap(
    lambda name: st.tuples(st.just(name), crowds_on_lanes(name))
)


def indexed(roads: RoadNetwork, rows: NDArray[np.void]) -> Scratch:
    room = scratch(roads, len(rows))
    index_lanes(roads.lanes, rows, len(rows), room)
    return room


def looked_for(roads: RoadNetwork, rows: NDArray[np.void]) -> list[tuple[int, int, float]]:
    """Row, lane and place to search from: each one's own lane, and its neighbours."""
    asked = []
    for i, row in enumerate(rows):
        here = roads.lanes[row["lane"]]
        for lane in {int(row["lane"]), int(here["left"]), int(here["right"])} - {-1}:
            for s in (0.0, float(row["s"]), float(roads.lanes[lane]["length_m"])):
                asked.append((i, lane, s))
    return asked


@given(maps_with_crowds)
def test_the_index_lists_everybody_on_every_lane_he_covers(
    case: tuple[str, NDArray[np.void]],
) -> None:
    name, rows = case
    roads = network(name)
    room = indexed(roads, rows)
    for lane in range(len(roads.lanes)):
        begin, end = room.lane_start[lane], room.lane_start[lane + 1]
        entries = [(room.entry_s[k], rows[room.entry_row[k]]["id"]) for k in range(begin, end)]
        assert entries == [(s, i) for s, i, _ in naive.on_lane(roads, rows, lane)]


@given(maps_with_crowds, st.sampled_from([5.0, 60.0, 400.0]))
def test_neighbours_equal_twin(case: tuple[str, NDArray[np.void]], reach_m: float) -> None:
    name, rows = case
    roads = network(name)
    room = indexed(roads, rows)
    for i, lane, s in looked_for(roads, rows):
        assert neighbor_ahead(rows, i, lane, s, room) == naive.ahead(roads, rows, i, lane, s)
        found, distance = neighbor_behind(roads.arrays, rows, i, lane, s, reach_m, room)
        expected, true_distance = naive.behind(roads, rows, i, lane, s, reach_m)
        assert found == expected
        assert distance == pytest.approx(true_distance)
        others = [(at, j) for at, _, j in naive.on_lane(roads, rows, lane) if j != i]
        last, last_s = last_on_lane(i, lane, room)
        assert (last_s, last) == (others[0] if others else (np.inf, -1))


@given(maps_with_crowds, st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(
    case: tuple[str, NDArray[np.void]], random: object
) -> None:
    name, rows = case
    roads = network(name)
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    shuffled = rows[order]
    tidy_room, room = indexed(roads, rows), indexed(roads, shuffled)
    for i, lane, s in looked_for(roads, rows):
        j = order.index(i)
        for found, other in (
            (
                neighbor_ahead(rows, i, lane, s, tidy_room),
                neighbor_ahead(shuffled, j, lane, s, room),
            ),
            (
                neighbor_behind(roads.arrays, rows, i, lane, s, 60.0, tidy_room),
                neighbor_behind(roads.arrays, shuffled, j, lane, s, 60.0, room),
            ),
        ):
            assert found[1] == other[1]
            assert (found[0] < 0) == (other[0] < 0)
            assert found[0] < 0 or rows[found[0]]["id"] == shuffled[other[0]]["id"]


def test_of_two_at_one_place_the_larger_id_leads() -> None:
    roads = network("ring")
    rows = np.zeros(2, VEHICLE)
    rows["id"], rows["side_lane"], rows["s"] = [7, 3], -1, 10.0
    room = indexed(roads, rows)
    assert neighbor_ahead(rows, 1, 0, 10.0, room) == (0, 10.0)
    assert neighbor_ahead(rows, 0, 0, 10.0, room) == (-1, np.inf)
    assert neighbor_behind(roads.arrays, rows, 0, 0, 10.0, 60.0, room) == (1, 0.0)
