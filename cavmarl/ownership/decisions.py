"""Changes of owner in the next tick: a function of the committed state and of what is ready."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Birth, Deferral, Switch
from cavmarl.ownership.readiness import Readiness
from cavmarl.ownership.table import Table
from cavmarl.ownership.transitions import State


class CommittedStates(Protocol):
    """The part of the committed store that decisions read."""

    def state(self, vehicle: int) -> bytes:
        """The vehicle's whole state as of the committed tick."""

    def digest_of(self, vehicle: int) -> bytes:
        """`ledger.state_digest` of it."""


class Neighbours(NamedTuple):
    """Between which zones vehicles may change; known before the first tick."""

    near: tuple[frozenset[int], ...]  # zone → those that its vehicles can be in a tick later
    may_teleport: bool = False  # whether vehicles may be put elsewhere; then it is logged

    def is_teleport(self, vehicle: int, source: int, target: int) -> bool:
        """Whether a change of owner goes to a zone that is no neighbour.

        Raises:
            ProtocolError: it does, and vehicles are put nowhere.
        """
        if target in self.near[source]:
            return False
        if not self.may_teleport:
            raise ProtocolError(refused(vehicle, source, target, self.near[source]))
        return True


def refused(vehicle: int, source: int, target: int, near: Iterable[int]) -> str:
    """What is wrong with a change of owner that goes to a zone that is no neighbour."""
    others = ", ".join(str(zone) for zone in sorted(near) if zone != source)
    return (
        f"vehicle {vehicle} of zone {source} is refused by zone {target}, which is no neighbour: "
        f"no vehicle drives further than to zones {others} in a tick; what says where it is has "
        "failed, and zones.check_invariants tells when"
    )


def _check_exist(table: Table, vehicle: int, zone: int) -> None:
    if vehicle not in table.owners or zone not in table.hosts:
        raise ProtocolError(f"vehicle {vehicle} in zone {zone}: one of them does not exist")


class Decisions:
    """Decides for each vehicle outside its owner's zone: switch, wait, or be forced."""

    def __init__(
        self,
        readiness: Readiness,
        store: CommittedStates,
        limits: Limits,
        neighbours: Neighbours | None = None,  # None: each zone has all others
    ) -> None:
        self.neighbours = neighbours
        self._readiness = readiness
        self._store = store
        self._limits = limits

    def switches(
        self, table: Table, movers: Iterable[tuple[int, int]]
    ) -> tuple[tuple[Switch, ...], tuple[Deferral, ...], tuple[int, ...]]:
        """What becomes of (vehicle, zone that contains it), and the ids of those put elsewhere.

        Raises:
            ProtocolError: a vehicle or a zone does not exist, or the zone is no neighbour.
        """
        switches, deferred, teleports = [], [], []
        for vehicle, zone in sorted(movers):
            _check_exist(table, vehicle, zone)
            source, epoch = table.owners[vehicle]
            if zone == source:
                continue
            if self.neighbours and self.neighbours.is_teleport(vehicle, source, zone):
                teleports.append(vehicle)
            waited = table.deferred.get(vehicle, 0)
            if self._ready(table, vehicle, zone, epoch):
                switches.append(Switch(vehicle, source, zone, epoch + 1, False))
            elif waited < self._limits.deferral:
                deferred.append(Deferral(vehicle, waited + 1))
            else:
                switches.append(Switch(vehicle, source, zone, epoch + 1, True))
        gone = {switch.vehicle for switch in switches}
        return tuple(switches), tuple(deferred), tuple(v for v in teleports if v in gone)

    def check_births(self, table: Table, births: Iterable[Birth]) -> None:
        """See that new vehicles are new."""
        ids = set()
        for vehicle, zone, _ in births:
            if zone not in table.hosts:
                raise ProtocolError(
                    f"vehicle {vehicle} begins in zone {zone}, which does not exist"
                )
            if vehicle in table.seen or vehicle in ids or vehicle < 0:
                raise ProtocolError(
                    f"vehicle {vehicle} begins: an episode uses an id once, and none below 0"
                )
            ids.add(vehicle)

    def _ready(self, table: Table, vehicle: int, zone: int, epoch: int) -> bool:
        return table.states[zone] is State.HOSTED and self._readiness.ready(
            vehicle,
            zone,
            tick=table.tick,
            epoch=epoch,
            incarnation=table.hosts[zone][1],
            digest=self._store.digest_of(vehicle),
        )
