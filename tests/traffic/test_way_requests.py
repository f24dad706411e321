from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, EVENT_ARRIVED
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.kernels.way_requests import (
    find_asking,
    find_way,
    has_room,
    mark_slots,
    take_slot,
    time_left,
)
from cavmarl.traffic.rerouting import LOOK
from tests.naive import plans as naive
from tests.support.traffic import NAMES, network, on_lane, travel_by

ROOM = 400  # largest number of steps of a route


def outside(roads: RoadNetwork) -> list[int]:
    found: list[int] = np.flatnonzero(~roads.edges["internal"]).tolist()
    return found


def with_speeds(roads: RoadNetwork, seed: int) -> RoadNetwork:
    """Return the roads with lower speed limits on randomly drawn edges."""
    lanes = roads.lanes.copy()
    share = np.random.default_rng(seed).choice([1.0, 0.5, 0.05], len(roads.edges))
    lanes["speed_mps"] *= share[lanes["edge"]]
    return dataclasses.replace(roads, lanes=lanes)


def way_to(
    roads: RoadNetwork, goal: int, lane: int, room: int = ROOM
) -> tuple[NDArray[np.void], int]:
    """Return the steps of the fastest route, and their number."""
    plan = np.zeros(len(roads.lanes), PLAN)
    plan_goal(roads.arrays, goal, CARS, 1.0, plan)
    steps = np.zeros(room, PLAN)
    edges = np.zeros(room, np.int32)
    number = find_way(roads.arrays, plan, lane, CARS, edges, steps, np.zeros(room))
    return steps, number


def on_edge(roads: RoadNetwork, lane: int) -> int:
    """Return the field `way` of a vehicle on a lane's edge if its steps start at index 0."""
    return -int(roads.edges[roads.lanes[lane]["edge"]]["first_lane"])


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_found_routes_are_the_fastest_and_lead_to_the_goal(name: str, data: st.DataObject) -> None:
    roads = with_speeds(network(name), data.draw(st.integers(0, 5)))
    goal = data.draw(st.sampled_from(outside(roads)))
    cost = naive.costs(roads, goal, CARS)
    lane = data.draw(st.sampled_from(np.flatnonzero(~roads.lanes["internal"]).tolist()))
    steps, number = way_to(roads, goal, lane)
    if not np.isfinite(cost[lane]):
        assert number == 0
        return
    way = on_edge(roads, lane)
    assert time_left(roads.arrays, steps, way, lane) == pytest.approx(cost[lane])
    travel = travel_by(steps)
    while True:
        step = steps[way + lane] if not roads.lanes[lane]["internal"] else None
        if step is not None and step["change"] != 0:
            lane = int(roads.lanes[lane]["left" if step["change"] > 0 else "right"])
            continue
        following, way, _ = next_step(roads.arrays, travel, lane, way)
        if following < 0:
            break
        lane = following
    assert roads.lanes[lane]["edge"] == goal


def test_a_route_that_does_not_fit_its_slot_is_dropped() -> None:
    roads = network("grid4x4")
    goal = roads.edge_ids.index("D3right3")
    lane = int(roads.edges[roads.edge_ids.index("left0A0")]["first_lane"])
    _, number = way_to(roads, goal, lane)
    assert way_to(roads, goal, lane, number)[1] == number > 4
    assert way_to(roads, goal, lane, number - 1)[1] == 0
    assert way_to(roads, goal, lane, 2)[1] == 0


