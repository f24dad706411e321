"""Divided worlds that are harmed on purpose, held step by step against the undivided one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cavmarl import CavVectorEnv, make_vec
from cavmarl.handoff.fault_injection.fault_plan import MESSAGES, Faults
from cavmarl.ownership.messages import Message, Record, Step
from cavmarl.ownership.trace import LOG, TraceEntry
from cavmarl.ownership.trace_check import TraceChecker
from cavmarl.ownership.transport import Rates
from cavmarl.verify.differences import Arrays, same_bytes, step_results

# Long ticks, so that a few of them are enough for many to go over borders.
QUICK: Mapping[str, Any] = {
    "clock.sim_dt_s": 0.2,
    "clock.ctrl_dt_s": 0.4,
    "zones.approach_ticks": 4,
}
BUSY: Mapping[str, Any] = {
    **QUICK,
    "population.mode": "respawn",
    "population.agents": 6,
    "population.background": 110,
}
NOISE: Mapping[str, Rates] = {kind: Rates(0.1, 0.1, 0.1, 0.1, 0.05) for kind in MESSAGES}
ROUGH = Faults(seed=5, messages=NOISE, crash_rate=0.002)
"""Anybody dies at any time, and messages are lost, late, doubled, out of order and damaged."""


class Checked:
    """A watcher that lets the trace checker judge all that happens.

    A STEP that is sent again has to say the same, too.
    """

    def __init__(self, deferral: int, lifetime: int = 16, is_direct: bool = False) -> None:
        self._checker = TraceChecker(deferral, lifetime, is_direct)
        self._sent: dict[tuple[int, int], bytes] = {}

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            self._checker.take(TraceEntry(LOG, record))

    def delivered(self, destination: int, message: Message) -> None:
        self._checker.take(TraceEntry(destination, message))
        if isinstance(message, Step):
            for vehicle, _, forced, _, state in message.enter:
                if forced:
                    told = self._sent.setdefault((message.tick, vehicle), state)
                    assert told == state, f"vehicle {vehicle} on its way to tick {message.tick}"


@dataclass
class Recorded:
    """An undivided run: what was done, and what came of it after each step, the reset first."""

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
    """The undivided run under the built-in driver."""
    plain = {k: v for k, v in settings.items() if not k.startswith("zones.")}
    vec = make_vec(env, num_envs=worlds, overrides=plain)
    found = Recorded(env, dict(settings), worlds, seed)
    found.note(vec, {"observations": vec.reset(seed=seed)[0]})
    for _ in range(steps):
        actions = vec.suggest_actions().copy()
        found.actions.append(actions)
        found.note(vec, step_results(vec.step(actions), actions))
    return found


def replay(
    run: Recorded,
    zones: int,
    faults: Faults | None = None,
    settings: Mapping[str, Any] | None = None,
    watchers: Sequence[Any] = (),
) -> CavVectorEnv:
    """Drive a divided world through the same run; it is the same after every step.

    The trace of each world is checked, too, and hand-overs happen.
    """
    wanted = run.settings | dict(settings or {})
    if faults is not None:
        wanted["zones.faults"] = faults.to_json()
    vec = make_vec(run.env, num_envs=run.worlds, zones=zones, overrides=wanted)
    for coordinator in vec.simulation.coordinators:
        deadlines = vec.simulation.config.zones
        longest = deadlines.max_deferred_ticks
        coordinator.watch(Checked(longest, is_direct=faults is None))
        for watcher in watchers:
            coordinator.watch(watcher)
    follow(run, vec)
    assert vec.simulation.migrations > 0
    return vec


def follow(run: Recorded, vec: CavVectorEnv) -> None:
    """The run again in other worlds; they are the same after every step."""
    same(run, vec, 0, {"observations": vec.reset(seed=run.seed)[0]})
    for step, actions in enumerate(run.actions, start=1):
        same(run, vec, step, step_results(vec.step(actions), actions))


def same(run: Recorded, vec: CavVectorEnv, step: int, results: Arrays) -> None:
    assert [vec.state_hash(w) for w in range(run.worlds)] == run.hashes[step], f"step {step}"
    assert same_bytes(run.results[step], results), f"step {step}"
