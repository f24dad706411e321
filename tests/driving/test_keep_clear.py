"""Junctions are kept clear: a vehicle that would have to stop inside does not enter."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import parallel_env
from cavmarl.core.errors import MapError
from cavmarl.core.records.codes import (
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_RED,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.driving.kernels.junctions.junctions import exit_blocked
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.evaluate.traffic.native_side import idle_commands, make_world
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import make_plans
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.narrow_places import (
    signal_pair,
    signals_with_a_junction_between,
    turning_pair,
)
from tests.support.traffic import on_lane, scratch, travel_by


@pytest.mark.parametrize("apart_m", [18.0, 24.0, 32.0])
def test_opposing_left_turns_on_a_short_road_do_not_block_each_other(
    tmp_path: Path, apart_m: float
) -> None:
    net, routes = signal_pair(tmp_path, apart_m)
    world = make_world(net, [routes], 450, 1, 0.1)
    lanes, commands = world.network.lanes, idle_commands(world)
    for _ in range(4500):
        world.step(commands)
        rows = world.vehicles()
        assert (rows["hit"] < 0).all()
        inside = rows[lanes["internal"][rows["lane"]]]
        assert inside["wait_s"].max(initial=0.0) < 60.0
        assert rows["wait_s"].max(initial=0.0) < 150.0
    assert world.traffic_stats().arrived > 130


class Ahead(NamedTuple):
    """A vehicle before the first of two junctions, which will turn left at the second one."""

    network: RoadNetwork
    left_turns_from: int  # the lane between both junctions
    link: int  # the link that the vehicle takes next
    phase: NDArray[np.int32]


def ahead(
    folder: Path,
    light: int,
    *,
    may_block: bool = False,
    apart_m: float = 24.0,
    second: str = "traffic_light",
) -> Ahead:
    net, _ = signal_pair(folder, apart_m, second)
    if may_block:
        text = net.read_text()
        net.write_text(text.replace('from="sj"', 'keepClear="0" from="sj"'))
    network = read_network(net)
    lane = network.lane_ids.index("up_1")
    (link,) = np.flatnonzero(network.links["to_lane"] == lane)
    turn = network.links[network.lanes[lane]["first_link"]]
    phase = network.programs["first_phase"][network.signals["program"]].astype(np.int32)
    if light == SIGNAL_NONE:
        return Ahead(network, lane, int(link), phase)
    program = network.programs[network.signals["program"][turn["signal"]]]
    for at in range(program["num_phases"]):
        row = program["first_phase"] + at
        state = network.phases["first_state"][row] + turn["signal_index"]
        if network.phase_states[state] == light:
            phase[turn["signal"]] = row
            return Ahead(network, lane, int(link), phase)
    pytest.fail(f"no phase with {light}")


def is_blocked(scene: Ahead, *others: tuple[float, float, int], turns: bool = False) -> bool:
    """Return whether the vehicle must not enter the first junction.

    Args:
        scene: The vehicle and the junctions.
        others: Cars between the junctions as (s in m, speed in m/s, reason to stop).
        turns: Whether another car turns left inside the second junction.
    """
    network = scene.network
    goal = network.edge_ids.index("jw2")
    travel = travel_by(make_plans(network, [goal]))
    rows = [
        on_lane(network, scene.left_turns_from, s, travel, id=k, speed=speed, hold=hold)
        for k, (s, speed, hold) in enumerate(others)
    ]
    if turns:
        inside = network.links[network.lanes[scene.left_turns_from]["first_link"]]["next_lane"]
        rows.append(on_lane(network, int(inside), 1.0, travel, id=8))
    before = int(network.links[scene.link]["from_lane"])
    rows.append(on_lane(network, before, 280.0, travel, id=9, speed=8.0))
    table = np.concatenate(rows)
    room = scratch(network, len(table))
    index_lanes(network.arrays, travel, table, len(table), room)
    row = table[-1]
    way = int(row["way"])
    return exit_blocked(network.arrays, travel, table, row, scene.link, way, scene.phase, room)


MOVING, WAITING = (8.0, 4.0, HOLD_NONE), (13.0, 4.0, HOLD_YIELD)


def test_a_full_road_is_blocked_if_its_vehicles_wait_at_the_next_line(tmp_path: Path) -> None:
    scene = ahead(tmp_path, SIGNAL_GREEN_MINOR)
    assert not is_blocked(scene)
    assert not is_blocked(scene, WAITING)
    assert is_blocked(scene, MOVING, WAITING)
    assert is_blocked(scene, (4.0, 4.0, HOLD_NONE), (13.0, 4.0, HOLD_SIGNAL))
    # These cars move on, but the ego vehicle has to expect that it must yield at the next line.
    assert is_blocked(scene, (4.0, 4.0, HOLD_NONE), (13.0, 8.0, HOLD_NONE))


def test_a_free_waiting_position_in_the_next_junction_counts_as_room(tmp_path: Path) -> None:
    # Two cars of 5 m, each with 3 m behind it, need 16 m. The road is 14 m long, and the next
    # waiting position is 2.4 m inside the junction.
    for light, taken, blocked in (
        (SIGNAL_GREEN_MINOR, False, False),
        (SIGNAL_GREEN_MINOR, True, True),
        (SIGNAL_YELLOW_MINOR, False, True),
        (SIGNAL_RED, False, True),
    ):
        scene = ahead(tmp_path, light, apart_m=22.0)
        assert is_blocked(scene, (8.0, 8.0, HOLD_NONE), turns=taken) == blocked


def test_a_driver_follows_moving_vehicles_to_a_line_without_a_signal(tmp_path: Path) -> None:
    """All vehicles yield at that line. As in SUMO, a waiting vehicle there keeps the driver out."""
    scene = ahead(tmp_path, SIGNAL_NONE, second="priority")
    turn = scene.network.links[scene.network.lanes[scene.left_turns_from]["first_link"]]
    assert chr(turn["state"]) == "m"
    assert not is_blocked(scene, (4.0, 4.0, HOLD_NONE), (13.0, 8.0, HOLD_NONE))
    assert is_blocked(scene, (4.0, 4.0, HOLD_NONE), WAITING)


def test_u_turns_at_both_ends_of_a_short_road_do_not_block_each_other(tmp_path: Path) -> None:
    """Each direction of the road has room for one vehicle; U-turns lead to the other direction."""
    net, routes = turning_pair(tmp_path)
    world = make_world(net, [routes], 1000, 1, 0.1)
    commands = idle_commands(world)
    for _ in range(10_000):
        world.step(commands)
        rows = world.vehicles()
        assert (rows["hit"] < 0).all()
        assert rows["wait_s"].max(initial=0.0) < 60.0
    assert world.traffic_stats().arrived == 60


@pytest.mark.parametrize(
    ("light", "blocked"),
    [(SIGNAL_RED, True), (SIGNAL_YELLOW_MINOR, True), (SIGNAL_GREEN_MINOR, False)],
)
def test_a_vehicle_does_not_enter_a_too_short_road_at_red_or_yellow(
    tmp_path: Path, light: int, blocked: bool
) -> None:
    # The vehicle is too long to wait on that road. At green, it does not have to wait there.
    assert is_blocked(ahead(tmp_path, light, apart_m=14.0)) == blocked


@pytest.mark.parametrize("is_crossed", [True, False])
def test_a_path_over_a_junction_that_no_path_meets_counts_as_room(
    tmp_path: Path, is_crossed: bool
) -> None:
    # Between the lines of two signals there are 4.8 m of road, and a path of 24 m over a junction.
    network = read_network(signals_with_a_junction_between(tmp_path, is_crossed))
    goal = network.edge_ids.index("jn")
    travel = travel_by(make_plans(network, [goal]))
    (link,) = np.flatnonzero(
        (network.links["from_lane"] == network.lane_ids.index("sj_0"))
        & (network.links["to_lane"] == network.lane_ids.index("jm_0"))
    )
    (last,) = np.flatnonzero(
        (network.links["from_lane"] == network.lane_ids.index("mj_0"))
        & (network.links["to_lane"] == network.lane_ids.index("jn_0"))
    )
    table = on_lane(network, network.lane_ids.index("sj_0"), 280.0, travel, speed=8.0)
    room = scratch(network, 1)
    index_lanes(network.arrays, travel, table, 1, room)
    phase = network.programs["first_phase"][network.signals["program"]].astype(np.int32)
    place = network.signals[network.links[last]["signal"]]
    program = network.programs[place["program"]]
    is_blocked_at = {}
    for at in range(program["num_phases"]):
        row = program["first_phase"] + at
        letter = network.phases["first_state"][row] + network.links[last]["signal_index"]
        phase[network.links[last]["signal"]] = row
        is_blocked_at[int(network.phase_states[letter])] = exit_blocked(
            network.arrays, travel, table, table[0], int(link), int(table[0]["way"]), phase, room
        )
    assert is_blocked_at[SIGNAL_RED] == is_crossed


def test_divided_worlds_equal_the_undivided_world_where_vehicles_wait_on_such_a_path(
    tmp_path: Path,
) -> None:
    net = signals_with_a_junction_between(tmp_path, is_crossed=False)
    text = re.sub(r'(<tlLogic id="j2"[^>]* offset=)"0"', r'\1"45"', net.read_text())
    net.write_text(text)  # the second signal is red while the first is green
    hashes: dict[int, list[str]] = {}
    for zones in (1, 2, 4):
        world = parallel_env(net, zones=zones, agents=2, background=16)
        with closing(world):
            world.reset(seed=1)
            lanes, num_waiting, hashes[zones] = world.network.lanes, 0, []
            between = world.network.links["from_lane"] == world.network.lane_ids.index("jm_0")
            for _ in range(300):
                world.step(world.suggest_actions())
                hashes[zones].append(world.state_hash())
                rows = world.worlds.simulation.vehicles()
                inside = lanes["internal"][rows["lane"]] & between[lanes["link"][rows["lane"]]]
                num_waiting += int((inside & (rows["wait_s"] > 1.0)).sum())
        assert num_waiting
    assert hashes[1] == hashes[2] == hashes[4]


def test_a_connection_can_allow_vehicles_to_block_the_junction(tmp_path: Path) -> None:
    scene = ahead(tmp_path, SIGNAL_GREEN_MINOR, may_block=True)
    assert scene.network.links[scene.link]["may_block"]
    assert not is_blocked(scene, MOVING, WAITING)


def test_keep_clear_must_be_a_truth_value(tmp_path: Path) -> None:
    net, _ = signal_pair(tmp_path)
    net.write_text(net.read_text().replace('from="sj"', 'keepClear="maybe" from="sj"'))
    with pytest.raises(MapError, match=re.escape("keepClear='maybe', must be true or false")):
        read_network(net)
