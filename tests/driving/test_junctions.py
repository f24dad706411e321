"""Right of way in simulations of a crossing with a few cars: which car goes first."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.math.geometry import boxes_overlap, lane_pose
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.kernels.junctions.junctions import exit_blocked
from cavmarl.driving.kernels.junctions.stop_line_registration import STANDING_MPS
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.evaluate.traffic.native_side import idle_commands, make_world
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.junction_scenes import Scene, build_crossing
from tests.support.narrow_places import looping_turn
from tests.support.traffic import network as network_of
from tests.support.traffic import on_lane, scratch, travel


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that builds a crossing with the given SUMO type of junction."""
    return partial(build_crossing, tmp_path_factory.mktemp("crossings"))


@pytest.fixture
def scene(crossing: Callable[[str], Path]) -> Callable[[str], Scene]:
    return lambda kind: Scene(crossing(kind))


Make = Callable[[str], Scene]


def test_a_single_car_on_the_main_road_drives_through(scene: Make) -> None:
    here = scene("priority")
    here.put("main", "W_in_0", 60.0, "E_out", speed=14.0)
    lowest = min(float(here["main"]["speed"]) for _ in here.run(8.0))
    assert lowest > 12.0


def test_the_side_road_yields_to_the_main_road(scene: Make) -> None:
    here = scene("priority")
    here.put("side", "S_in_0", 25.0, "N_out", speed=10.0)
    here.put("main", "W_in_0", 45.0, "E_out", speed=14.0)
    times = here.entries(12.0)
    assert times["main"] < times["side"]
    assert times["main"] < 4.5, "the car with the right of way braked"


def test_the_side_road_goes_first_if_the_gap_is_large(scene: Make) -> None:
    here = scene("priority")
    here.put("side", "S_in_0", 5.0, "N_out", speed=5.0)
    here.put("main", "W_in_0", 135.0, "E_out", speed=12.0)
    times = here.entries(15.0)
    assert times["side"] < 3.0
    assert times["side"] < times["main"]


def test_the_side_road_waits_until_a_column_has_passed(scene: Make) -> None:
    here = scene("priority")
    here.put("side", "S_in_0", 20.0, "N_out", speed=8.0)
    for k in range(5):
        here.put(f"main{k}", "W_in_0", 10.0 + 25.0 * k, "E_out", speed=13.0)
    times = here.entries(30.0)
    assert times["side"] > max(times[f"main{k}"] for k in range(5))


@pytest.mark.parametrize("waited_s", [0.0, 170.0])
def test_a_crossing_car_yields_even_after_a_long_wait(scene: Make, waited_s: float) -> None:
    here = scene("priority")
    here.put("side", "S_in_0", 1.0, "N_out", wait_s=waited_s)
    here.put("main", "W_in_0", 60.0, "E_out", speed=11.0)  # the car reaches its line in 5.5 s
    times = here.entries(25.0)
    assert set(times) == {"side", "main"}
    assert times["main"] < times["side"]


def test_an_impatient_driver_does_not_enter_before_a_foe_that_cannot_brake(scene: Make) -> None:
    here = scene("priority")
    here.put("side", "S_in_0", 1.0, "N_out", wait_s=10_000.0)
    here.put("main", "W_in_0", 12.0, "E_out", speed=13.0)
    times = here.entries(10.0)
    assert times["main"] < times["side"]


def test_a_left_turn_yields_to_oncoming_traffic(scene: Make) -> None:
    here = scene("priority")
    here.put("left", "W_in_0", 20.0, "N_out", speed=10.0)
    here.put("straight", "E_in_0", 30.0, "W_out", speed=13.0)
    times = here.entries(15.0)
    assert times["straight"] < times["left"]


def test_the_car_from_the_right_goes_first_on_equal_roads(scene: Make) -> None:
    here = scene("right_before_left")
    here.put("west", "W_in_0", 30.0, "E_out", speed=10.0)
    here.put("south", "S_in_0", 30.0, "N_out", speed=10.0)
    times = here.entries(15.0)
    assert times["south"] < times["west"], "the car from the left went first"


