"""Effect of one driver among 21 human drivers: the mean speed on `ring22`.

The measure is that of Flow (Wu et al. 2017): the mean speed of all 22 cars after stop-and-go waves
have formed, compared with the mean speed of 22 human drivers.
"""

from __future__ import annotations

from contextlib import closing
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

import cavmarl
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Seed, about
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.built_in_runs import DrivenWorld
from cavmarl.policies.loading import driver_keys, load_policy, policy_files

ENV = "ring22"
HUMAN = "human"  # one more human driver in the agent's seat
ALL_HUMAN = {"traffic.demand": ["map/all_human.rou.xml"]}


def measure(
    policy: Annotated[
        list[str] | None, typer.Option("--policy", "-p", help="Policy of the agent; repeatable.")
    ] = None,
    episodes: Annotated[int, about("Episodes per policy.")] = 8,
    after_s: Annotated[int, about("Seconds of each episode to leave out.")] = 75,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the mean speed of all cars of `ring22` for different drivers of one car.

    Episodes differ in the agent's starting position. Episodes with a crash have no mean speed.
    """
    check_range(episodes=(episodes, 1, 1000), after_s=(after_s, 0, 299))
    say(HUMAN)
    rows = [_row(HUMAN, np.array([human_mps(after_s)]), None)]
    for name in policy or ["gentle"]:
        say(name)
        rows.append(_row(name, driver_mps(name, episodes, after_s, seed), rows[0]["mean"]))
    return BenchmarkReport(
        "mean speed of all cars of ring22",
        {
            "driver": "driver",
            "m/s": "mean:.2f",
            "least": "least:.2f",
            "most": "most:.2f",
            "over human, %": "gain:+.0f",
            "crashed": "crashed",
        },
        rows,
        notes=[f"from {after_s} s to the end; {episodes} episodes; humans are deterministic"],
    )


def _row(name: str, means: NDArray[np.float64], base: float | None) -> dict[str, Any]:
    ended = means[np.isfinite(means)]
    row = {"driver": name, "crashed": len(means) - len(ended), "means_mps": means.tolist()}
    if len(ended):
        row |= {
            "mean": float(ended.mean()),
            "least": float(ended.min()),
            "most": float(ended.max()),
        }
        row["gain"] = None if base is None else 100.0 * (row["mean"] / base - 1.0)
    return row


def human_mps(after_s: float) -> float:
    """Return the mean speed of 22 human drivers, whose model has no random numbers."""
    world = load_world(ENV, agents=0, overrides=ALL_HUMAN)
    simulation = Simulation(world.config, world.network, demand=world.demand)
    simulation.seed(0)
    simulation.reset()
    driven = DrivenWorld(simulation)
    steps, first = _steps(simulation, after_s)
    speeds = []
    for _ in range(steps):
        driven.step(driven.commands())
        speeds.append(simulation.vehicles()["speed"].mean())
    return float(np.mean(speeds[first:]))


def driver_mps(name: str, episodes: int, after_s: float, seed: int) -> NDArray[np.float64]:
    """Return the mean speed of all 22 cars per episode with this driver; nan after a crash."""
    is_trained = len(policy_files(name)) > 1  # a trained policy defines its sensors and actions
    keys = driver_keys(name) if is_trained else {}
    vec = cavmarl.make_vec(ENV, num_envs=episodes, overrides=keys)
    with closing(vec):
        policy = load_policy(name, vec)
        observations, infos = vec.reset(seed=seed)
        policy.reset(seed)
        steps, first = _steps(vec.worlds.simulation, after_s)
        sums, crashed = np.zeros(episodes), np.zeros(episodes, dtype=bool)
        for step in range(steps - 1):  # the last step restarts all agents
            actions = policy.act_batch(observations, infos["mask"])
            observations, _, ended, _, infos = vec.step(actions)
            crashed |= ended.any(1)
            if step >= first:
                sums += [vec.worlds.simulation.vehicles(k)["speed"].mean() for k in range(episodes)]
    return np.where(crashed, np.nan, sums / (steps - 1 - first))


def _steps(simulation: Simulation, after_s: float) -> tuple[int, int]:
    """Return the steps of an episode, and the number of steps before this time."""
    step_s = simulation.config.clock.ctrl_dt_s
    return round(simulation.config.horizon_s / step_s), round(after_s / step_s)


if __name__ == "__main__":
    run(measure)
