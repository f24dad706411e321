"""Check invariants of the protocol on the states of coordinator and hosts while they run.

The monitor is told which vehicles a host advances, and checks the states before and after each
tick. It visits every vehicle, so it is slow. I1 to I10 number the invariants; each check below
states its own, `explorer.py` has I4, and `scenarios.py` I8.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import tally
from cavmarl.ownership.limits import Limits


class Store(Protocol):
    """The part of the committed store that the monitor reads."""

    committed: Mapping[int, bytes]

    def world(self) -> int:
        """Return the digest of the committed world."""


class Monitor:
    """Raise ProtocolError at the first invariant that does not hold."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._writers: dict[
            int, tuple[int, int]
        ] = {}  # vehicle → (zone, incarnation) that has advanced it in this tick
        self._executed: dict[tuple[int, int], int] = {}  # (zone, incarnation) → newest tick
        self._tick = -1

    def advanced(self, zone: int, incarnation: int, tick: int, vehicles: Iterable[int]) -> None:
        """Check I1: in a tick, only one zone advances a vehicle; no process executes it twice."""
        if tick > self._tick:
            self._tick, self._writers = tick, {}
        if self._executed.get((zone, incarnation), -1) >= tick:
            raise ProtocolError(f"I1: zone {zone} executes tick {tick} twice")
        self._executed[zone, incarnation] = tick
        for vehicle in vehicles:
            writer = self._writers.get(vehicle)
            if writer is not None and writer[0] != zone:
                raise ProtocolError(
                    f"I1: zones {writer[0]} and {zone} both advance vehicle {vehicle} to {tick}"
                )
            self._writers[vehicle] = (zone, incarnation)

    def check(self, directory: Directory, endpoints: Mapping[int, Endpoint], store: Store) -> None:
        """Check I1 to I3, I5 and I6; call this at any time."""
        self._check_copies(directory, store)
        self._check_leases(directory, endpoints)
        self._check_retained(directory, endpoints)
        self._check_ledger(directory)
        for vehicle, ticks in directory.table.deferred.items():
            if ticks > self._limits.deferral:
                raise ProtocolError(f"I5: vehicle {vehicle} waits for {ticks} ticks")

    def committed(self, world: int, store: Store) -> None:
        """Check I10: the digest of the committed world is the sum of the digests of the zones."""
        if world != store.world():
            raise ProtocolError(
                "I10: the committed world is not the world that the zones have reported"
            )

    def _check_copies(self, directory: Directory, store: Store) -> None:
        if store.committed.keys() != directory.table.owners.keys():
            lost = sorted(directory.table.owners.keys() ^ store.committed.keys())
            raise ProtocolError(f"I2: vehicles {lost} are owned or stored, but not both")

    def _check_leases(self, directory: Directory, endpoints: Mapping[int, Endpoint]) -> None:
        leases: dict[int, int] = {}
        for zone, endpoint in endpoints.items():
            if endpoint.lease is None or endpoint.episode != directory.table.episode:
                continue
            for vehicle in endpoint.owned:
                if vehicle in leases:
                    raise ProtocolError(
                        f"I1: zones {leases[vehicle]} and {zone} have a lease for vehicle {vehicle}"
                    )
                leases[vehicle] = zone

    def _check_retained(self, directory: Directory, endpoints: Mapping[int, Endpoint]) -> None:
        plan = directory.table.plan
        if plan is None:
            return
        for switch in plan.record.switches:
            source = endpoints.get(switch.source)
            if source is None or source.episode != directory.table.episode:
                continue
            if switch.vehicle not in source.owned and switch.vehicle not in source.retained:
                raise ProtocolError(
                    f"I3: zone {switch.source} dropped vehicle {switch.vehicle} before the commit"
                )

    def _check_ledger(self, directory: Directory) -> None:
        table = directory.table
        for zone, expected in table.tallies.items():
            owned = {v: epoch for v, (owner, epoch) in table.owners.items() if owner == zone}
            if tally(table.run, owned) != expected:
                raise ProtocolError(f"I6: the ledger of zone {zone} is not that of its vehicles")