def test_four_cars_that_arrive_at_once_on_equal_roads_all_pass(scene: Make) -> None:
    here = scene("right_before_left")
    ways = {"W": "E", "E": "W", "S": "N", "N": "S"}
    for arm, goal in ways.items():
        here.put(arm, f"{arm}_in_0", 30.0, f"{goal}_out", speed=10.0)
    assert here.entries(40.0).keys() == set(ways)


def test_a_car_stops_at_a_stop_sign_without_other_traffic(scene: Make) -> None:
    here = scene("priority_stop")
    here.put("side", "S_in_0", 40.0, "N_out", speed=12.0)
    slowest = np.inf
    stood = 0.0
    for _ in here.run(20.0):
        lane = here.simulation.network.lane_ids[here["side"]["lane"]]
        if lane == "S_in_0":
            slowest = min(slowest, float(here["side"]["speed"]))
            stood = max(stood, float(here["side"]["wait_s"]))
    assert slowest < 0.1, "the car did not stop (below 0.1 m/s, as in SUMO)"
    assert stood >= 0.1
    assert here.simulation.network.lane_ids[here["side"]["lane"]] != "S_in_0", (
        "the car did not go on"
    )


def test_an_all_way_stop_lets_cars_through_one_by_one(scene: Make) -> None:
    here = scene("allway_stop")
    ways = {"W": "E", "E": "W", "S": "N", "N": "S"}
    for k, (arm, goal) in enumerate(ways.items()):
        here.put(arm, f"{arm}_in_0", 30.0 + 10.0 * k, f"{goal}_out", speed=10.0)
    slowest = dict.fromkeys(ways, np.inf)
    lanes = here.simulation.network.lane_ids
    passed = set()
    for _ in here.run(45.0):
        for car in here.simulation.vehicles():
            arm = here.names[car["id"]]
            if lanes[car["lane"]] == f"{arm}_in_0":
                slowest[arm] = min(slowest[arm], float(car["speed"]))
            else:
                passed.add(arm)
    assert passed == set(ways)
    assert max(slowest.values()) < 0.1, "a car did not stop"


def shown(here: Scene, link: int) -> str:
    """Return the letter that the signal shows for a link."""
    network = here.simulation.network
    row = network.links[link]
    phase = network.phases[here.simulation.signal_phases()[row["signal"]]]
    return "rugGysoOY"[network.phase_states[phase["first_state"] + row["signal_index"]]]


def test_a_car_stops_at_red_before_the_line_and_goes_at_green(scene: Make) -> None:
    here = scene("traffic_light")
    network = here.simulation.network
    for arm, goal in (("W", "E_out"), ("S", "N_out")):
        here.put(arm, f"{arm}_in_0", 60.0, goal, speed=13.0)
    links = {
        arm: int(here.simulation.plans[here[arm]["goal"], here[arm]["lane"]]["link"])
        for arm in ("W", "S")
    }
    stood = set()
    crossed: dict[str, str] = {}
    for _ in here.run(100.0):
        for car in here.simulation.vehicles():
            arm = here.names[car["id"]]
            if network.lane_ids[car["lane"]] == f"{arm}_in_0":
                front = float(network.lanes[car["lane"]]["length_m"] - car["s"] - 2.5)
                if car["wait_s"] > 1.0 and shown(here, links[arm]) == "r":
                    stood.add(arm)
                    assert 0.0 < front < 3.0
            elif arm not in crossed:
                crossed[arm] = shown(here, links[arm])
    assert stood, "no car stopped at red"
    assert set(crossed) == {"W", "S"}
    assert set(crossed.values()) <= set("gG")


@pytest.mark.parametrize(("to_line_m", "goes"), [(8.0, True), (60.0, False)])
def test_a_car_goes_on_at_yellow_only_if_a_stop_would_be_hard(
    scene: Make, to_line_m: float, goes: bool
) -> None:
    here = scene("traffic_light")
    network = here.simulation.network
    here.put("probe", "W_in_0", 140.0, "E_out")
    link = int(here.simulation.plans[here["probe"]["goal"], here["probe"]["lane"]]["link"])
    # Run to the first tick of yellow, then place the car before the line.
    here.clear()
    for _ in here.run(200.0):
        if shown(here, link) == "y":
            break
    assert shown(here, link) == "y"
    here.put("car", "W_in_0", to_line_m, "E_out", speed=13.0)
    crossed_at = None
    for _ in here.run(8.0):
        on_arm = network.lane_ids[here["car"]["lane"]] == "W_in_0"
        if not on_arm and crossed_at is None:
            crossed_at = shown(here, link)
    assert (crossed_at == "y") == goes
    if not goes:
        assert crossed_at is None
        assert here["car"]["speed"] < 1.0


