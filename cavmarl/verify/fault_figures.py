"""Counts and times of faults in a divided run, from the run itself."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from cavmarl.engine.simulation import Simulation
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator
from cavmarl.ownership.messages import Begin, Commit, Message, Need, Record, Reset
from cavmarl.ownership.transport import Network


class HandOverClock:
    """A watcher of one world that measures how long hand-overs take."""

    def __init__(self) -> None:
        # of each that is committed, from the BEGIN that found its vehicle over the border to the
        # COMMIT
        self.latency_ms: list[float] = []
        self.failed = 0  # hand-overs that were decided, and neither committed nor still under way
        self.late = 0  # vehicles that were over the border before their target was ready
        self.asked = 0  # states that a target had not, and asked for
        self._since: dict[int, float] = {}
        self._plan: Begin | None = None

    def logged(self, records: Iterable[Record]) -> None:
        """Records, in the order of the journal."""
        now = time.perf_counter()
        for record in records:
            match record:
                case Reset():
                    self._drop_plan()
                    self._since = {}
                case Begin():
                    self._begin(record, now)
                case Commit() if self._plan is not None:
                    for switch in self._plan.switches:
                        self.latency_ms.append(1000.0 * (now - self._since.pop(switch.vehicle)))
                    self._plan = None

    def delivered(self, destination: int, message: Message) -> None:
        if isinstance(message, Need):
            self.asked += len(message.vehicles)

    def _begin(self, record: Begin, now: float) -> None:
        self._drop_plan()
        self._plan = record
        self.late += sum(ticks == 1 for _, ticks in record.deferred)
        crossed = [vehicle for vehicle, _ in record.deferred]
        crossed += [switch.vehicle for switch in record.switches]
        self._since = {vehicle: self._since.get(vehicle, now) for vehicle in crossed}

    def _drop_plan(self) -> None:
        if self._plan is not None:
            self.failed += len(self._plan.switches)
            self._plan = None


@dataclass(frozen=True)
class FaultFigures:
    """Figures of one run, or of several that were added up."""

    # point → hosts of zones that died there
    zone_deaths: Counter[str] = field(default_factory=Counter)
    # point → coordinators that died there
    coordinator_deaths: Counter[str] = field(default_factory=Counter)
    # (kind, fault) → messages that it struck
    messages: Counter[tuple[str, str]] = field(default_factory=Counter)
    # (kind, reason) → messages or entries that came late or from elsewhere and did not count
    stale: Counter[tuple[str, str]] = field(default_factory=Counter)
    # `failed`, `switched`, `forced`, `deferred` (ticks), `late` (vehicles), `asked`, `refused`,
    # `aborted`
    hand_overs: Counter[str] = field(default_factory=Counter)
    # phase → messages that were sent again for want of an answer, as of `MessageCoordinator`
    resent: Counter[str] = field(default_factory=Counter)
    # of each death, until its tick began again
    recovery_ms: list[float] = field(default_factory=list)
    # of each tick with a death, how often it was begun again
    repeats: list[int] = field(default_factory=list)
    # of each hand-over, from the crossing to the switch
    waited_ticks: list[int] = field(default_factory=list)
    # the same in ms, with the tick of the switch
    latency_ms: list[float] = field(default_factory=list)
    # of each hand-over whose state was sent ahead
    state_bytes: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, simulation: Simulation, clocks: Sequence[HandOverClock]) -> FaultFigures:
        """What a simulation's worlds went through."""
        found = cls()
        for revival in simulation.revivals:
            deaths = found.coordinator_deaths if revival.zone is None else found.zone_deaths
            deaths[revival.point] += 1
            found.recovery_ms.append(revival.ms)
        found.repeats.extend(Counter(revival.tick for revival in simulation.revivals).values())
        for coordinator in simulation.coordinators:
            found.stale.update(coordinator.dropped())
            if not isinstance(coordinator, MessageCoordinator):
                continue
            found.resent.update(coordinator.resent)
            if isinstance(coordinator.post, Network):
                found.messages.update(coordinator.post.faults)
        for log in simulation.transfers:
            found.hand_overs.update(log.counts)
            found.waited_ticks.extend(row.waited for row in log.rows)
            found.state_bytes.extend(row.state_bytes for row in log.rows if row.offers)
        for clock in clocks:
            found.latency_ms.extend(clock.latency_ms)
            found.hand_overs.update(failed=clock.failed, late=clock.late, asked=clock.asked)
        return found

    def add(self, other: FaultFigures) -> None:
        for entry in fields(self):
            mine, theirs = getattr(self, entry.name), getattr(other, entry.name)
            if isinstance(mine, Counter):
                mine.update(theirs)
            else:
                mine.extend(theirs)

    @property
    def deaths(self) -> int:
        return self.zone_deaths.total() + self.coordinator_deaths.total()

    @property
    def injected(self) -> int:
        return self.deaths + self.messages.total()

    @property
    def handed_over(self) -> int:
        return self.hand_overs["switched"] + self.hand_overs["forced"]

    @property
    def failure_rate(self) -> float:
        """Share of the hand-overs that were decided and neither committed nor under way."""
        failed = self.hand_overs["failed"]
        return failed / max(1, failed + self.handed_over)

    def to_dict(self) -> dict[str, Any]:
        return {
            "zone_deaths": dict(self.zone_deaths),
            "coordinator_deaths": dict(self.coordinator_deaths),
            "messages": _nested(self.messages),
            "stale": _nested(self.stale),
            "hand_overs": dict(self.hand_overs),
            "resent": dict(self.resent),
            "failure_rate": self.failure_rate,
            "recovery_ms": spread(self.recovery_ms),
            "tick_begun_again": spread(self.repeats),
            "latency_ticks": spread(self.waited_ticks),
            "latency_ms": spread(self.latency_ms),
            "state_bytes": spread(self.state_bytes),
        }


def spread(values: Sequence[float]) -> dict[str, float] | None:
    """Median, 95th percentile and maximum; None of no values."""
    if not values:
        return None
    p50, p95 = np.percentile(values, (50.0, 95.0)).tolist()
    return {"p50": p50, "p95": p95, "max": float(max(values))}


def _nested(counts: Counter[tuple[str, str]]) -> dict[str, dict[str, int]]:
    nested: dict[str, dict[str, int]] = {}
    for (kind, what), number in sorted(counts.items()):
        nested.setdefault(kind, {})[what] = number
    return nested
