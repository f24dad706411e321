"""Traffic of built-in drivers: no vehicle is lost, collides, breaks a rule or stands forever."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import CapacityError
from cavmarl.core.records.codes import DRIVER_BACKGROUND, SIGNAL_RED, SIGNAL_RED_YELLOW
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.engine.simulation import Simulation
from tests.support.driving import drive, make_simulation, make_traffic, start

# Environments, and a number of background vehicles that does not cause a jam.
FREE_FLOW = {"ring": 12, "merge": 14, "grid4x4": 40, "town": 40}
PER_TICK = {"clock.ctrl_dt_s": 0.05}


def minutes(simulation: Simulation, many: float) -> Iterator[int]:
    """Step the worlds for this number of minutes; yield the number of each step."""
    for step in range(round(many * 60.0 / simulation.config.clock.ctrl_dt_s)):
        drive(simulation)
        yield step


@pytest.mark.parametrize("env", FREE_FLOW)
@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
def test_no_vehicle_is_lost(env: str, mode: str) -> None:
    background = FREE_FLOW[env]
    simulation = make_simulation(env, mode=mode, agents=4, background=background, num_worlds=2)
    start(simulation, seed=3)
    for _ in minutes(simulation, 0.75):
        for world in range(2):
            stats = simulation.traffic_stats(world)
            assert stats.departed == stats.running + stats.arrived + stats.removed
            ids = simulation.vehicles(world)["id"]
            assert np.unique(ids).size == ids.size
            ordered = simulation.departures.next_id[world]
            assert ordered == stats.departed + stats.waiting, "a departure was dropped"
            if mode != "closed":
                drivers = simulation.vehicles(world)["driver"]
                waiting = simulation.departures.queue[world, : stats.waiting]
                here = np.count_nonzero(drivers == DRIVER_BACKGROUND)
                assert here + np.count_nonzero(waiting["agent"] < 0) == background


def test_departures_without_room_enter_later() -> None:
    simulation = make_traffic("merge", background=120)
    start(simulation, seed=0)
    first = set(simulation.departures.queue[0, : simulation.departures.num_queue[0]]["id"].tolist())
    assert len(first) > 20
    for _ in minutes(simulation, 1.0):
        queue = simulation.departures.queue[0, : simulation.departures.num_queue[0]]["id"]
        assert (np.diff(queue) > 0).all(), "the queue is not in the order of ids"
    assert len(first & set(queue.tolist())) < 0.75 * len(first)


def test_a_closed_world_without_room_for_its_agents_is_refused() -> None:
    simulation = make_simulation("ring", mode="closed", agents=90, background=0)
    with pytest.raises(CapacityError, match=r"population\.agents = 90.*free places for \d+"):
        start(simulation, seed=0)


@pytest.mark.parametrize(
    ("agents", "background", "words"),
    [
        (100, 20, r"is 20, the default.*--agents N\) to \d+ or less$"),
        (1, 60, r"the background is 60\).*--background N\) to \d+ or less$"),
        (100, 60, r"--agents N\) to \d+ or less and .*--background N\) to \d+ or less$"),
        (100, 0, r"--agents N\) to \d+ or less$"),
    ],
)
def test_the_error_for_a_full_map_names_the_keys_to_change(
    agents: int, background: int, words: str
) -> None:
    with pytest.raises(CapacityError, match=words):
        make_simulation("ring22", mode="closed", agents=agents, background=background)


@pytest.mark.parametrize(
    ("env", "agents", "background"),
    [("ring22", 100, 20), ("ring22", 1, 60), ("ring22", 12, 0), ("ring", 90, 20), ("ring", 90, 0)],
)
def test_a_population_with_the_numbers_of_the_error_has_room(
    env: str, agents: int, background: int
) -> None:
    with pytest.raises(CapacityError) as caught:
        start(make_simulation(env, mode="closed", agents=agents, background=background), seed=1)
    advised = dict(re.findall(r"\((agents|background)=N, --\w+ N\) to (\d+)", str(caught.value)))
    assert advised
    numbers = {"agents": agents, "background": background}
    numbers |= {name: int(number) for name, number in advised.items()}
    simulation = make_simulation(env, mode="closed", **numbers)
    for seed in range(50):
        start(simulation, seed)
        assert simulation.outputs.present.sum() == numbers["agents"]


@pytest.mark.parametrize("env", FREE_FLOW)
@pytest.mark.parametrize(
    ("seed", "worlds", "length"),
    [(0, 3, 3.0), (1, 3, 3.0), pytest.param(2, 12, 12.0, marks=pytest.mark.slow)],
)
def test_drivers_do_not_collide_or_stand_forever(
    env: str, seed: int, worlds: int, length: float
) -> None:
    simulation = make_traffic(env, background=FREE_FLOW[env], num_worlds=worlds)
    start(simulation, seed)
    longest = 0.0
    for _ in minutes(simulation, length):
        for world in range(worlds):
            vehicles = simulation.vehicles(world)
            touching = vehicles["id"][vehicles["hit"] >= 0].tolist()
            assert not touching, f"world {world}, tick {simulation.ticks()[world]}"
            longest = max(longest, float(vehicles["wait_s"].max()))
    assert longest < 120.0
    for world in range(worlds):
        assert simulation.traffic_stats(world).contacts == 0


@pytest.mark.parametrize("env", FREE_FLOW)
def test_drivers_drive_at_most_the_speed_limit_times_their_speed_factor(env: str) -> None:
    simulation = make_traffic(env, background=FREE_FLOW[env], num_worlds=2)
    start(simulation, seed=7)
    lanes = simulation.network.lanes
    ratios, roads = [], []
    for _ in minutes(simulation, 1.0):
        for world in range(2):
            vehicles = simulation.vehicles(world)
            lane = lanes[vehicles["lane"]]
            ratio = vehicles["speed"] / (lane["speed_mps"] * vehicles["speed_factor"])
            ratios.append(ratio)
            roads.append(~lane["internal"])
    ratio = np.concatenate(ratios)
    # After a lower limit begins, the speed decays towards it and stays a few per cent above it.
    assert ratio.max() < 1.05
    assert np.mean(ratio[np.concatenate(roads)] > 1.001) < 0.02
    assert ratio.max() > 0.9, "no vehicle drives at the limit on a free road"


@pytest.mark.parametrize("env", ["grid4x4", "town"])
def test_no_driver_passes_a_red_signal(env: str) -> None:
    simulation = make_traffic(env, background=60, num_worlds=2, overrides=PER_TICK)
    start(simulation, seed=2)
    roads, steps = simulation.network.arrays, simulation.travel.steps
    crossed = 0
    before: list[dict[int, tuple[int, float]]] = [{}, {}]
    for _ in minutes(simulation, 2.0):
        for world in range(2):
            phases = simulation.signal_phases(world)
            now = {}
            for row in simulation.vehicles(world):
                lane = roads.lanes[row["lane"]]
                link = -1 if lane["internal"] else int(steps[row["way"] + row["lane"]]["link"])
                front = row["s"] + 0.5 * row["length"]
                to_line = float(lane["length_m"] - lane["stop_back_m"] - front)
                now[int(row["id"])] = link, to_line
                earlier, earlier_m = before[world].get(int(row["id"]), (-1, 0.0))
                if link >= 0 and link == earlier and to_line <= 0.0 < earlier_m:
                    shown = link_signal(roads, link, phases)
                    assert shown not in (SIGNAL_RED, SIGNAL_RED_YELLOW), f"link {link}"
                    crossed += int(roads.links[link]["signal"] >= 0)
            before[world] = now
    assert crossed > 50


OVERPASS = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  <edge id="we" from="W" to="E">
    <lane id="we_0" index="0" speed="14" length="300" shape="-150,0,0 150,0,0"/>
  </edge>
  <edge id="sn" from="S" to="N">
    <lane id="sn_0" index="0" speed="14" length="300" shape="0,-150,{z} 0,150,{z}"/>
  </edge>
  <junction id="W" type="dead_end" x="-150" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="E" type="dead_end" x="150" y="0" incLanes="we_0" intLanes="" shape=""/>
  <junction id="S" type="dead_end" x="0" y="-150" incLanes="" intLanes="" shape=""/>
  <junction id="N" type="dead_end" x="0" y="150" incLanes="sn_0" intLanes="" shape=""/>
</net>
"""


@pytest.mark.parametrize(("z", "collide"), [(0.0, True), (7.0, False)])
def test_vehicles_on_a_bridge_and_below_do_not_interact(
    tmp_path: Path, z: float, collide: bool
) -> None:
    roads = tmp_path / "overpass.net.xml"
    roads.write_text(OVERPASS.format(z=z), encoding="utf-8")
    simulation = make_traffic(roads, background=24)
    start(simulation, seed=0)
    for _ in minutes(simulation, 2.0):
        pass
    stats = simulation.traffic_stats()
    assert stats.arrived > 20
    assert (stats.contacts > 0) == collide