def test_no_car_enters_without_room_beyond_the_junction(scene: Make) -> None:
    here = scene("priority")
    network = here.simulation.network
    length = float(network.lanes[network.lane_ids.index("E_out_0")]["length_m"])
    # The car `block` always stands right behind the junction.
    here.put("block", "E_out_0", length - 9.0, "E_out", agent=0)
    here.simulation.vehicles()["driver"] = DRIVER_AGENT
    here.put("next", "W_in_0", 40.0, "E_out", speed=12.0)
    here.put("cross", "S_in_0", 60.0, "N_out", speed=10.0)
    lanes = network.lane_ids
    seen_cross = False
    for _ in here.run(25.0):
        vehicles = here.simulation.vehicles()
        vehicles["speed"][vehicles["id"] == here.names.index("block")] = 0.0
        assert lanes[here["next"]["lane"]] == "W_in_0", "the car entered the junction"
        crossing = vehicles[vehicles["id"] == here.names.index("cross")]
        seen_cross |= bool(len(crossing) and lanes[crossing[0]["lane"]] == "N_out_0")
    assert seen_cross, "the crossing car did not pass"


def test_a_left_turn_waits_inside_until_oncoming_traffic_has_passed(scene: Make) -> None:
    here = scene("traffic_light")
    network = here.simulation.network
    here.put("probe", "W_in_0", 140.0, "N_out")
    step = here.simulation.plans[here["probe"]["goal"], here["probe"]["lane"]]
    link = int(step["link"])
    wait_m = float(network.links[link]["wait_m"])
    assert np.isfinite(wait_m), "this turn has no waiting position"
    here.clear()
    for _ in here.run(200.0):
        if shown(here, link) == "g":
            break
    assert shown(here, link) == "g"
    here.put("left", "W_in_0", 10.0, "N_out", speed=8.0)
    for k in range(4):
        here.put(f"straight{k}", "E_in_0", 8.0 + 22.0 * k, "W_out", speed=11.0)
    waited, left_at, through_at = 0.0, np.inf, 0.0
    for time in here.run(25.0):
        for car in here.simulation.vehicles():
            name = here.names[car["id"]]
            lane = network.lanes[car["lane"]]
            edge = network.edge_ids[lane["edge"]]
            if name == "left":
                if lane["internal"] and car["speed"] < 0.1:
                    front = lane["link_offset_m"] + car["s"] + 2.5
                    assert wait_m - 2.0 < front < wait_m + 0.5
                    waited = max(waited, float(car["wait_s"]))
                if edge == "N_out":
                    left_at = min(left_at, time)
            elif edge != "W_out":
                through_at = time
        if left_at < np.inf:
            break
    assert waited > 1.0, "the car did not wait inside the junction"
    assert through_at < left_at < through_at + 8.0


def test_a_car_does_not_take_the_room_that_a_car_on_the_junction_needs(scene: Make) -> None:
    here = scene("priority")
    network = here.simulation.network
    length = float(network.lanes[network.lane_ids.index("E_out_0")]["length_m"])
    # Behind the car `block`, which always stands, there is room for one car.
    here.put("block", "E_out_0", length - 16.0, "E_out", agent=0)
    here.simulation.vehicles()["driver"] = DRIVER_AGENT
    here.put("first", "W_in_0", 15.0, "E_out", speed=10.0)
    here.put("second", "W_in_0", 30.0, "E_out", speed=10.0)
    lanes = network.lane_ids
    for _ in here.run(25.0):
        vehicles = here.simulation.vehicles()
        vehicles["speed"][vehicles["id"] == here.names.index("block")] = 0.0
        assert lanes[here["second"]["lane"]] == "W_in_0"
    assert lanes[here["first"]["lane"]] == "E_out_0", "the first car did not use the room"


