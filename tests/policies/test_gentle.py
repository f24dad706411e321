"""`ring22`: one agent among 21 human drivers, beside 22 human drivers."""

from __future__ import annotations

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import PolicyError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.policies.policy import load_policy
from cavmarl.shards.shard import Commands

STEPS, WARM = 1500, 375


def all_human() -> float:
    """Mean speed of 22 human drivers from 75 s on, in m/s."""
    world = load_world("ring22", agents=0, overrides={"traffic.demand": ["map/all_human.rou.xml"]})
    simulation = Simulation(world.config, world.network, demand=world.demand)
    simulation.seed(0)
    simulation.reset()
    idle = Commands(np.zeros((1, 0, 2)), np.zeros((1, 0), dtype=np.int64))
    speeds = []
    for _ in range(STEPS):
        simulation.step(idle)
        rows = simulation.vehicles()
        speeds.append(rows["speed"].mean())
    assert len(rows) == 22
    return float(np.mean(speeds[WARM:]))


def test_one_gentle_driver_raises_the_speed_of_all_by_more_than_flows_57_percent() -> None:
    vec = cavmarl.make_vec("ring22")
    policy = load_policy("gentle", vec)
    observations, infos = vec.reset(seed=0)
    policy.reset(0)
    speeds = []
    for _ in range(STEPS - 1):
        actions = policy.act_batch(observations, infos["mask"])
        observations, _, terminated, _, infos = vec.step(actions)
        assert not terminated.any()
        speeds.append(vec.worlds.simulation.vehicles(0)["speed"].mean())
    assert float(np.mean(speeds[WARM:])) > 1.57 * all_human()


def test_where_it_cannot_drive_it_says_so() -> None:
    with pytest.raises(PolicyError, match="gentle needs"):
        load_policy("gentle", cavmarl.make_vec("ring"))
