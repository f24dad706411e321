"""What is done to a run on purpose, to show that nobody can tell: messages lost, hosts that die.

All of it is a function of a seed, so a run with faults can be repeated bit for bit. `FaultyPhases`
and `FaultyCoordinator` ask at each point of a tick who dies there.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cavmarl.errors import CavmarlError, ConfigError
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.messages import COORDINATOR, Begin, Commit, Output, Prepare, Step
from cavmarl.ownership.transport import Delivery, FaultPlan, Rates
from cavmarl.runtime.coordinator import Coordinator
from cavmarl.runtime.executor import Phase
from cavmarl.shard.shard import Shard

__all__ = [
    "COORDINATOR_POINTS",
    "ZONE_POINTS",
    "CoordinatorDeath",
    "Crash",
    "Crashes",
    "Faults",
    "FaultyCoordinator",
    "FaultyPhases",
    "ZoneDeath",
    "read_faults",
]

MESSAGES = ("Step", "Done", "Prepare", "Ack", "Nack", "Abort", "Need")
PHASES = (
    "begin_step", "advance", "leave", "resolve", "rank_lanes", "propose", "admit", "commit",
    "detect", "sense", "credit",
)  # fmt: skip
ZONE_POINTS = (
    "PREPARE arrives", "ACK sent", "STEP arrives", "lease taken", *PHASES, "before DONE",
)  # fmt: skip
COORDINATOR_POINTS = (
    "offers made", "BEGIN torn", "BEGIN written", "STEP sent", *PHASES, "all done",
    "COMMIT torn", "COMMIT written",
)  # fmt: skip


class ZoneDeath(CavmarlError):
    """The host of a zone has died; `zone` says which, `lives_on` whether it only seemed so."""

    def __init__(self, zone: int, point: str, lives_on: bool) -> None:
        super().__init__(f"the host of zone {zone} died: {point}")
        self.zone, self.point, self.lives_on = zone, point, lives_on


class CoordinatorDeath(CavmarlError):
    """The coordinator has died; what it has not written down is gone."""

    def __init__(self, point: str) -> None:
        super().__init__(f"the coordinator died: {point}")
        self.point = point


@dataclass(frozen=True)
class Crash:
    """Somebody dies once.

    Attributes:
        tick: which the world is on its way to; the run's, which never begins anew.
        point: of the tick, in ZONE_POINTS or COORDINATOR_POINTS.
        zone: whose host; None: the coordinator.
        lives_on: it only hangs, is given up, and goes on with what it was doing.
        times: how often it dies there, each new host again; of a zone.
    """

    tick: int
    point: str
    zone: int | None = None
    lives_on: bool = False
    times: int = 1

    def __post_init__(self) -> None:
        points = COORDINATOR_POINTS if self.zone is None else ZONE_POINTS
        if self.point not in points:
            who = "the coordinator" if self.zone is None else "a zone"
            raise ConfigError(
                f"faults: {who} cannot die at '{self.point}'; points are {', '.join(points)}"
            )
        if self.times < 1 or self.tick < 0:
            raise ConfigError(
                f"faults: tick {self.tick}, {self.times} times: 0 and 1 are the least"
            )


@dataclass(frozen=True)
class Faults:
    """A plan.

    Attributes:
        seed: of all that is drawn.
        messages: kind → rates of its faults.
        crashes: those that are named.
        crash_rate: probability that a party dies at a point of a tick, beside those.
    """

    seed: int = 0
    messages: Mapping[str, Rates] = field(default_factory=dict)
    crashes: tuple[Crash, ...] = ()
    crash_rate: float = 0.0

    def __post_init__(self) -> None:
        unknown = sorted(set(self.messages) - set(MESSAGES))
        if unknown:
            raise ConfigError(f"faults: messages {unknown} are none of {', '.join(MESSAGES)}")
        if not 0.0 <= self.crash_rate <= 0.1:
            raise ConfigError(f"faults: crash_rate = {self.crash_rate}: must be from 0 to 0.1")
        for kind in ("Step", "Done"):
            rates = self.messages.get(kind, Rates())
            if rates.drop + rates.corrupt > 0.95:
                raise ConfigError(
                    f"faults: {kind} has to arrive now and then; drop and corrupt it in at most "
                    "95 of 100 cases"
                )

    @property
    def may_crash(self) -> bool:
        """Whether anybody may die."""
        return bool(self.crashes) or self.crash_rate > 0.0

    def plan(self) -> FaultPlan:
        """What happens to messages."""
        return FaultPlan(self.seed, self.messages)


def read_faults(text: str) -> Faults:
    """A plan from JSON, or from a file of it.

    An object with `seed`, `messages` (kind → object of `drop`, `delay`, `duplicate`, `reorder`,
    `corrupt`, `refuse`, `longest_delay`), `crashes` (list of objects of `tick`, `point`, `zone`,
    `lives_on`, `times`) and `crash_rate`; all of them may be left out.

    Raises:
        ConfigError: it cannot be read, or a key or value that cannot work.
    """
    where = "faults"
    if not text.lstrip().startswith("{"):
        where = f"faults {text}"
        try:
            text = Path(text).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{where}: {error}; name a file of JSON") from None
    try:
        content: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: no JSON: {error}") from None
    try:
        content = dict(content)
        rates = dict(content.pop("messages", {}))
        crashes = content.pop("crashes", [])
        return Faults(
            **content,
            messages={kind: Rates(**entry) for kind, entry in rates.items()},
            crashes=tuple(Crash(**entry) for entry in crashes),
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from None


class Crashes:
    """Says who dies where, and counts.

    Args:
        faults: the plan.

    Attributes:
        tick: of the run, that the world is on its way to; to be set.
        struck: point → deaths.
    """

    def __init__(self, faults: Faults) -> None:
        self.tick = 0
        self.struck: Counter[str] = Counter()
        self._plan = faults.plan()
        self._rate = faults.crash_rate
        self._left = {crash: crash.times for crash in faults.crashes}
        self._drawn: set[tuple[int, str, int]] = set()

    def zone(self, point: str, zone: int) -> None:
        """A zone's host is at a point.

        Raises:
            ZoneDeath: it dies there.
        """
        crash = self._strikes(point, zone)
        if crash is not None:
            raise ZoneDeath(zone, point, crash.lives_on)

    def coordinator(self, point: str) -> None:
        """The coordinator is at a point.

        Raises:
            CoordinatorDeath: it dies there.
        """
        if self._strikes(point, COORDINATOR) is not None:
            raise CoordinatorDeath(point)

    def tears(self, point: str) -> bool:
        """Whether the coordinator dies while it writes a line."""
        return self._strikes(point, COORDINATOR) is not None

    def _strikes(self, point: str, party: int) -> Crash | None:
        tick = self.tick
        for crash, left in self._left.items():
            who = COORDINATOR if crash.zone is None else crash.zone
            if left > 0 and (crash.tick, crash.point, who) == (tick, point, party):
                self._left[crash] -= 1
                self.struck[point] += 1
                return crash
        key = (tick, point, party)
        if self._rate == 0.0 or key in self._drawn:
            return None
        self._drawn = {other for other in self._drawn if other[0] == tick} | {key}
        if self._plan.chance(key, "dies") >= self._rate:
            return None
        self.struck[point] += 1
        lives_on = self._plan.chance(key, "lives on") < 0.5
        return Crash(tick, point, None if party == COORDINATOR else party, lives_on)


class FaultyPhases:
    """Runs the phases of a tick as `SerialExecutor` does; hosts die after their part of one.

    Args:
        shards: all of them.
        crashes: who dies where.
    """

    def __init__(self, shards: Sequence[Shard], crashes: Crashes) -> None:
        self._shards = tuple(shards)
        self._crashes = crashes
        self.on = False

    def each(self, phase: Phase, *arguments: Any) -> None:
        """Call the method `phase` of every shard, in order, while all live."""
        watched = self.on and phase in PHASES
        for shard in self._shards:
            getattr(shard, phase)(*arguments)
            if watched:
                self._crashes.zone(phase, shard.zone)
        if watched:
            self._crashes.coordinator(phase)


class FaultyCoordinator(Coordinator):
    """A coordinator that dies, and whose zones' hosts die, at named points.

    Args:
        arguments: as of `Coordinator`.
        crashes: who dies where.
    """

    def __init__(self, *arguments: Any, crashes: Crashes) -> None:
        super().__init__(*arguments)
        self.crashes = crashes

    def _offer(self, *arguments: Any) -> None:
        super()._offer(*arguments)
        self.crashes.coordinator("offers made")

    def _until(self, *arguments: Any) -> None:
        super()._until(*arguments)
        self.crashes.coordinator("STEP sent" if not self.directory.dones else "all done")

    def _complete(self, rows: Callable[[int], int]) -> None:
        for zone in self.endpoints:
            self.crashes.zone("before DONE", zone)
        super()._complete(rows)

    def _take(self, delivery: Delivery) -> None:
        zone, message, _ = delivery
        if isinstance(message, Prepare):
            self.crashes.zone("PREPARE arrives", zone)
        elif isinstance(message, Step):
            self.crashes.zone("STEP arrives", zone)
        super()._take(delivery)
        if isinstance(message, Prepare):
            self.crashes.zone("ACK sent", zone)
        elif isinstance(message, Step):
            self.crashes.zone("lease taken", zone)

    def _write(self, output: Output) -> None:
        kinds = {Begin: "BEGIN", Commit: "COMMIT"}
        name = kinds.get(type(output.records[0])) if output.records else None
        if name is not None and self.crashes.tears(f"{name} torn"):
            if self.journal is not None:
                self.journal.tear(output.records)
            raise CoordinatorDeath(f"{name} torn")
        super()._write(output)
        if name is not None:
            self.crashes.coordinator(f"{name} written")


def give_up(coordinator: Coordinator, death: ZoneDeath) -> None:
    """Fence a host; one that lives on says what it had to say, and nobody listens."""
    endpoint: Endpoint = coordinator.fence(death.zone)
    if death.lives_on and endpoint.lease is not None:
        coordinator.post.send((endpoint.complete(rows=0),))
