from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.records.arrays import Scratch
from cavmarl.driving.kernels.lanes.lane_index import (
    VIEW_M,
    ahead_on,
    behind_by,
    behind_on,
    beside_s,
    index_lanes,
    last_on,
)
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import RoadNetwork
from tests.naive import lanes as naive
from tests.support.traffic import NAMES, crowds_on_lanes, network, scratch, travel

maps_with_crowds = st.sampled_from(NAMES).flatmap(
    lambda name: st.tuples(st.just(name), crowds_on_lanes(name))
)


def indexed(name: str, rows: NDArray[np.void]) -> Scratch:
    roads = network(name)
    room = scratch(roads, len(rows))
    index_lanes(roads.arrays, travel(name), rows, len(rows), room)
    return room


def looked_for(roads: RoadNetwork, rows: NDArray[np.void]) -> list[tuple[int, int, float]]:
    """Return (row, lane, s) of searches on the lane of each vehicle and on its neighbour lanes."""
    asked = []
    for i, row in enumerate(rows):
        here = roads.lanes[row["lane"]]
        for lane in {int(row["lane"]), int(here["left"]), int(here["right"])} - {-1}:
            for s in (0.0, float(row["s"]), float(roads.lanes[lane]["length_m"])):
                asked.append((i, lane, s))
    return asked


@given(maps_with_crowds)
def test_the_index_lists_each_vehicle_on_every_lane_that_it_covers(
    case: tuple[str, NDArray[np.void]],
) -> None:
    name, rows = case
    roads = network(name)
    room = indexed(name, rows)
    decel = travel(name).types[0]["decel"]
    for lane in range(len(roads.lanes)):
        entries = room.entries[room.lane_start[lane] : room.lane_end[lane]]
        assert [(e["s"], e["id"], e["row"]) for e in entries] == naive.on_lane(roads, rows, lane)
        for entry in entries:
            row = rows[entry["row"]]
            assert entry["side"] == (row["lane"] != lane)
            copied = (entry["speed"], entry["half"], entry["decel"])
            assert copied == (row["speed"], 0.5 * row["length"], decel)


def nearest_behind(
    roads: RoadNetwork,
    room: Scratch,
    lane: int,
    s: float,
    own_id: int,
    reach_m: float,
    view_m: float,
) -> tuple[int, float]:
    """Return the nearest follower on any incoming lane; the smallest id breaks ties."""
    asked = range(max(1, int(roads.lanes[lane]["num_into"])))
    found = [behind_by(roads.arrays, room, lane, s, own_id, n, reach_m, view_m) for n in asked]
    return min(found, key=lambda one: (one[1], room.entries[one[0]]["id"]))


def seen(room: Scratch, k: int) -> tuple[int, float]:
    """Return row and position of an entry, in the form that the twin returns."""
    return (int(room.entries[k]["row"]), float(room.entries[k]["s"])) if k >= 0 else (-1, np.inf)


@given(maps_with_crowds, st.sampled_from([5.0, 60.0, 400.0]))
def test_found_leaders_and_followers_equal_twin(
    case: tuple[str, NDArray[np.void]], reach_m: float
) -> None:
    name, rows = case
    roads = network(name)
    room = indexed(name, rows)
    for i, lane, s in looked_for(roads, rows):
        own_id = rows[i]["id"]
        assert seen(room, ahead_on(room, lane, s, own_id, VIEW_M)) == naive.ahead(
            roads, rows, i, lane, s
        )
        found, distance = nearest_behind(roads, room, lane, s, own_id, reach_m, VIEW_M)
        expected, true_distance = naive.behind(roads, rows, i, lane, s, reach_m)
        assert seen(room, found)[0] == expected
        assert distance == pytest.approx(true_distance)
        others = [(j, at) for at, _, j in naive.on_lane(roads, rows, lane) if j != i]
        for way in (0.0, 120.0):
            last = others[0] if others and way + others[0][1] <= VIEW_M else (-1, np.inf)
            assert seen(room, last_on(room, lane, own_id, way, VIEW_M)) == last
        before = [
            j for at, k, j in naive.on_lane(roads, rows, lane) if j != i and (at, k) <= (s, own_id)
        ]
        assert seen(room, behind_on(room, lane, s, own_id))[0] == (before[-1] if before else -1)