def test_vehicles_request_routes_in_order_of_ids_when_due_or_at_a_rerouter() -> None:
    roads = network("grid4x4")
    first, second = (int(roads.edges[edge]["first_lane"]) for edge in outside(roads)[:2])
    inside = int(np.flatnonzero(roads.lanes["internal"])[0])
    rows = np.zeros(9, VEHICLE)
    rows["id"] = [8, 3, 5, 1, 2, 7, 4, 6, 0]
    rows["order"] = np.arange(9)
    rows["driver"], rows["stop"], rows["stops_end"] = DRIVER_BACKGROUND, -1, -1
    rows["lane"] = first
    looks = np.zeros(9, LOOK)
    looks["next"], looks["may_leave"], looks["seen"] = 10, True, -1
    rows[2]["lane"] = inside
    rows[3]["driver"] = DRIVER_AGENT
    rows[4]["stop"], rows[4]["stops_end"] = 0, 1
    rows[5]["events"] = EVENT_ARRIVED
    looks[6]["may_leave"] = False
    rows[7]["order"] = -1
    rows[8]["lane"] = second

    def asking(tick: int, *rerouters: int, changed_at: int = -1) -> list[int]:
        rules = np.zeros(len(roads.edges), np.bool_)
        rules[list(rerouters)] = True
        room = np.zeros(len(rows), np.int64)
        found = find_asking(roads.arrays, rows, len(rows), tick, rules, looks, changed_at, room)
        ids: list[int] = rows["id"][room[:found]].tolist()
        return ids

    assert asking(10) == [0, 3, 8]
    assert asking(9) == []
    looks["reacted"] = 4
    looks["reacted"][8] = 7
    assert asking(9, changed_at=7) == [3, 8]
    edge = int(roads.lanes[second]["edge"])
    assert looks[8]["seen"] == edge
    assert asking(9, edge) == [], "a vehicle that was already on the edge asks again"
    looks[8]["seen"] = -1
    assert asking(9, edge) == [0]


@pytest.mark.parametrize(
    ("speed", "back", "changes", "link", "fits"),
    [
        (10.0, 60.0, 0, 1, True),
        (10.0, 15.0, 0, 1, False),  # the vehicle can no longer stop for another turn
        (10.0, 15.0, 0, 0, True),  # the same turn
        (0.0, 3.0, 0, 1, True),
        (0.0, 3.0, 1, 1, False),  # no room to change lanes
        (0.0, 45.0, 1, 1, True),
        (0.0, 2.0, 0, 1, False),  # the vehicle's front is over the line
    ],
)
def test_a_vehicle_needs_room_to_leave_its_route(
    speed: float, back: float, changes: int, link: int, fits: bool
) -> None:
    roads = network("grid4x4")
    lane = int(roads.edges[roads.edge_ids.index("left0A0")]["first_lane"])
    steps = np.zeros((2, len(roads.lanes)), PLAN)
    steps[1]["link"], steps[1]["changes"], steps[1]["change"] = link, changes, changes
    travel = travel_by(steps)
    length = float(roads.lanes[lane]["length_m"])
    row = on_lane(roads, lane, length - back, speed=speed, way=0)
    assert has_room(roads.arrays, travel, row[0], travel.steps, len(roads.lanes)) == fits


def test_slots_are_taken_in_order_and_freed_when_their_vehicles_leave() -> None:
    roads = network("grid4x4")
    lane = int(roads.edges[roads.edge_ids.index("left0A0")]["first_lane"])
    found, number = way_to(roads, roads.edge_ids.index("D3right3"), lane)
    first, steps, slots = len(roads.lanes), number + 3, 2
    travel = travel_by(np.zeros(first + slots * steps, PLAN))
    rows = np.concatenate([on_lane(roads, lane, 20.0 + 10.0 * k, way=-lane) for k in range(3)])
    used = np.zeros(slots, np.bool_)
    taken = [
        take_slot(roads.arrays, travel, rows[k : k + 1][0], found[:number], first, steps, used)
        for k in range(3)
    ]
    assert taken == [True, True, False]
    assert (rows["way"] + lane).tolist() == [first, first + steps, 0]
    assert rows["leg"].tolist() == [1, 1, 0]
    assert rows["to_go"][0] == pytest.approx(found[0]["to_go"] - 20.0)
    np.testing.assert_array_equal(travel.steps[first : first + number], found[:number])
    mark_slots(roads.arrays, rows[1:], 2, first, steps, used)
    assert used.tolist() == [False, True]
    # A vehicle that has a slot writes its next route into that slot.
    again = take_slot(roads.arrays, travel, rows[1:2][0], found[:number], first, steps, used)
    assert again
    assert rows[1]["way"] + lane == first + steps
    # Inside a junction, `way` refers to the lane behind the junction.
    step = found[:number][found[:number]["next"] >= 0][0]
    assert step["shift"] > 0
    rows[1]["way"] += step["shift"]
    rows[1]["lane"] = step["next"]
    mark_slots(roads.arrays, rows[1:], 2, first, steps, used)
    assert used.tolist() == [False, True]
