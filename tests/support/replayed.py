"""Compare divided worlds step by step with a recorded run of the undivided world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cavmarl import CavVectorEnv, make_vec
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Record
from cavmarl.ownership.trace import LOG, TraceEntry
from cavmarl.ownership.trace_check import TraceChecker
from cavmarl.verify.differences import Arrays, same_bytes, step_results

# Long ticks, so that many vehicles cross borders in few ticks.
QUICK: Mapping[str, Any] = {
    "clock.sim_dt_s": 0.2,
    "clock.ctrl_dt_s": 0.4,
    "zones.approach_ticks": 4,
}
BUSY: Mapping[str, Any] = {
    **QUICK, "population.mode": "respawn", "population.agents": 6, "population.background": 110,
}  # fmt: skip


class Checked:
    """A watcher that passes all records to the trace checker."""

    def __init__(self) -> None:
        limits = Limits()
        self._checker = TraceChecker(limits.deferral, limits.lifetime, is_direct=True)

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            self._checker.take(TraceEntry(LOG, record))


@dataclass
class Recorded:
    """The actions of an undivided run, and its results after the reset and after each step."""

    env: str | Path
    settings: dict[str, Any]
    worlds: int
    seed: int
    actions: list[NDArray[Any]] = field(default_factory=list)
    results: list[Arrays] = field(default_factory=list)
    hashes: list[list[str]] = field(default_factory=list)

    def note(self, vec: CavVectorEnv, results: Arrays) -> None:
        self.results.append({name: array.copy() for name, array in results.items()})
        self.hashes.append([vec.state_hash(w) for w in range(self.worlds)])


def record(
    env: str | Path, settings: Mapping[str, Any], steps: int, seed: int = 0, worlds: int = 1
) -> Recorded:
    """Record an undivided run with the built-in driver."""
    plain = {k: v for k, v in settings.items() if not k.startswith("zones.")}
    vec = make_vec(env, num_envs=worlds, overrides=plain)
    found = Recorded(env, dict(settings), worlds, seed)
    found.note(vec, {"observations": vec.reset(seed=seed)[0]})
    for _ in range(steps):
        actions = vec.suggest_actions().copy()
        found.actions.append(actions)
        found.note(vec, step_results(vec.step(actions), actions))
    return found


def replay(run: Recorded, zones: int, settings: Mapping[str, Any] | None = None) -> CavVectorEnv:
    """Repeat a recorded run in a divided world; check that both are equal after each step.

    Check also the ownership trace of each world, and that vehicles have changed their zones.
    """
    wanted = run.settings | dict(settings or {})
    vec = make_vec(run.env, num_envs=run.worlds, zones=zones, overrides=wanted)
    for coordinator in vec.simulation.coordinators:
        coordinator.watch(Checked())
    follow(run, vec)
    assert vec.simulation.migrations > 0
    return vec


def follow(run: Recorded, vec: CavVectorEnv) -> None:
    """Repeat a recorded run in other worlds; check that both are equal after each step."""
    same(run, vec, 0, {"observations": vec.reset(seed=run.seed)[0]})
    for step, actions in enumerate(run.actions, start=1):
        same(run, vec, step, step_results(vec.step(actions), actions))


def same(run: Recorded, vec: CavVectorEnv, step: int, results: Arrays) -> None:
    assert [vec.state_hash(w) for w in range(run.worlds)] == run.hashes[step], f"step {step}"
    assert same_bytes(run.results[step], results), f"step {step}"
