"""Where the processor's time of a step goes, by the phases that the runtime names."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from cavmarl.bench.stopwatch import Stopwatch
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv

__all__ = ["StepProfile", "profile_step"]

VIEW = "view"  # actions checked and decoded, results copied: what is no phase


@dataclass(frozen=True)
class StepProfile:
    """Result of `profile_step`; times in ns a vehicle and step.

    Attributes:
        vehicles: mean over the steps, all worlds together.
        agents: those of them that acted.
        ticks_per_step: how often the phases of a tick ran.
        phases: by name, the largest first; `view` is what is no phase.
        timed_ns: a step with a stopwatch on every phase, less its own time: the sum of the phases.
        plain_ns: a step without one.
    """

    vehicles: float
    agents: float
    ticks_per_step: int
    phases: dict[str, float]
    timed_ns: float
    plain_ns: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def profile_step(
    make: Callable[[], CavVectorEnv], steps: int = 200, seed: int = 0, repeats: int = 5
) -> StepProfile:
    """Drive agents by the built-in driver, whose own time does not count, and time the steps.

    A world with stopwatches and one without go the same ways, by turns; the fastest turn of each
    counts. What the stopwatch takes itself is measured before and taken off.

    Args:
        make: a new world.
        steps: a turn.
        seed: of every turn.
        repeats: turns.

    Raises:
        ConfigError: a number out of range.
    """
    for name, value in (("steps", steps), ("repeats", repeats)):
        if not 1 <= value <= 1_000_000:
            raise ConfigError(f"{name} = {value}: must be from 1 to 1000000")
    watch = Stopwatch()
    plain, timed = make(), make()
    timed.simulation.instrument(watch.around)
    turns = []
    for _ in range(repeats):
        without = _drive(plain, watch, steps, seed)
        turns.append((_drive(timed, watch, steps, seed), without.ns, watch.phases()))
    best, _, phases = min(turns, key=lambda turn: turn[0].ns)
    phases[VIEW] = best.ns - sum(phases.values())
    share = 1.0 / best.vehicle_steps
    return StepProfile(
        vehicles=best.vehicle_steps / steps,
        agents=best.agent_steps / steps,
        ticks_per_step=timed.config.clock.ticks_per_step,
        phases={name: ns * share for name, ns in Counter(phases).most_common()},
        timed_ns=best.ns * share,
        plain_ns=min(without for _, without, _ in turns) * share,
    )


@dataclass(frozen=True)
class _Turn:
    ns: float  # in steps alone
    vehicle_steps: int
    agent_steps: int


def _drive(vec: CavVectorEnv, watch: Stopwatch, steps: int, seed: int) -> _Turn:
    """Step from a reset, with the built-in driver in all seats; nothing else is timed."""
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
