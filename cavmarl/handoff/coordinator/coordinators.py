"""`WorldCoordinators`: the coordinators of W worlds, and the rows that change hands as they say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from hashlib import blake2b
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue
from cavmarl.handoff.coordinator.invariant_monitor import Departed, InvariantMonitor
from cavmarl.handoff.coordinator.local_coordinator import LocalCoordinator
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.shards.shard import Commands
from cavmarl.zones.kernels.zone_lookup import zones_of


class OwnershipRuntime(Protocol):
    """What decides ownership in W worlds, as a tick calls it.

    Attributes:
        coordinators: one a world, if they are in this process.
        needs_ghosts: whether ghosts and vehicles near borders are looked for in each tick.
    """

    coordinators: tuple[LocalCoordinator, ...]
    needs_ghosts: bool

    def reset(self, chosen: NDArray[np.bool_]) -> None: ...

    def save(self, w: int) -> SavedOwnership | None:
        """What decides the next changes of owner in a world; None: it is not known here."""
        ...

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """Worlds have been loaded; None: ownership begins anew."""
        ...

    def begin(self, commands: Commands) -> None:
        """The rows are those of a committed tick; vehicles change their owner now."""
        ...

    def left(self, departures: DepartureQueue) -> None:
        """Vehicles in `departures.passing` have left the world."""
        ...

    def entered(self, departures: DepartureQueue) -> None:
        """Vehicles in `departures.passing` are new."""
        ...

    def end(self) -> None:
        """All zones of this process are through with the tick."""
        ...

    def in_flight(self, w: int) -> list[TransferInFlight]: ...


class NoOwnershipRuntime:
    """One zone owns all vehicles, so nothing has to be decided."""

    coordinators: tuple[LocalCoordinator, ...] = ()
    needs_ghosts = False

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """All vehicles are of the one zone."""

    def save(self, w: int) -> None:
        """There is nothing to know of owners."""

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """All vehicles are of the one zone."""

    def begin(self, commands: Commands) -> None:
        """No vehicle changes its owner."""

    def left(self, departures: DepartureQueue) -> None:
        """Nothing is recorded of vehicles that leave."""

    def entered(self, departures: DepartureQueue) -> None:
        """New vehicles are of the one zone."""

    def end(self) -> None:
        """Nothing is committed."""

    def in_flight(self, w: int) -> list[TransferInFlight]:
        """Return no transfers."""
        return []


class WorldCoordinators:
    """The coordinators of W worlds in this process; an `OwnershipRuntime`."""

    needs_ghosts = True

    def __init__(
        self,
        division: ZonedShards,  # whose rows change hands
        coordinators: Sequence[LocalCoordinator],  # one a world
        digests: RowDigests | None = None,  # of zones' rows; None: not needed
        monitor: InvariantMonitor | None = None,  # checks every tick that is committed; None: none
    ) -> None:
        self.coordinators = tuple(coordinators)
        self._division = division
        self._digests = digests
        self._monitor = monitor
        self._rows = [self._live(w) for w in range(len(self.coordinators))]
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

    def save(self, w: int) -> SavedOwnership:
        """What decides the next changes of owner in a world, but for its zones."""
        saved = self.coordinators[w].save()
        if not self._stirred[w]:
            return saved
        # Rows have moved since those near a border were noted, and are looked at again.
        numbers = saved.numbers._replace(is_stirred=1, crossed=0)
        return saved._replace(numbers=numbers, near=saved.near[:0])

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """Go on with worlds that have been loaded.

        Args:
            saved: of each world, what was known of owners; None: ownership begins anew, with the
                vehicles where they are.

        Raises:
            JournalError: a journal has never ended where it did then.
            ProtocolError: an invariant does not hold.
        """
        for w, coordinator in enumerate(self.coordinators):
            gone: Sequence[Departed] = ()
            if saved is None:
                coordinator.reset()
                coordinator.entered(self._division.owners(w))
                self._stirred[w] = True
            else:
                gone = coordinator.go_on(saved[w], self._rows_of(w))
                self._stirred[w] = bool(saved[w].numbers.is_stirred)
            if self._monitor is not None:
                table = coordinator.directory.table
                self._monitor.go_on(w, table, coordinator.notes()[0], gone)

    def _rows_of(self, w: int) -> dict[int, tuple[int, int]]:
        """Vehicle → (zone, epoch) of all vehicles of a world."""
        found: dict[int, tuple[int, int]] = {}
        for zone in range(self._division.count):
            rows = self._division.owned(w, zone)
            pairs = zip(rows["id"].tolist(), rows["epoch"].tolist(), strict=True)
            found.update((vehicle, (zone, epoch)) for vehicle, epoch in pairs)
        return found

    def cut(self) -> None:
        """Zones are others, between two ticks: at the next one all vehicles are checked."""
        for w, coordinator in enumerate(self.coordinators):
            births, gone = coordinator.notes()
            coordinator.resume(self._division.changes.settle_newborn(w, births), gone)
            self._stirred[w] = True

    def begin(self, commands: Commands) -> None:
        for w, coordinator in enumerate(self.coordinators):
            everybody, self._stirred[w] = self._stirred[w], False
            coordinator.begin(
                everybody, b"" if coordinator.journal is None else _digest(commands, w)
            )

    def end(self) -> None:
        """Commit the tick that all zones have computed.

        Raises:
            ProtocolError: an invariant does not hold in it.
        """
        for w, coordinator in enumerate(self.coordinators):
            coordinator.end(self._rows[w])
        if self._monitor is not None:
            for w, coordinator in enumerate(self.coordinators):
                self._monitor.end(w, coordinator.notes()[0])

    def in_flight(self, w: int) -> list[TransferInFlight]:
        return [TransferInFlight(*entry) for entry in self.coordinators[w].in_flight()]

    def left(self, departures: DepartureQueue) -> None:
        for w, coordinator in enumerate(self.coordinators):
            gone = departures.passing[w, : departures.num_passing[w]]
            if len(gone):
                coordinator.left(zip(gone["id"].tolist(), gone["events"].tolist(), strict=True))
                self._stirred[w] |= not coordinator.is_open

    def entered(self, departures: DepartureQueue) -> None:
        for w, coordinator in enumerate(self.coordinators):
            new = departures.passing[w, : departures.num_passing[w]]
            if len(new):
                zones = np.empty(len(new), dtype=np.int32)
                zones_of(self._division.zones, new, len(new), zones)
                coordinator.entered(zip(new["id"].tolist(), zones.tolist(), strict=True))

    def _live(self, w: int) -> Callable[[int], int]:
        digests = self._digests
        if digests is None:
            return lambda zone: 0
        return lambda zone: digests.of(self._division.owned(w, zone))


def _digest(commands: Commands, w: int) -> bytes:
    """Digest of what the agents of a world do, 16 bytes."""
    digest = blake2b(commands.controls[w].tobytes(), digest_size=16)
    digest.update(commands.meta_actions[w].tobytes())
    if commands.declared.any():
        digest.update(commands.declared[w].tobytes())
    if commands.inserted.any():
        digest.update(commands.inserted[w].tobytes())
    return digest.digest()
