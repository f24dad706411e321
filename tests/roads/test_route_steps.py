from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.driving.kernels.lanes.route_following import distance_left, next_step, own_step
from cavmarl.roads.kernels.route_steps import plan_route, trace_edges
from cavmarl.roads.network import CARS, VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.routing import PLAN, make_plans, way
from cavmarl.roads.sumo_net.reader import read_network
from tests.naive import routes as naive
from tests.support.traffic import NAMES, network, on_lane, travel_by

FIRST_STEP = 5  # the table begins with steps of other routes


def following(roads: RoadNetwork, edge: int) -> list[int]:
    """Return the rows of the edges to which the lanes of an edge lead, in order."""
    found = set()
    for lane in naive.lanes_of(roads, edge):
        row = roads.lanes[lane]
        for link in range(int(row["first_link"]), int(row["first_link"] + row["num_links"])):
            found.add(int(roads.lanes[roads.links[link]["to_lane"]]["edge"]))
    return sorted(found)


@st.composite
def routes(draw: st.DrawFn, name: str) -> tuple[str, list[int]]:
    """Draw a route of connected edges; on a ring, edges can repeat."""
    roads = network(name)
    outside = np.flatnonzero(~roads.edges["internal"]).tolist()
    edges = [draw(st.sampled_from(outside))]
    for _ in range(draw(st.integers(0, 11))):
        options = following(roads, edges[-1])
        if not options:
            break
        edges.append(draw(st.sampled_from(options)))
    return name, edges


def planned(
    roads: RoadNetwork, edges: list[int], permission: int = CARS
) -> tuple[NDArray[np.void], NDArray[np.float64], list[int]]:
    """Return steps, their costs, and per edge the offset from a lane to its step."""
    number = int(roads.edges["num_lanes"][edges].sum())
    steps, cost = np.zeros(FIRST_STEP + number, PLAN), np.full(FIRST_STEP + number, -1.0)
    row = np.array(edges, np.int32)
    assert plan_route(roads.arrays, row, permission, FIRST_STEP, steps, cost) == number
    ways, begin = [], FIRST_STEP
    for edge in edges:
        ways.append(begin - int(roads.edges[edge]["first_lane"]))
        begin += int(roads.edges[edge]["num_lanes"])
    return steps, cost, ways


def check_route(roads: RoadNetwork, edges: list[int], permission: int) -> None:
    steps, cost, ways = planned(roads, edges, permission)
    twin = naive.costs(roads, edges, permission)
    for (n, lane), expected in twin.items():
        step = steps[ways[n] + lane]
        assert cost[ways[n] + lane] == pytest.approx(expected)
        assert np.isfinite(step["to_go"]) == np.isfinite(expected)
        if not np.isfinite(expected):
            assert (step["next"], step["change"]) == (-1, 0)
            continue
        here = roads.lanes[lane]
        if step["change"] != 0:
            beside = int(here["left" if step["change"] > 0 else "right"])
            better = steps[ways[n] + beside]
            assert (step["next"], step["shift"]) == (-1, 0)
            assert step["changes"] == better["changes"] + 1
            assert step["room"] == here["length_m"]
            assert step["to_go"] == better["to_go"]
        elif n < len(edges) - 1:
            link = roads.links[step["link"]]
            to_lane = int(link["to_lane"])
            assert (link["from_lane"], link["next_lane"]) == (lane, step["next"])
            assert roads.lanes[to_lane]["edge"] == edges[n + 1]
            assert ways[n] + step["shift"] == ways[n + 1]
            beyond = steps[ways[n + 1] + to_lane]
            driven = naive.length(roads, lane, int(step["link"]))
            assert step["changes"] == 0
            assert step["to_go"] == pytest.approx(driven + beyond["to_go"])
            assert step["room"] == pytest.approx(driven + beyond["room"])
        else:
            assert (step["next"], step["changes"]) == (-1, 0)
            assert step["to_go"] == step["room"] == here["length_m"]


@given(st.sampled_from(NAMES).flatmap(routes))
def test_the_steps_of_a_route_take_the_least_time_along_its_edges(
    case: tuple[str, list[int]],
) -> None:
    name, edges = case
    check_route(network(name), edges, CARS)


def test_routes_do_not_use_lanes_that_forbid_the_vehicle_class(shared_maps: Path) -> None:
    roads = read_network(shared_maps / "net" / "bologna_acosta" / "acosta_buslanes.net.xml")
    forbidden = np.flatnonzero(~roads.lanes["internal"] & (roads.lanes["permissions"] & CARS == 0))
    edges = np.unique(roads.lanes["edge"][forbidden]).tolist()
    assert edges
    for edge in edges:
        route = [edge, *following(roads, edge)[:1]]
        for vehicle_class in ("passenger", "bus"):
            check_route(roads, route, 1 << VEHICLE_CLASSES.index(vehicle_class))