def test_a_left_turn_inside_a_junction_ends_a_deadlock_by_going_before_a_blocked_foe(
    crossing: Callable[..., Path],
) -> None:
    """`left` yields to `cross`. `main` blocks `cross`, and `left` blocks `main`."""
    here = Scene(crossing("priority", side_lanes=2))
    network = here.simulation.network
    ends = {"left": ("W_in_0", "N_out_1"), "cross": ("N_in_0", "S_out_0")}
    link = {
        name: next(
            k
            for k, row in enumerate(network.links)
            if (network.lane_ids[row["from_lane"]], network.lane_ids[row["to_lane"]]) == end
        )
        for name, end in ends.items()
    }
    left, cross = (network.links[link[name]] for name in ends)
    conflicts = network.conflicts[left["first_conflict"] :][: left["num_conflicts"]]
    (shared,) = conflicts[conflicts["foe"] == link["cross"]]
    wait_m = float(left["wait_m"])
    assert shared["enter_m"] < wait_m - 1.0 < shared["leave_m"], (
        "the waiting position is not in the shared area"
    )
    fronts = {"left": wait_m - 1.0, "cross": float(shared["foe_enter_m"]) - 1.0}
    for name, row in (("left", left), ("cross", cross)):
        lane = network.lanes[row["first_internal"]]
        to_end = float(lane["length_m"]) - fronts[name]
        goal = "N_out" if name == "left" else "S_out"
        inside = network.lane_ids[row["first_internal"]]
        here.put(name, inside, to_end, goal, wait_s=10.0, link=link[name])
    here.put("main", "E_in_0", 1.0, "W_out", wait_s=10.0)
    lanes, through = network.lane_ids, {}
    for time in here.run(25.0):
        for car in here.simulation.vehicles():
            if lanes[car["lane"]].split("_")[1] == "out":
                through.setdefault(here.names[car["id"]], time)
    assert list(through) == ["left", "cross", "main"]
    assert through["left"] < 10.0


def test_a_car_stops_before_a_vehicle_at_the_start_of_another_link(scene: Make) -> None:
    here = scene("priority")
    network = here.simulation.network
    link = next(
        row
        for row in network.links
        if (network.lane_ids[row["from_lane"]], network.lane_ids[row["to_lane"]])
        == ("W_in_0", "N_out_0")
    )
    inside = int(link["first_internal"])
    to_end = float(network.lanes["length_m"][inside]) - 2.5
    here.put("left", network.lane_ids[inside], to_end, "N_out", agent=0)
    here.simulation.vehicles()["driver"] = DRIVER_AGENT
    here.put("straight", "W_in_0", 40.0, "E_out", speed=13.0)
    assert here["left"]["s"] == 0.0
    for _ in here.run(6.0):
        vehicles = here.simulation.vehicles()
        left = vehicles["id"] == here.names.index("left")
        vehicles["speed"][left] = vehicles["s"][left] = 0.0  # the car always stands there
    assert here["straight"]["speed"] < 1.0


def test_links_from_one_lane_share_their_path_up_to_the_fork(
    crossing: Callable[[str], Path],
) -> None:
    network = read_network(crossing("priority"))
    for lane in np.flatnonzero(network.lanes["num_links"] > 1).tolist():
        row = network.lanes[lane]
        links = range(int(row["first_link"]), int(row["first_link"] + row["num_links"]))
        paths = {link: path_of(network, link) for link in links}
        for link in links:
            fork = float(network.links[link]["fork_m"])
            assert 0.0 < fork < network.links[link]["length_m"]
            others = np.concatenate([paths[k][:, 1:] for k in links if k != link])
            s, xy = paths[link][:, 0], paths[link][:, 1:]
            apart = np.hypot(*(xy[:, None] - others[None]).transpose(2, 0, 1)).min(axis=1)
            assert (apart[s < fork - 0.6] < 2.7).all(), (
                "paths before the fork are farther apart than two cars side by side"
            )
            beyond = apart[s > fork + 0.6]
            assert beyond[0] > 2.5


def test_vehicles_from_one_lane_do_not_touch_where_their_paths_meet_again(tmp_path: Path) -> None:
    net, routes = looping_turn(tmp_path)
    world = make_world(net, [routes], 320, 1, 0.1)
    network, commands = world.network, idle_commands(world)
    (first, second), (one, other) = network.links["fork_m"], network.conflicts
    assert not one["must_yield"]
    assert not other["must_yield"]
    assert one["enter_m"] > first + 10.0, "the shared area begins at the fork"
    assert other["enter_m"] > second + 5.0
    for _ in range(3200):
        world.step(commands)
        rows = world.vehicles()
        assert (rows["hit"] < 0).all()
        assert (rows["wait_s"] < 10.0).all()
    assert world.traffic_stats().arrived > 95


