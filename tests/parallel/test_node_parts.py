"""Sensors, messages, scenes and SUMO have the same results over nodes, even if a node is killed."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest

from cavmarl.env.vector import CavVectorEnv
from tests.parallel.test_nodes import over_nodes
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.sumo_worlds import MODES, write_stops
from tests.support.vec_runs import Make, drive, same

SMALL_RIG: dict[str, dict[str, Any]] = {
    "lidar": {"type": "lidar", "rate_hz": 10, "rays": 30, "z_m": 1.6},
    "picture": {"type": "rgb_camera", "rate_hz": 5, "z_m": 1.5, "width": 32, "height": 18},
    "wheels": {"type": "odometry", "rate_hz": 20},
}
WANTED: dict[str, Any] = {"agents": 8, "background": 30, "max_cycles": 8}


def lose_one(vec: CavVectorEnv, at: int) -> Callable[[int], None]:
    """Return a function that kills a node a random time after the start of a step."""
    worlds, drawn = over_nodes(vec), random.Random(at)

    def kill_in_step(step: int) -> None:
        if step == at:
            pid = drawn.choice(worlds.pool.pids)
            Timer(drawn.uniform(0.0, 0.01), os.kill, (pid, signal.SIGKILL)).start()

    return kill_in_step


@pytest.mark.parametrize("mode", ["ground_truth", "sensors"])
def test_sensors_over_nodes_give_the_samples_of_one_process(make: Make, mode: str) -> None:
    overrides = {"rig": "ten_sensors", "observation.mode": mode}
    wanted = {"agents": 5, "background": 60, "max_cycles": 8, "overrides": overrides}
    one = make("town", **wanted)
    whole = drive(one)
    vec = make("town", zones=4, nodes=2, **wanted)
    assert same(drive(vec, before=lose_one(vec, 7)), whole)
    assert over_nodes(vec).pool.recoveries == 1
    for name, frames in one.worlds.arrays.frames.items():
        for ours, theirs in zip(vec.worlds.arrays.frames[name], frames, strict=True):
            assert np.array_equal(ours, theirs), name
        assert frames.data.any(), name


def test_samples_follow_agents_to_another_node(make: Make) -> None:
    overrides = {"rig": SMALL_RIG, "observation.mode": "sensors"}
    wanted = {"agents": 12, "background": 4, "max_cycles": 25, "overrides": overrides}
    whole = drive(make("grid4x4", **wanted), steps=25)
    vec = make("grid4x4", zones=4, nodes=4, **wanted)
    assert same(drive(vec, steps=25), whole)
    assert over_nodes(vec).migrations > 0


def test_messages_between_vehicles_over_nodes_are_those_of_one_process(make: Make) -> None:
    overrides = {"v2x.enabled": True, "v2x.perception.rate_hz": 2.0}
    wanted = {**WANTED, "overrides": overrides}
    whole = drive(make("grid4x4", **wanted))
    vec = make("grid4x4", zones=4, nodes=3, **wanted)
    assert same(drive(vec, before=lose_one(vec, 6)), whole)
    assert over_nodes(vec).pool.recoveries == 1


def test_scripted_scenes_over_nodes_are_those_of_one_process(make: Make) -> None:
    wanted = {
        "agents": 1,
        "background": 10,
        "overrides": {"scenario.name": "unprotected_left_turn"},
    }
    whole = drive(make("grid4x4", **wanted), steps=40)
    vec = make("grid4x4", zones=4, nodes=3, **wanted)
    assert same(drive(vec, steps=40, before=lose_one(vec, 20)), whole)
    assert over_nodes(vec).pool.recoveries == 1


def test_vehicles_over_nodes_are_rerouted_as_in_one_process(make: Make, tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "population.mode": "respawn",
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
    }
    wanted = {"agents": 2, "background": 0, "max_cycles": 500, "overrides": overrides}
    one = make(net, **wanted)
    whole = drive(one, steps=300)
    vec = make(net, zones=3, nodes=2, **wanted)
    assert same(drive(vec, steps=300, before=lose_one(vec, 221)), whole)
    assert over_nodes(vec).pool.recoveries == 1
    assert one.traffic_stats()["rerouted"] > 0, "no vehicle has taken another route"


@pytest.mark.parametrize("source", MODES)
def test_worlds_with_sumo_over_nodes_are_those_of_one_process(
    make: Make, tmp_path: Path, source: str
) -> None:
    overrides = {
        "traffic.source": source,
        "traffic.demand": [str(path) for path in write_stops(tmp_path)],
        "sensors.signal.timing": False,
    }
    wanted = {"agents": 3, "background": 0, "max_cycles": 20, "overrides": overrides}
    whole = drive(make("merge", **wanted), steps=20)
    vec = make("merge", zones=2, nodes=2, **wanted)
    assert same(drive(vec, steps=20, before=lose_one(vec, 10)), whole)
    assert over_nodes(vec).pool.recoveries == 1
