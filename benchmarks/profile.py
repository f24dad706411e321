"""Processor time of a step by the phases of the runtime."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import Annotated

import typer

from benchmarks.program import run
from benchmarks.stopwatch import Stopwatch
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Agents, Background, Seed, Settings, about, parse_settings
from cavmarl.env.vector import CavVectorEnv, make_vec

VIEW = "view"  # time outside all phases: decoding of actions, copies of results


def measure(
    env: Annotated[str, typer.Argument(help="Name, folder or map file of an environment.")],
    agents: Agents = None,
    background: Background = None,
    worlds: Annotated[int, about("Number of parallel worlds.")] = 16,
    steps: Annotated[int, about("Steps per turn.")] = 200,
    repeats: Annotated[int, about("Number of turns; the fastest counts.")] = 5,
    seed: Seed = 0,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure processor nanoseconds per vehicle and step, by phase.

    A world with stopwatches and a world without stopwatches run the same episodes in turn. The
    times of the stopwatches and of the built-in driver in the agents' seats are measured and
    subtracted.
    """
    check_range(steps=(steps, 1, 1_000_000), repeats=(repeats, 1, 1_000_000))
    overrides = parse_settings(settings)
    plain, timed = (
        make_vec(env, num_envs=worlds, agents=agents, background=background, overrides=overrides)
        for _ in range(2)
    )
    watch = Stopwatch()
    timed.simulation.instrument(watch.around)
    turns = []
    for number in range(repeats):
        say(f"measuring, {number + 1} of {repeats}")
        without = _drive(plain, watch, steps, seed)
        turns.append((_drive(timed, watch, steps, seed), without.ns, watch.phases()))
    best, _, phases = min(turns, key=lambda turn: turn[0].ns)
    phases[VIEW] = best.ns - sum(phases.values())
    share = 1.0 / best.vehicle_steps
    timed_ns, plain_ns = best.ns * share, min(without for _, without, _ in turns) * share
    vehicles, acting = best.vehicle_steps / steps, best.agent_steps / steps
    ticks = timed.config.clock.ticks_per_step
    return BenchmarkReport(
        f"{vehicles:,.0f} vehicles, {acting:,.0f} of them agents; {ticks} ticks per step",
        {"phase": "name", "ns per vehicle and step": "ns:,.0f", "share": "share:.1%"},
        [
            {"name": name, "ns": ns * share, "share": ns / best.ns}
            for name, ns in Counter(phases).most_common()
        ],
        notes=[
            f"sum: {timed_ns:,.0f} ns; a step without stopwatches: {plain_ns:,.0f} ns per vehicle; "
            f"the sum of the phases differs from that by {timed_ns / plain_ns - 1.0:+.1%}"
        ],
        facts={
            "vehicles": vehicles,
            "agents": acting,
            "ticks_per_step": ticks,
            "timed_ns": timed_ns,
            "plain_ns": plain_ns,
        },
    )


@dataclass(frozen=True)
class _Turn:
    ns: float  # time of steps
    vehicle_steps: int
    agent_steps: int


def _drive(vec: CavVectorEnv, watch: Stopwatch, steps: int, seed: int) -> _Turn:
    """Reset and run steps; decisions of the built-in drivers are not timed."""
    vec.reset(seed=seed)
    vec.step(vec.suggest_actions())
    watch.clear()
    ns = vehicle_steps = agent_steps = 0
    for _ in range(steps):
        actions = vec.suggest_actions()
        began = time.process_time_ns()
        acted = vec.step(actions)[4]["acted"]
        ns += time.process_time_ns() - began
        agent_steps += int(acted.sum())
        vehicle_steps += sum(len(vec.simulation.vehicles(w)) for w in range(vec.num_envs))
    watch.forget("suggest", "vehicles")
    return _Turn(ns - watch.own(), vehicle_steps, agent_steps)


if __name__ == "__main__":
    run(measure)
