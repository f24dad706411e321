from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import RouteError
from cavmarl.roads.network import CARS, VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.routing import make_plans, way
from tests.naive import plans as naive
from tests.support.traffic import NAMES, network


def goals(roads: RoadNetwork, many: int = 6) -> list[int]:
    """Return edges spread over the map."""
    outside = np.flatnonzero(~roads.edges["internal"])
    return [int(outside[int(k)]) for k in np.linspace(0, len(outside) - 1, many)]


@pytest.mark.parametrize("name", NAMES)
def test_plans_take_the_least_time_from_every_lane(name: str) -> None:
    roads = network(name)
    edges = goals(roads)
    for goal, plan in zip(edges, make_plans(roads, edges), strict=True):
        cost = naive.costs(roads, goal, CARS)
        np.testing.assert_array_equal(np.isfinite(plan["to_go"]), np.isfinite(cost))
        for lane in np.flatnonzero(np.isfinite(cost)).tolist():
            step = plan[lane]
            if roads.lanes[lane]["edge"] == goal:
                assert (step["next"], step["link"], step["change"]) == (-1, -1, 0)
                continue
            # Each step of the plan reduces the remaining time by its own cost.
            if step["change"] != 0:
                beside = roads.lanes[lane]["left" if step["change"] > 0 else "right"]
                spent = naive.change_cost(roads, lane) + cost[beside]
            else:
                assert (int(step["next"]), int(step["link"])) in naive.followers(roads, lane)
                row = roads.lanes[lane]
                spent = row["length_m"] / row["speed_mps"] + cost[step["next"]]
            assert spent == pytest.approx(cost[lane])


@pytest.mark.parametrize("name", NAMES)
def test_the_distance_of_a_plan_is_the_sum_of_its_lanes(name: str) -> None:
    roads = network(name)
    edges = goals(roads)
    for goal, plan in zip(edges, make_plans(roads, edges), strict=True):
        for lane in np.flatnonzero(np.isfinite(plan["to_go"])).tolist():
            lanes = way(roads, plan, lane)
            assert roads.lanes[lanes[-1]]["edge"] == goal
            driven = [k for k in lanes if plan[k]["change"] == 0]
            assert plan[lane]["to_go"] == pytest.approx(roads.lanes["length_m"][driven].sum())
            first = next((k for k, at in enumerate(lanes) if plan[at]["change"]), len(lanes) - 1)
            room = roads.lanes["length_m"][lanes[: first + 1]].sum()
            assert plan[lane]["room"] == pytest.approx(room)
            changes = 0
            while plan[lanes[changes]]["change"] != 0:
                changes += 1
            assert plan[lane]["changes"] == changes
            turns = [
                chr(roads.links[plan[k]["link"]]["direction"])
                for k in driven
                if plan[k]["link"] >= 0
            ]
            assert plan[lane]["turnarounds"] == turns.count("t")


def test_plans_do_not_use_lanes_that_forbid_the_vehicle_class() -> None:
    roads = network("ring")
    plan = make_plans(roads, goals(roads, 1), "tram")[0]
    reached = np.isfinite(plan["to_go"])
    tram = 1 << VEHICLE_CLASSES.index("tram")
    assert not reached[roads.lanes["permissions"] & tram == 0].any()


def test_a_goal_that_cannot_be_reached_is_a_route_error() -> None:
    roads = network("merge")
    ramp = roads.edge_ids.index("ramp")
    out = roads.lane_ids.index("main_out_0")
    plan = make_plans(roads, [ramp])[0]
    assert plan[out]["to_go"] == np.inf
    assert plan[out]["next"] == -1
    with pytest.raises(RouteError, match=r"no route from lane 'main_out_0'.*map check"):
        way(roads, plan, out)
