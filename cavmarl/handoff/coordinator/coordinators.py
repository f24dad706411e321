"""`Coordinators`: the coordinators of W worlds, and the rows that change hands as they say."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from hashlib import blake2b
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ProtocolError
from cavmarl.core.records.arrays import Gate
from cavmarl.handoff.coordinator.coordinator import ArrivingVehicle, Coordinator, Near
from cavmarl.handoff.coordinator.invariant_monitor import InvariantMonitor
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.division import Division
from cavmarl.handoff.fault_injection.committed_store import CommittedStore, Notes
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.messages import Record
from cavmarl.shards.shard import Commands
from cavmarl.zones.kernels.zone_lookup import zones_of


class NearBorders:
    """What rows of transfers need to know: vehicles near a border, and those that crossed one.

    Attributes:
        places: vehicle that has changed its owner in it → the row that it had there; to be set.
    """

    def __init__(self, division: Division, world: int) -> None:
        self.places: Mapping[int, int] = {}
        self._division = division
        self._world = world
        self.near: Sequence[Near] = ()  # of the tick that is on its way; to be set
        self._depths: dict[tuple[int, int], float] = {}
        self._told: Sequence[Near] = ()

    def depth_m(self, vehicle: int, target: int) -> float | None:
        """How far outside of its owner's zone, less than 0 inside; None: it was not near."""
        if self._told is not self.near:
            self._told = self.near
            self._depths = {(entry.vehicle, entry.target): entry.depth_m for entry in self.near}
        return self._depths.get((vehicle, target))

    def release_depth_m(self, vehicle: int, source: int, target: int) -> float | None:
        """How far outside of its old zone a vehicle is that has changed; None: it has left."""
        hint = self.places.get(vehicle, 0)
        return self._division.depth_m(self._world, vehicle, target, source, hint)

    @staticmethod
    def now_ms() -> float:
        """Of the process's clock."""
        return 1e3 * time.perf_counter()


class RowStates:
    """States of one world's vehicles at the committed tick, read from the rows of their owners."""

    def __init__(self, division: Division, world: int) -> None:
        self.borders = NearBorders(division, world)  # vehicles near a border when the tick began
        self._division = division
        self._world = world
        self._known: dict[int, bytes] = {}

    def forget(self) -> None:
        self._known.clear()

    def look(self, everybody: bool) -> list[Near]:
        """Vehicles near a border; see `Division.near`."""
        found = self._division.near(self._world, everybody)
        self.borders.near = found
        return found

    def change(self, entries: Sequence[ArrivingVehicle]) -> None:
        """Let rows change hands, of vehicles that `look` has found."""
        if entries:
            rows = {entry.vehicle: entry.row for entry in self.borders.near}
            self.borders.places = {
                switch.vehicle: self._division.hand_over(
                    self._world, switch, state, rows.get(switch.vehicle, 0)
                )
                for switch, state in entries
            }

    def near(self, entry: Near) -> bytes:
        """Of a vehicle near a border, whose row is known."""
        found = self._known.get(entry.vehicle)
        if found is None:
            found = self._division.state(self._world, entry.source, entry.row)
            self._known[entry.vehicle] = found
        return found

    def state(self, vehicle: int) -> bytes:
        found = self._known.get(vehicle)
        if found is None:
            found = self._division.state(self._world, *self._division.find(self._world, vehicle))
            self._known[vehicle] = found
        return found

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.state(vehicle))


class Coordination(Protocol):
    """What decides ownership in W worlds, as a tick calls it.

    Attributes:
        coordinators: one a world, if they are in this process.
        needs_ghosts: whether ghosts and vehicles near borders are looked for in each tick.
    """

    coordinators: tuple[Coordinator, ...]
    needs_ghosts: bool

    def reset(self, chosen: NDArray[np.bool_]) -> None: ...

    def begin(self, commands: Commands) -> None:
        """The rows are those of a committed tick; vehicles change their owner now."""
        ...

    def left(self, gate: Gate) -> None:
        """Vehicles in `gate.passing` have left the world."""
        ...

    def entered(self, gate: Gate) -> None:
        """Vehicles in `gate.passing` are new."""
        ...

    def end(self) -> None:
        """All zones of this process are through with the tick."""
        ...

    def save(self) -> None:
        """What has changed between two ticks is committed."""
        ...

    def in_flight(self, w: int) -> list[TransferInFlight]: ...


class NoCoordination:
    """One zone owns all vehicles, so nothing has to be decided."""

    coordinators: tuple[Coordinator, ...] = ()
    needs_ghosts = False

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """All vehicles are of the one zone."""

    def begin(self, commands: Commands) -> None:
        """No vehicle changes its owner."""

    def left(self, gate: Gate) -> None:
        """Nothing is recorded of vehicles that leave."""

    def entered(self, gate: Gate) -> None:
        """New vehicles are of the one zone."""

    def end(self) -> None:
        """Nothing is committed."""

    def save(self) -> None:
        """Nothing is committed."""

    def in_flight(self, w: int) -> list[TransferInFlight]:
        """Return no transfers."""
        return []