def walk(roads: RoadNetwork, steps: NDArray[np.void], lane: int, way_: int) -> list[int]:
    """Return the lanes that a vehicle visits along the steps, with lane changes."""
    travel, lanes = travel_by(steps), [lane]
    for _ in range(10_000):
        here = roads.lanes[lane]
        step = steps[way_ + lane] if not here["internal"] else None
        if step is not None and step["change"] != 0:
            lane = int(here["left" if step["change"] > 0 else "right"])
            lanes.append(lane)
            continue
        lane, way_, link = next_step(roads.arrays, travel, lane, way_)
        if lane < 0:
            return lanes
        assert (link >= 0) == (not here["internal"])
        lanes.append(lane)
    raise AssertionError("the steps have no end")


@settings(max_examples=30)
@given(st.sampled_from(NAMES).flatmap(routes))
def test_the_steps_lead_over_the_edges_in_order(case: tuple[str, list[int]]) -> None:
    name, edges = case
    roads = network(name)
    steps, _, ways = planned(roads, edges)
    for lane in naive.lanes_of(roads, edges[0]):
        if not np.isfinite(steps[ways[0] + lane]["to_go"]):
            continue
        outside = [k for k in walk(roads, steps, lane, ways[0]) if not roads.lanes[k]["internal"]]
        driven = [int(roads.lanes[k]["edge"]) for k in outside]
        visited = [e for k, e in enumerate(driven) if k == 0 or e != driven[k - 1]]
        # Repeats are dropped, because lane changes repeat an edge too.
        assert visited == [e for k, e in enumerate(edges) if k == 0 or e != edges[k - 1]]


@settings(max_examples=30)
@given(st.sampled_from(NAMES).flatmap(routes), st.floats(0.0, 1.0))
def test_the_remaining_length_is_the_sum_of_the_lanes_ahead(
    case: tuple[str, list[int]], share: float
) -> None:
    name, edges = case
    roads = network(name)
    steps, _, ways = planned(roads, edges)
    travel = travel_by(steps)
    for start in naive.lanes_of(roads, edges[0]):
        if not np.isfinite(steps[ways[0] + start]["to_go"]):
            continue
        lanes = walk(roads, steps, start, ways[0])
        way_, n = ways[0], 0
        for k, lane in enumerate(lanes):
            here = roads.lanes[lane]
            if k > 0 and not here["internal"] and roads.lanes[lanes[k - 1]]["internal"]:
                n += 1
            # Inside a junction, the offset is already that of the next edge.
            way_ = ways[min(n + int(here["internal"]), len(ways) - 1)]
            s = share * float(here["length_m"])
            row = on_lane(roads, lane, s, travel, way=way_)
            ahead = [
                other
                for m, other in enumerate(lanes[k:])
                if m + k == len(lanes) - 1 or not changes_lane(roads, lanes[m + k : m + k + 2])
            ]
            expected = roads.lanes["length_m"][ahead].sum() - s
            assert distance_left(
                roads.arrays, row[0], travel.steps[own_step(roads.arrays, row[0])]
            ) == pytest.approx(expected)


def changes_lane(roads: RoadNetwork, pair: list[int]) -> bool:
    here, after = pair
    return after in (roads.lanes[here]["left"], roads.lanes[here]["right"]) and bool(
        roads.lanes[here]["edge"] == roads.lanes[after]["edge"]
    )


def _time_s(roads: RoadNetwork, lanes: list[int]) -> float:
    """Return the time at the speed limits; on each edge, only the last lane counts."""
    total = 0.0
    for k, lane in enumerate(lanes):
        if k + 1 == len(lanes) or not changes_lane(roads, lanes[k : k + 2]):
            total += float(roads.lanes[lane]["length_m"] / roads.lanes[lane]["speed_mps"])
    return total


@pytest.mark.parametrize("name", NAMES)
def test_trace_edges_returns_the_edges_of_the_fastest_way(name: str) -> None:
    roads = network(name)
    outside = np.flatnonzero(~roads.edges["internal"]).tolist()
    room = np.zeros(len(outside) + 1, np.int32)
    for goal in outside[:: max(len(outside) // 4, 1)]:
        plan = make_plans(roads, [goal])[0]
        for edge in outside:
            number = trace_edges(roads.arrays, plan, edge, room)
            ways = [
                way(roads, plan, lane)
                for lane in naive.lanes_of(roads, edge)
                if np.isfinite(plan[lane]["to_go"])
            ]
            if not ways:
                assert number == 0
                continue
            # The best of equally fast ways has the fewest lane changes at its start.
            best = min(ways, key=lambda lanes: (_time_s(roads, lanes), plan[lanes[0]]["changes"]))
            driven = [
                int(roads.lanes[lane]["edge"]) for lane in best if not roads.lanes[lane]["internal"]
            ]
            edges = [e for k, e in enumerate(driven) if k == 0 or e != driven[k - 1]]
            assert room[:number].tolist() == edges
            assert (edges[0], edges[-1]) == (edge, goal)
            if number > 1:
                assert trace_edges(roads.arrays, plan, edge, room[: number - 1]) == -1
