"""Checks that PPO learns, on a crossing without signals.

First, an agent alone learns to reach its goal. Second, two agents learn not to collide, while
drivers that were trained alone collide.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cavmarl.config.terms import TERMS
from cavmarl.env.vector import make_vec
from cavmarl.policies.loading import load_policy

pytest.importorskip("torch")
SCRIPT = Path(__file__).resolve().parents[2] / "train" / "ppo.py"
CROSSING = Path(__file__).with_name("crossing")
WORLDS = 64
ARRIVAL, COLLISION = TERMS.index("arrival"), TERMS.index("collision")


@pytest.fixture(scope="module")
def ippo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ppo", SCRIPT)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def learn(ippo: ModuleType, folder: Path, agents: int, agent_steps: int) -> Path:
    """Train a driver from random weights, without imitation."""
    words = ["--env", str(CROSSING), "--agents", str(agents), "--num-envs", str(64 // agents)]
    words += ["--total-agent-steps", str(agent_steps), "--hidden", "32"]
    words += ["--throttle-std", "0.4"]
    words += ["--runs", str(folder), "--name", f"agents_{agents}", "--minibatches", "16"]
    assert ippo.main(words) == 0
    return folder / f"agents_{agents}"


def ends(driver: Path, agents: int) -> tuple[float, float]:
    """Run an episode in many worlds; return the shares of trips that arrive and that collide."""
    vec = make_vec(CROSSING, num_envs=WORLDS, agents=agents, seed=1)
    policy = load_policy(driver, vec)
    observations, infos = vec.reset()
    trips = arrivals = collisions = 0
    for _ in range(vec.max_cycles):
        actions = policy.act_batch(observations, infos["mask"])
        observations, _, _, _, infos = vec.step(actions)
        done = infos["vehicle_done"] & infos["acted"]
        trips += int(done.sum())
        arrivals += int(np.count_nonzero(infos["terms"][done][:, ARRIVAL]))
        collisions += int(np.count_nonzero(infos["terms"][done][:, COLLISION]))
    return arrivals / trips, collisions / trips


def test_an_agent_alone_learns_to_reach_its_goal(ippo: ModuleType, tmp_path: Path) -> None:
    """This is the short variant of the next test."""
    assert ends(learn(ippo, tmp_path, agents=1, agent_steps=120_000), agents=1)[0] > 0.9


@pytest.mark.slow
def test_two_agents_learn_to_avoid_collisions(ippo: ModuleType, tmp_path: Path) -> None:
    alone = learn(ippo, tmp_path, agents=1, agent_steps=400_000)
    assert ends(alone, agents=1)[0] > 0.98
    reckless = ends(alone, agents=2)[1]
    assert reckless > 0.05
    together = learn(ippo, tmp_path, agents=2, agent_steps=3_000_000)
    arrived, collided = ends(together, agents=2)
    assert arrived > 0.98
    assert collided < 0.2 * reckless
