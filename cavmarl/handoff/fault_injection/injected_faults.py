"""Hosts and coordinators that die as a plan says, to show that results stay the same.

`FaultyPhases` and `FaultyCoordinator` ask `Crashes` at each point of a tick which of them dies
there. All of it is a function of the plan's seed, so a run with deaths can be repeated bit for bit.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from cavmarl.core.errors import CavmarlError
from cavmarl.handoff.fault_injection.fault_plan import PHASES, Crash, Faults
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator, Parcel
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.messages import COORDINATOR, Begin, Commit, Output, Prepare, Step
from cavmarl.shards.executor import Executor, SerialExecutor
from cavmarl.shards.shard import Shard

Visit: TypeAlias = tuple[int, str, int]
"""A visit to a point: (tick of the run, point, zone or COORDINATOR)."""


class ZoneDeath(CavmarlError):
    """The host of a zone has died.

    Attributes:
        lives_on: it only seemed so.
    """

    def __init__(self, zone: int, point: str, lives_on: bool, cause: str = "on purpose") -> None:
        super().__init__(f"the host of zone {zone} died: {point}")
        self.zone, self.point, self.lives_on = zone, point, lives_on
        self.cause = f"at '{point}', {cause}"


class CoordinatorDeath(CavmarlError):
    """The coordinator has died; what it has not written down is gone."""

    def __init__(self, point: str) -> None:
        super().__init__(f"the coordinator died: {point}")
        self.point = point


class Crashes:
    """Says which processes die where, and counts.

    Attributes:
        visits: (tick, point, party) of every point reached; None: not noted.
    """

    def __init__(self, faults: Faults) -> None:
        self.tick = 0  # of the run, that the world is on its way to; to be set
        self.visits: set[Visit] | None = None
        self._plan = faults.plan()
        self._rate = faults.crash_rate
        self._until = faults.until
        self._due: defaultdict[Visit, list[Crash]] = defaultdict(list)
        for crash in faults.crashes:
            party = COORDINATOR if crash.zone is None else crash.zone
            self._due[crash.tick, crash.point, party] += [crash] * crash.times
        self._drawn: set[Visit] = set()

    def zone(self, point: str, zone: int) -> None:
        crash = self._strikes(point, zone)
        if crash is not None:
            raise ZoneDeath(zone, point, crash.lives_on)

    def coordinator(self, point: str) -> None:
        if self._strikes(point, COORDINATOR) is not None:
            raise CoordinatorDeath(point)

    def tears(self, point: str) -> bool:
        """Whether the coordinator dies while it writes a line."""
        return self._strikes(point, COORDINATOR) is not None

    def _strikes(self, point: str, party: int) -> Crash | None:
        key = (self.tick, point, party)
        if self.visits is not None:
            self.visits.add(key)
        due = self._due.get(key)
        if due:
            return due.pop()
        healed = self._until is not None and self.tick >= self._until
        if self._rate == 0.0 or healed or key in self._drawn:
            return None
        self._drawn = {other for other in self._drawn if other[0] == self.tick} | {key}
        if self._plan.chance(key, "dies") >= self._rate:
            return None
        lives_on = self._plan.chance(key, "lives on") < 0.5
        return Crash(*key[:2], None if party == COORDINATOR else party, lives_on)


class FaultyPhases:
    """Runs the phases of a tick zone by zone; hosts die in or after their part of one."""

    def __init__(self, shards: Sequence[Shard], crashes: Crashes) -> None:
        self._hosts = [(shard.zone, SerialExecutor((shard,))) for shard in shards]
        self._crashes = crashes
        self.on = False

    def each(self, phase: str, *arguments: Any) -> None:
        """Call the method `phase` of every shard, in order, while all live."""
        watched = self.on and phase in PHASES
        for zone, host in self._hosts:
            if watched:
                _call_hosted(zone, host, phase, arguments)
                self._crashes.zone(phase, zone)
            else:
                host.each(phase, *arguments)
        if watched:
            self._crashes.coordinator(phase)


def _call_hosted(zone: int, host: Executor, phase: str, arguments: tuple[Any, ...]) -> None:
    """Run a phase in a host's process: an unexpected error ends the host and no more."""
    try:
        host.each(phase, *arguments)
    except CavmarlError:
        raise
    except Exception as error:
        raise ZoneDeath(zone, phase, False, f"of {error!r}") from error


class FaultyCoordinator(MessageCoordinator):
    """A coordinator that dies, and whose zones' hosts die, at named points."""

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

    def _take(self, parcel: Parcel) -> None:
        zone, message, _ = parcel
        if isinstance(message, Prepare):
            self.crashes.zone("PREPARE arrives", zone)
        elif isinstance(message, Step):
            self.crashes.zone("STEP arrives", zone)
        super()._take(parcel)
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


def give_up(coordinator: MessageCoordinator, death: ZoneDeath) -> None:
    """Fence a host; one that lives on sends what it had to send, unheard."""
    endpoint: Endpoint = coordinator.fence(death.zone)
    if death.lives_on and endpoint.lease is not None:
        coordinator.post.send((endpoint.complete(rows=0),))
