"""Turns of one world in zones, without a stopwatch and with a stopwatch on every phase.

A turn is run in parts, interleaved with parts of other worlds, so that other load on the machine
affects all worlds equally.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from benchmarks.stopwatch import Stopwatch
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.built_in_runs import DrivenWorld
from cavmarl.zones.partition.zone_statistics import imbalance

__all__ = ["PHASES", "Pair", "Turn", "TwinWorlds"]

PHASES = ("traffic", "advance", "exchange", "resolve", "migrate", "sense", "other")
# Phases of calls of the runtime that are not named like their phase; other calls are `other`.
_MEMBERS = {
    "traffic": (
        "choose_goals", "leave", "settle",
        "call_orders", "rank_lanes", "assign_lanes", "propose", "running", "accept", "admit",
        "retire", "forget",
    ),
    "migrate": ("begin", "end", "left", "entered"),
    "sense": ("clear_outputs", "settle_outputs", "credit"),
}  # fmt: skip
_PHASE_OF = {phase: phase for phase in PHASES} | {
    name: phase for phase, names in _MEMBERS.items() for name in names
}


@dataclass(frozen=True)
class Turn:
    """Sums over the steps of a turn of one world, or of a part of a turn."""

    ns: float  # time of the steps
    steps: int  # number of steps
    vehicles: int  # vehicles in the world
    ghosts: int  # ghosts in all zones
    imbalance: float  # maximum / mean of the vehicles that zones own
    largest: int  # rows of the fullest zone
    moves: tuple[int, ...]  # vehicles that changed their zone, per step
    move_ns: tuple[int, ...]  # time of the phase `migrate`, per step; 0 without a stopwatch


@dataclass(frozen=True)
class Pair:
    """One turn of the worlds of a `TwinWorlds`; times are in ns per vehicle and tick."""

    plain: Turn  # world without a stopwatch
    timed: Turn  # world with a stopwatch
    plain_ns: float  # without a stopwatch
    timed_ns: float  # with a stopwatch, minus the stopwatch's own time
    checked_ns: float | None  # with the monitor of invariants; None: not measured
    phases: dict[str, float]  # times by the names of `PHASES`; their sum is `timed_ns`
    calls: dict[str, float]  # times by the names of the runtime's calls


class TwinWorlds:
    """A world in a number of zones, twice: without and with a stopwatch.

    Args:
        make: creates the world in k zones, at the start of an episode.
        zones: number of zones, k.
        make_checked: creates the same world with the monitor of invariants; None: not measured.

    Attributes:
        zones: number of zones.
        plain: the world without a stopwatch.
        timed: the world with a stopwatch.
        checked: the world with the monitor; None: not requested, or undivided.
    """

    def __init__(
        self,
        make: Callable[[int], Simulation],
        zones: int,
        make_checked: Callable[[int], Simulation] | None = None,
    ) -> None:
        self.zones = zones
        self.plain, self.timed = DrivenWorld(make(zones)), DrivenWorld(make(zones))
        self._watch = Stopwatch()
        self.timed.simulation.instrument(self._watch.around)
        self.checked: DrivenWorld | None = None
        if make_checked is not None and zones > 1:
            self.checked = DrivenWorld(make_checked(zones))
        self._parts: list[list[Turn]] = [[] for _ in self.worlds]

    @property
    def worlds(self) -> list[DrivenWorld]:
        return [self.plain, self.timed, *([] if self.checked is None else [self.checked])]

    def run(self, number: int, steps: int) -> None:
        """Run the next steps of one of `worlds`; they belong to the present turn."""
        if not any(self._parts):
            self._watch.clear()
        self._parts[number].append(_run(self.worlds[number], steps, self._watch))

    def end_turn(self) -> Pair:
        """End the present turn and return its result; the next turn begins."""
        plain, timed, *checked = (_joined(parts) for parts in self._parts)
        watch = self._watch
        watch.forget("suggest", "loads")
        if not plain.vehicles:
            raise ConfigError("no vehicle drives: change --after, or add demand")
        share = 1.0 / (plain.vehicles * self.plain.simulation.config.clock.ticks_per_step)
        timed_ns = (timed.ns - watch.own()) * share
        calls = {name: ns * share for name, ns in sorted(watch.phases().items())}
        phases = dict.fromkeys(PHASES, 0.0)
        for name, ns in calls.items():
            phases[_PHASE_OF.get(name, "other")] += ns
        phases["other"] += timed_ns - sum(phases.values())
        checked_ns = checked[0].ns * share if checked else None
        for parts in self._parts:
            parts.clear()
        return Pair(plain, timed, plain.ns * share, timed_ns, checked_ns, phases, calls)


def _joined(parts: Sequence[Turn]) -> Turn:
    """Return the sum of a turn's parts."""
    sums = {
        name: sum(getattr(part, name) for part in parts)
        for name in ("ns", "steps", "vehicles", "ghosts", "imbalance", "largest")
    }
    return Turn(
        **sums,
        moves=tuple(move for part in parts for move in part.moves),
        move_ns=tuple(ns for part in parts for ns in part.move_ns),
    )


def _run(world: DrivenWorld, steps: int, watch: Stopwatch) -> Turn:
    """Run steps of a world and time them; decisions of agents and counting are not timed."""
    simulation = world.simulation
    ns = vehicles = ghosts = largest = 0
    uneven = 0.0
    migrations, spent = [simulation.migrations], [_spent(watch)]
    for _ in range(steps):
        commands = world.commands()
        began = time.process_time_ns()
        world.step(commands)
        ns += time.process_time_ns() - began
        loads = simulation.zones.loads()
        owned = loads.owned[:, 0]
        vehicles += int(owned.sum())
        ghosts += int(loads.ghosts.sum())
        largest += int((owned + loads.ghosts[:, 0]).max())
        uneven += imbalance(owned.tolist())
        migrations.append(simulation.migrations)
        spent.append(_spent(watch))
    moves, move_ns = (
        tuple(new - old for old, new in pairwise(sums)) for sums in (migrations, spent)
    )
    return Turn(ns, steps, vehicles, ghosts, uneven, largest, moves, move_ns)


def _spent(watch: Stopwatch) -> int:
    """Return the time spent in the phase `migrate` so far, ns."""
    return sum(watch.spent[name] for name in _MEMBERS["migrate"])