class Coordinators:
    """The coordinators of W worlds in this process; a `Coordination`."""

    needs_ghosts = True

    def __init__(
        self,
        division: Division,  # whose rows change hands
        coordinators: Sequence[Coordinator],  # one a world
        states: Sequence[RowStates],  # of the vehicles of each world, as the coordinators read them
        digests: RowDigests | None = None,  # of zones' rows; None: not needed
        # keeps what is committed; None: no process can die alone
        store: CommittedStore | None = None,
        monitor: InvariantMonitor | None = None,  # checks every tick that is committed; None: none
    ) -> None:
        self.coordinators = tuple(coordinators)
        self._division = division
        self._states = tuple(states)
        self._digests = digests
        self._store = store
        self._monitor = monitor
        self._rows = [self._live(w) for w in range(len(self.coordinators))]
        self._in_store = [self._stored(w) for w in range(len(self.coordinators))]
        # Worlds whose rows have changed since their ghosts were renewed.
        self._stirred = [True] * len(self.coordinators)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,), with the vehicles that are there."""
        for w, coordinator in enumerate(self.coordinators):
            if chosen[w]:
                coordinator.reset()
                coordinator.entered(self._division.owners(w))
                self._stirred[w] = True
                if self._monitor is not None:
                    self._monitor.begin(w, coordinator.notes()[0])

    def cut(self) -> None:
        """Zones are others, between two ticks: at the next one all vehicles are checked."""
        for w, coordinator in enumerate(self.coordinators):
            births, gone = coordinator.notes()
            coordinator.resume(self._division.settle_newborn(w, births), gone)
            self._stirred[w] = True

    def begin(self, commands: Commands) -> None:
        for w, coordinator in enumerate(self.coordinators):
            everybody, self._stirred[w] = self._stirred[w], False
            coordinator.begin(
                everybody, b"" if coordinator.journal is None else _digest(commands, w)
            )

    def end(self) -> None:
        """Commit the tick that all zones have computed."""
        if self._store is not None:
            self._store.write(tuple((c.notes()[0], ()) for c in self.coordinators))
        for w, coordinator in enumerate(self.coordinators):
            coordinator.end(self._rows[w], self._in_store[w])
        if self._store is not None:
            self._store.flip()
        if self._monitor is not None:
            self.check()

    def check(self) -> None:
        """Look whether the invariants hold in the tick that has been committed.

        Raises:
            ProtocolError: one does not.
        """
        if self._monitor is not None:
            for w, coordinator in enumerate(self.coordinators):
                self._monitor.end(w, coordinator.notes()[0])

    def save(self) -> None:
        """What has changed between two ticks is committed."""
        if self._store is not None:
            self._store.write(tuple(coordinator.notes() for coordinator in self.coordinators))
            self._store.flip()

    def in_flight(self, w: int) -> list[TransferInFlight]:
        return [TransferInFlight(*entry) for entry in self.coordinators[w].in_flight()]

    def load(self) -> None:
        """Take everything back to what is committed."""
        if self._store is None:
            raise ProtocolError("the committed state is not kept")
        self._division.align()
        for w, notes in enumerate(self._store.load()):
            self.coordinators[w].resume(*notes)
            self._stirred[w] = True

    def take_up(self, records: Sequence[Record], notes: Sequence[Notes]) -> None:
        """Go on in the one world where others have stopped."""
        (coordinator,) = self.coordinators
        if not isinstance(coordinator, MessageCoordinator):
            raise ProtocolError("a coordinator without messages cannot go on in the middle of one")
        coordinator.take_up(records)
        coordinator.resume(*notes[0])
        self._stirred[0] = True

    def left(self, gate: Gate) -> None:
        for w, coordinator in enumerate(self.coordinators):
            gone = gate.passing[w, : gate.num_passing[w]]
            if len(gone):
                coordinator.left(zip(gone["id"].tolist(), gone["events"].tolist(), strict=True))
                self._stirred[w] |= not coordinator.is_open

    def entered(self, gate: Gate) -> None:
        for w, coordinator in enumerate(self.coordinators):
            new = gate.passing[w, : gate.num_passing[w]]
            if len(new):
                zones = np.empty(len(new), dtype=np.int32)
                zones_of(self._division.zones, new, len(new), zones)
                coordinator.entered(zip(new["id"].tolist(), zones.tolist(), strict=True))

    def _live(self, w: int) -> Callable[[int], int]:
        digests = self._digests
        if digests is None:
            return lambda zone: 0
        return lambda zone: digests.of(self._division.owned(w, zone))

    def _stored(self, w: int) -> Callable[[int], int] | None:
        digests, store = self._digests, self._store
        if digests is None or store is None:
            return None
        return lambda zone: digests.of(store.written(zone, w))


def _digest(commands: Commands, w: int) -> bytes:
    """Digest of what the agents of a world do, 16 bytes."""
    digest = blake2b(commands.controls[w].tobytes(), digest_size=16)
    digest.update(commands.meta_actions[w].tobytes())
    if commands.declared.any():
        digest.update(commands.declared[w].tobytes())
    if commands.inserted.any():
        digest.update(commands.inserted[w].tobytes())
    return digest.digest()
