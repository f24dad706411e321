"""Running the episodes of an evaluation: one world each, stepped together."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.errors import ConfigError
from cavmarl.evaluate.manifest import make_manifest
from cavmarl.evaluate.report import EvaluationReport, Speed, make_report
from cavmarl.evaluate.statistics import TripRecorder, Trips
from cavmarl.policies import NetworkPolicy, Policy, load_policy
from cavmarl.vector_env import CavVectorEnv
from cavmarl.worlds import load_world

__all__ = ["evaluate"]

MAX_EPISODES = 10_000
MAX_VEHICLES = 2_000_000  # all worlds are in memory at once

Progress = Callable[[int, int], None]


def evaluate(
    env: str | Path,
    policy: str | Path,
    *,
    episodes: int = 32,
    seed: int = 0,
    agents: int | None = None,
    background: int | None = None,
    max_cycles: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> EvaluationReport:
    """Let a policy drive `episodes` seeded episodes of an environment, each counted once.

    Episode e is the first episode of world e of `seed`, whichever policy drives: policies that are
    evaluated with equal arguments meet equal traffic.

    Args:
        env: as in `make_vec`, like the other keywords that are not explained here.
        policy: as in `load_policy`.
        episodes: how many.
        seed: root of all random numbers, also the policy's.
        agents: shadows population.agents.
        background: shadows population.background.
        max_cycles: shadows horizon_s.
        overrides: values for any other key.
        progress: called after every step with its number and with the most there can be.

    Raises:
        ConfigError: a number or a key that cannot work, or more than `MAX_VEHICLES` agents and
            background vehicles in all episodes together.
        PolicyError: the policy cannot be loaded or does not fit.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int):
        raise ConfigError(f"episodes = {episodes!r}: must be a whole number")
    if not 1 <= episodes <= MAX_EPISODES:
        raise ConfigError(f"episodes = {episodes}: must be from 1 to {MAX_EPISODES}")
    config, network, demand = load_world(
        env,
        agents=agents,
        background=background,
        max_cycles=max_cycles,
        overrides=overrides,
    )
    vehicles = config.population.agents + config.population.background
    if episodes * vehicles > MAX_VEHICLES:
        raise ConfigError(
            f"episodes = {episodes}: with {vehicles} vehicles each, {episodes * vehicles} in all; "
            f"at most {MAX_VEHICLES}: take at most {MAX_VEHICLES // vehicles} episodes"
        )
    vec = CavVectorEnv(config, network, episodes, demand)
    driver = load_policy(policy, vec)
    trips, returns, speed = _drive(vec, driver, seed, progress)
    manifest = make_manifest(
        vec.config,
        vec.network,
        policy=str(policy),
        weights=driver.weights_file if isinstance(driver, NetworkPolicy) else None,
        seed=seed,
        episodes=episodes,
    )
    return make_report(trips, returns, speed, manifest)


def _drive(
    vec: CavVectorEnv, driver: Policy, seed: int, progress: Progress | None
) -> tuple[Trips, NDArray[np.float64], Speed]:
    """The first episode of every world: its trips, returns (W,) as means over agents, and speed."""
    worlds = vec.num_envs
    observations, infos = vec.reset(seed=seed)
    driver.reset(seed)
    recorder = TripRecorder(worlds, vec.num_agents, vec.max_cycles, vec.step_s)
    returns = np.zeros(worlds)
    running = np.ones(worlds, dtype=np.bool_)
    policy_s = simulation_s = 0.0
    decisions = steps = 0
    while running.any():
        before = time.perf_counter()
        actions = driver.act_batch(observations, infos["mask"])
        between = time.perf_counter()
        observations, rewards, _, _, infos = vec.step(actions)
        after = time.perf_counter()
        if steps:  # the first step loads or compiles what the others use
            policy_s += between - before
            simulation_s += after - between
            decisions += int(infos["acted"].sum())
        acted = infos["acted"] & running[:, None]
        over = infos["episode_over"] & running
        returns += np.where(acted, rewards, 0.0).sum(axis=1)
        recorder.add(steps, acted, infos["terms"], infos["vehicle_done"] & acted, over)
        running &= ~over
        steps += 1
        if progress is not None:
            progress(steps, vec.max_cycles)
    timed = max((steps - 1) * worlds, 1)
    speed = Speed(
        step_ms=1e3 * simulation_s / timed,
        policy_ms=1e3 * policy_s / timed,
        agent_steps_per_s=decisions / max(policy_s + simulation_s, 1e-9),
        worlds=worlds,
    )
    return recorder.trips(), returns / vec.num_agents, speed
