"""Changes of owner in the next tick: a function of the committed state and of what is ready."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Birth, Deferral, Switch
from cavmarl.ownership.readiness import Readiness
from cavmarl.ownership.safeguards import Safeguards
from cavmarl.ownership.table import Table
from cavmarl.ownership.transitions import State


class CommittedStates(Protocol):
    """The part of the committed store that decisions read."""

    def state(self, vehicle: int) -> bytes:
        """The vehicle's whole state as of the committed tick."""

    def digest_of(self, vehicle: int) -> bytes:
        """`ledger.state_digest` of it."""


class Decisions:
    """Decides for each vehicle outside its owner's zone: switch, wait, or be forced."""

    def __init__(
        self, readiness: Readiness, store: CommittedStates, limits: Limits, safeguards: Safeguards
    ) -> None:
        self._readiness = readiness
        self._store = store
        self._limits = limits
        self._safeguards = safeguards

    def switches(
        self, table: Table, movers: Iterable[tuple[int, int]]
    ) -> tuple[tuple[Switch, ...], tuple[Deferral, ...]]:
        """What becomes of (vehicle, zone that contains it)."""
        switches, deferred = [], []
        for vehicle, zone in sorted(movers):
            if vehicle not in table.owners or zone not in table.hosts:
                raise ProtocolError(f"vehicle {vehicle} in zone {zone}: one of them does not exist")
            source, epoch = table.owners[vehicle]
            target = zone
            if not self._safeguards.target_by_position:
                target = self._readiness.holder(vehicle, table.tick, zone)
            if target == source:
                continue
            waited = table.deferred.get(vehicle, 0)
            may_wait = waited < self._limits.longest_deferral or not self._safeguards.deadline
            if self._ready(table, vehicle, target, epoch):
                switches.append(Switch(vehicle, source, target, epoch + 1, False))
            elif may_wait:
                deferred.append(Deferral(vehicle, waited + 1))
            else:
                switches.append(Switch(vehicle, source, target, epoch + 1, True))
        return tuple(switches), tuple(deferred)

    def check_births(self, table: Table, births: Iterable[Birth]) -> None:
        """See that new vehicles are new."""
        ids = set()
        for vehicle, zone, _ in births:
            if zone not in table.hosts:
                raise ProtocolError(
                    f"vehicle {vehicle} begins in zone {zone}, which does not exist"
                )
            used = vehicle in table.owners or vehicle in ids
            if self._safeguards.removed_is_final:
                used = used or vehicle in table.seen
            if used or vehicle < 0:
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
