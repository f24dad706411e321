"""Steered cars (agents) stay on the road in turns and bends; trips avoid too tight turns."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import EVENT_OFF_ROAD, EVENT_WRONG_WAY
from cavmarl.driving.kernels.motion.speed_limits_ahead import bend_speed
from cavmarl.driving.kernels.motion.tracking import locate
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import lane_grid, make_plans
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.turning_circle import with_tight_turns
from tests.support.dead_ends import before_dead_end, put
from tests.support.driving import drive, make_simulation, start, suggested
from tests.support.netgenerate import netconvert, netgenerate
from tests.support.traffic import network
from tests.support.world import traffic_of

STEERING_RAD = math.pi / 4.0
# A road that bends by 100° to the right; its first lane does so within 3 m.
CORNER = {
    "nod": """<nodes><node id="z" x="-20" y="400"/>
        <node id="a" x="-10" y="200"/><node id="b" x="0" y="0"/>
        <node id="c" x="213" y="27"/><node id="d" x="194" y="-160"/></nodes>""",
    "edg": """<edges><edge id="a0" from="z" to="a" numLanes="2"/>"""
    + "".join(
        f"""<edge id="{one}{two}" from="{one}" to="{two}" numLanes="2"/>"""
        for one, two in ("ab", "ba", "bc", "cb", "cd", "dc")
    )
    + "</edges>",
    "con": "<connections/>",
}
RANDOM = ["--rand", "--rand.iterations", "40", "--seed", "1"]


def _turn_rad(roads: RoadNetwork, link: np.void) -> float:
    before = roads.lane_points(link["from_lane"])["heading"][-1]
    after = roads.lane_points(link["to_lane"])["heading"][0]
    return abs(math.remainder(float(after - before), 2.0 * math.pi))


def test_a_car_can_take_each_corner_of_a_grid() -> None:
    roads = network("grid4x4")
    links = with_tight_turns(roads, STEERING_RAD).links
    assert links["direction"].tolist() == roads.links["direction"].tolist()
    small_steering = with_tight_turns(
        roads, 0.3
    ).links  # 0.3 rad of steering are too little for some turns
    assert (small_steering["direction"] != roads.links["direction"]).any()


def test_only_sharp_turns_are_too_tight_and_no_trip_uses_them(tmp_path: Path) -> None:
    path = netgenerate(tmp_path / "random.net.xml", *RANDOM)
    world = make_simulation(path, mode="respawn", agents=4, background=0)
    roads = world.network
    links = with_tight_turns(roads, STEERING_RAD).links
    tight = np.flatnonzero(links["direction"] != roads.links["direction"])
    assert 0 < tight.size < 0.15 * len(links)
    assert min(_turn_rad(roads, roads.links[link]) for link in tight) > 1.2
    traffic = traffic_of(world)
    for origin, goal in traffic.demand.agent_trips.pairs.tolist():
        plan, lane = traffic.plans[goal], origin
        while plan[lane]["next"] >= 0:
            assert plan[lane]["link"] not in tight
            lane = int(plan[lane]["next"])


def test_a_turn_is_too_tight_if_a_steered_car_leaves_its_road(tmp_path: Path) -> None:
    # The bend is too tight at the distance that cars in turns aim ahead. A car that aimed as far
    # ahead as on straight links would stay on the road.
    for kind, text in CORNER.items():
        (tmp_path / f"m.{kind}.xml").write_text(text)
    roads = read_network(netconvert(tmp_path, "m"))
    links = with_tight_turns(roads, STEERING_RAD).links
    corners = {
        roads.lane_ids[link["from_lane"]]: before["direction"] != link["direction"]
        for before, link in zip(roads.links, links, strict=True)
        if link["direction"] == ord("t") and before["direction"] != ord("t")
    }
    assert corners == {"bc_0": True}


def test_a_vehicle_that_turns_in_a_junction_does_not_drive_the_wrong_way() -> None:
    roads = network("grid4x4")
    grid, sharp = lane_grid(roads), 0
    for link in roads.links[roads.links["first_internal"] >= 0]:
        if _turn_rad(roads, link) < 1.5 or link["direction"] == ord("t"):
            continue
        lane = int(link["first_internal"])
        length = float(roads.lanes["length_m"][lane])
        for s, end, sign, expected in (
            (0.9 * length, 0, 1.0, 0),  # in the direction of the incoming road
            (0.1 * length, 1, 1.0, 0),  # in the direction of the outgoing road
            (0.5 * length, 0, -1.0, EVENT_WRONG_WAY),
        ):
            row = blank_vehicle()[0]
            x, y, *_ = roads.pose_on(lane, s)
            row["lane"], row["x"], row["y"], row["s"] = lane, x, y, s
            heading = roads.lane_points(link["from_lane" if end == 0 else "to_lane"])["heading"]
            towards = math.pi if sign < 0.0 else 0.0
            middle = roads.pose_on(lane, 0.5 * length)
            facing = math.atan2(middle[4], middle[3]) + towards
            row["heading"] = facing if sign < 0.0 else heading[-1 if end == 0 else 0]
            plan = make_plans(roads, [int(roads.lanes["edge"][link["to_lane"]])])
            assert locate(roads.arrays, plan, grid, row) == expected
            sharp += 1
    assert sharp > 20


def test_a_corner_between_two_lanes_limits_the_speed_like_a_bend(tmp_path: Path) -> None:
    path = netgenerate(tmp_path / "random.net.xml", *RANDOM)
    roads = read_network(path)
    link = roads.links[int(np.argmax([_turn_rad(roads, link) for link in roads.links]))]
    last, first = int(link["from_lane"]), int(link["to_lane"])
    at_corner = bend_speed(roads.arrays, last, first, 0.0)
    assert at_corner < 4.0
    assert at_corner < bend_speed(roads.arrays, last, first, 30.0) < math.inf
    assert bend_speed(roads.arrays, first, first, -20.0) == math.inf


@pytest.mark.slow
def test_a_single_agent_on_two_lanes_keeps_its_lane(tmp_path: Path) -> None:
    """Both lanes have the same bends, stop lines and speed limits ahead."""
    path = netgenerate(tmp_path / "random.net.xml", *RANDOM, "-L", "2", "-j", "traffic_light")
    world = make_simulation(path, mode="respawn", agents=1, background=0)
    start(world, 2)
    roads, before, changes, driven_m = world.network, -1, 0, 0.0
    for _ in range(900):
        drive(world)
        row = world.vehicles(0)[0]
        lane = int(row["lane"])
        planned = world.plans[row["goal"], before]["change"] if before >= 0 else 0
        if before >= 0 and roads.lanes["edge"][lane] == roads.lanes["edge"][before] != lane:
            changes += lane != before and planned == 0
        before = lane
        driven_m = max(driven_m, float(row["distance_m"]))
    assert driven_m > 200.0
    assert changes == 0


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 8))]
)
def test_agents_on_a_random_map_stay_on_their_side(tmp_path: Path, seed: int) -> None:
    options = ["--rand", "--rand.iterations", "40", "--seed", str(seed)]
    path = netgenerate(tmp_path / "random.net.xml", *options)
    world = make_simulation(path, mode="respawn", agents=2, background=0, num_worlds=4)
    start(world, seed)
    for _ in range(800):
        for each in range(4):
            row = world.vehicles(each)
            assert not (row["events"] & (EVENT_OFF_ROAD | EVENT_WRONG_WAY)).any(), row["lane"]
        drive(world)


def test_all_links_that_lead_into_one_lane_are_foes(tmp_path: Path) -> None:
    """netconvert does not list all merging links as foes if a junction has very many arms."""
    arms = ["--spider", "--spider.arm-number", "13", "--spider.circle-number", "1"]
    roads = read_network(netgenerate(tmp_path / "spider.net.xml", *arms))
    pairs = 0
    for number, link in enumerate(roads.links):
        rows = roads.conflicts[link["first_conflict"] :][: link["num_conflicts"]]
        into = np.flatnonzero(
            (roads.links["to_lane"] == link["to_lane"])
            & (roads.links["from_lane"] != link["from_lane"])
        )
        assert set(into.tolist()) <= set(rows["foe"][rows["merging"]].tolist()), number
        pairs += into.size
    assert pairs > 100


def test_a_steered_car_does_not_overtake_on_a_lane_to_a_turn_that_is_too_tight(
    tmp_path: Path,
) -> None:
    world, right, left, goal = before_dead_end(tmp_path, length_m=30.0)
    plans = world.plans
    assert plans["turnarounds"][goal, [right, left]].tolist() == [1, 0]
    assert plans["change"][goal, right] == 0, "the route does not continue from the right lane"

    def wants(lane: int) -> int:
        rows = world.vehicles(0)
        for row, s, speed in zip(rows, (60.0, 85.0), (13.0, 2.0), strict=True):
            put(world, row, lane, s, speed, goal)
        return int(suggested(world)[0, int(rows["agent"][0]), 1] * 1000.0)

    assert wants(left) == 0
    assert wants(right) > 0, "the car does not overtake from the other lane"
