"""Decisions on the owners in the next tick, from the committed state and the acknowledgements."""

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
    """The states of all vehicles at the committed tick, as far as decisions read them."""

    def state(self, vehicle: int) -> bytes:
        """Return the vehicle's complete state at the committed tick."""

    def digest_of(self, vehicle: int) -> bytes:
        """Return `ledger.state_digest` of this state."""


class Neighbours(NamedTuple):
    """Pairs of zones between which vehicles may change their owner."""

    near: tuple[frozenset[int], ...]  # zone → zones that its vehicles can reach in one tick
    may_teleport: bool = False  # whether vehicles may jump to other zones; jumps are logged

    def is_teleport(self, vehicle: int, source: int, target: int) -> bool:
        """Return whether the target of a change of owner is not a neighbour of the source.

        Raises:
            ProtocolError: the target is not a neighbour, and vehicles may not jump.
        """
        if target in self.near[source]:
            return False
        if not self.may_teleport:
            raise ProtocolError(refused(vehicle, source, target, self.near[source]))
        return True


def refused(vehicle: int, source: int, target: int, near: Iterable[int]) -> str:
    """Return the error message for a change of owner between zones that are not neighbours."""
    others = ", ".join(str(zone) for zone in sorted(near) if zone != source)
    return (
        f"vehicle {vehicle} of zone {source} cannot change to zone {target}, which is not a "
        f"neighbour: in one tick, vehicles can reach only zones {others}; its position is wrong, "
        "so set zones.check_invariants to find the tick of the error"
    )


def _check_exist(table: Table, vehicle: int, zone: int) -> None:
    if vehicle not in table.owners or zone not in table.hosts:
        raise ProtocolError(f"vehicle {vehicle} or zone {zone} does not exist")


class Decisions:
    """Decides for each vehicle outside of its owner's zone: switch, defer, or force the switch."""

    def __init__(
        self,
        readiness: Readiness,
        store: CommittedStates,
        limits: Limits,
        neighbours: Neighbours | None = None,  # None: all zones are neighbours
    ) -> None:
        self.neighbours = neighbours
        self._readiness = readiness
        self._store = store
        self._limits = limits

    def switches(
        self, table: Table, movers: Iterable[tuple[int, int]]
    ) -> tuple[tuple[Switch, ...], tuple[Deferral, ...], tuple[int, ...]]:
        """Decide about movers: pairs of a vehicle and the zone that contains it.

        Returns:
            The switches, the deferrals, and the ids of vehicles that switch between zones that are
            not neighbours.

        Raises:
            ProtocolError: a vehicle or a zone does not exist, or `Neighbours` forbids a switch.
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
        """Check the zones and the ids of new vehicles. Raises ProtocolError."""
        ids = set()
        for vehicle, zone, _ in births:
            if zone not in table.hosts:
                raise ProtocolError(
                    f"vehicle {vehicle} enters in zone {zone}, which does not exist"
                )
            if vehicle in table.seen or vehicle in ids or vehicle < 0:
                raise ProtocolError(
                    f"new vehicle {vehicle}: use each id from 0 up at most once in an episode"
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