def path_of(network: RoadNetwork, link: int) -> NDArray[np.float64]:
    """Return points (s, x, y) of a link's path over its junction, 0.1 m apart."""
    rows, lane = [], int(network.links[link]["first_internal"])
    while network.lanes[lane]["internal"]:
        here = network.lanes[lane]
        for s in np.arange(0.0, here["length_m"], 0.1):
            x, y, *_ = lane_pose(network.points, here["first_point"], here["num_points"], s)
            rows.append((here["link_offset_m"] + s, x, y))
        lane = int(here["successor"])
    return np.array(rows)


@pytest.mark.parametrize("kind", ["priority", "right_before_left", "traffic_light"])
def test_crossing_vehicles_do_not_touch_vehicles_at_stop_lines(
    crossing: Callable[[str], Path], kind: str
) -> None:
    network = read_network(crossing(kind))
    for lane in np.flatnonzero(network.lanes["num_links"] > 0).tolist():
        row = network.lanes[lane]
        back = float(row["stop_back_m"])
        assert 0.0 <= back <= 8.0
        s = float(row["length_m"]) - back - 1.0 - 2.5
        x, y, _, cos, sin, _ = lane_pose(network.points, row["first_point"], row["num_points"], s)
        for link in range(len(network.links)):
            other = network.lanes[network.links[link]["from_lane"]]
            if other["edge"] == row["edge"]:
                continue
            path = path_of(network, link)
            for k in range(2, len(path) - 2, 5):
                heading = np.arctan2(*(path[k + 2] - path[k - 2])[:0:-1])
                assert not boxes_overlap(
                    x, y, cos, sin, 2.5, 1.0,
                    path[k, 1], path[k, 2], np.cos(heading), np.sin(heading), 2.5, 0.9,
                )  # fmt: skip


@pytest.mark.parametrize(("pace", "brakes"), [(9.0, False), (3.0, True)])
def test_a_yielding_driver_follows_a_faster_foe_and_waits_for_a_slower_one(
    scene: Make, pace: float, brakes: bool
) -> None:
    here = scene("priority")
    here.put("main", "W_in_0", -3.0, "E_out", speed=pace)
    here.put("side", "N_in_0", 8.0, "E_out", speed=6.0)
    slowest = min(float(here["side"]["speed"]) for _ in here.run(3.0))
    assert (slowest < 5.0) == brakes, (
        "the yielding car slowed down for the faster foe, or not for the slower one"
    )


@pytest.mark.parametrize(("place_m", "blocked"), [(74.0, True), (76.0, False)])
def test_a_vehicle_that_stands_far_beyond_the_junction_does_not_block_the_exit(
    place_m: float, blocked: bool
) -> None:
    # A slow queue fills the road between the junction and the standing car.
    roads, ways = network_of("merge"), travel("merge")
    link = next(
        k
        for k, row in enumerate(roads.links)
        if roads.lanes["length_m"][_beyond(roads, int(row["next_lane"]))] > 200.0
    )
    lane = _beyond(roads, int(roads.links[link]["next_lane"]))
    queue = [
        on_lane(roads, lane, 4.0 + 8.0 * k, ways, id=k, speed=2.0 * STANDING_MPS) for k in range(9)
    ]
    standing = on_lane(roads, lane, place_m, ways, id=98)
    before = on_lane(roads, int(roads.links[link]["from_lane"]), 5.0, ways, id=99, speed=10.0)
    rows = np.concatenate([*queue, standing, before])
    room = scratch(roads, len(rows))
    index_lanes(roads.arrays, ways, rows, len(rows), room)
    way = int(before[0]["way"])
    phase = np.zeros(len(roads.signals), dtype=np.int32)
    found = exit_blocked(roads.arrays, ways, rows, rows[-1], link, way, phase, room)
    assert found == blocked


def _beyond(roads: RoadNetwork, lane: int) -> int:
    """Return the first lane from `lane` on that is not inside a junction."""
    while roads.lanes["internal"][lane]:
        lane = int(roads.lanes["successor"][lane])
    return lane