@given(maps_with_crowds, st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(
    case: tuple[str, NDArray[np.void]], random: object
) -> None:
    name, rows = case
    roads = network(name)
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    shuffled = rows[order]
    tidy, room = indexed(name, rows), indexed(name, shuffled)
    fields = [field for field in tidy.entries.dtype.names if field != "row"]
    listed = tidy.lane_start[len(roads.lanes)]
    np.testing.assert_array_equal(tidy.lanes.bounds, room.lanes.bounds)
    np.testing.assert_array_equal(tidy.entries[fields][:listed], room.entries[fields][:listed])
    for i, lane, s in looked_for(roads, rows):
        own_id = rows[i]["id"]
        assert ahead_on(tidy, lane, s, own_id, VIEW_M) == ahead_on(room, lane, s, own_id, VIEW_M)
        one, other = (
            nearest_behind(roads, index, lane, s, own_id, 60.0, VIEW_M) for index in (tidy, room)
        )
        assert one == other


def test_searches_end_at_the_view_distance() -> None:
    roads = network("ring")
    lane = int(np.argmax(roads.lanes["length_m"]))
    view_m = 40.0
    rows = np.zeros(2, VEHICLE)
    rows["id"], rows["side_lane"], rows["lane"] = [0, 1], -1, lane
    for apart, sees in ((view_m, True), (view_m + 0.5, False)):
        rows["s"] = [0.0, apart]
        room = indexed("ring", rows)
        assert (ahead_on(room, lane, 0.0, 0, view_m) >= 0) == sees
        behind, _ = nearest_behind(roads, room, lane, apart, 1, 60.0, view_m)
        assert (behind >= 0) == sees
        rows["s"] = [apart - 15.0, 50.0]
        room = indexed("ring", rows)
        assert (last_on(room, lane, 9, 15.0, view_m) >= 0) == sees


def test_the_larger_id_of_two_vehicles_at_the_same_place_is_the_leader() -> None:
    roads = network("ring")
    rows = np.zeros(2, VEHICLE)
    rows["id"], rows["side_lane"], rows["s"] = [7, 3], -1, 10.0
    room = indexed("ring", rows)
    assert seen(room, ahead_on(room, 0, 10.0, 3, VIEW_M)) == (0, 10.0)
    assert ahead_on(room, 0, 10.0, 7, VIEW_M) == -1
    k, distance = nearest_behind(roads, room, 0, 10.0, 7, 60.0, VIEW_M)
    assert (seen(room, k)[0], distance) == (1, 0.0)


def test_a_vehicle_that_stands_over_30_m_behind_on_an_incoming_lane_is_not_a_follower() -> None:
    roads = network("grid4x4")
    lane = int(np.flatnonzero(roads.lanes["internal"])[0])
    link = roads.links[roads.lanes["link"][lane]]
    before, length = int(link["from_lane"]), float(roads.lanes["length_m"][link["from_lane"]])
    rows = np.zeros(2, VEHICLE)
    rows["id"], rows["side_lane"], rows["lane"] = [3, 4], -1, before
    for apart, speeds, expected in (
        ([40.0, 29.0], [0.0, 0.0], 1),
        ([60.0, 31.0], [0.0, 0.0], -1),
        ([60.0, 31.0], [5.0, 0.0], 0),
        ([60.0, 31.0], [0.0, 1.0], 1),
    ):
        rows["s"], rows["speed"] = length + 1.0 - np.array(apart), speeds
        room = indexed("grid4x4", rows)
        k, gap = nearest_behind(roads, room, lane, 1.0, 9, 60.0, VIEW_M)
        assert seen(room, k)[0] == expected
        assert gap == (pytest.approx(apart[expected]) if expected >= 0 else np.inf)


@pytest.mark.parametrize("name", NAMES)
def test_beside_s_equals_twin_and_finds_almost_the_nearest_position(name: str) -> None:
    roads = network(name)
    asked = 0
    for lane in np.flatnonzero(~roads.lanes["internal"]).tolist():
        here = roads.lanes[lane]
        for beside in {int(here["left"]), int(here["right"])} - {-1}:
            for share in (0.0, 0.3, 1.0):
                s = share * float(here["length_m"])
                there = beside_s(roads.arrays, lane, beside, s)
                assert there == naive.beside_s(roads, lane, beside, s)
                assert 0.0 <= there <= roads.lanes[beside]["length_m"]
                x, y = place(roads, lane, s)
                nearest = min(
                    np.hypot(x - other_x, y - other_y)
                    for other_x, other_y in (
                        place(roads, beside, at)
                        for at in np.arange(0.0, roads.lanes[beside]["length_m"], 0.25)
                    )
                )
                other_x, other_y = place(roads, beside, there)
                # No point of the neighbour lane is over 1 m closer than the returned position.
                assert np.hypot(x - other_x, y - other_y) < nearest + 1.0
                asked += 1
    assert asked > 0


def place(roads: RoadNetwork, lane: int, s: float) -> tuple[float, float]:
    row = roads.lanes[lane]
    x, y, *_ = lane_pose(roads.points, row["first_point"], row["num_points"], s)
    return x, y
