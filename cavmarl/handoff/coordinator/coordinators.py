"""`WorldCoordinators`: the coordinators of W worlds, and the changes of owner that they decide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.coordinator.invariant_monitor import Departed, InvariantMonitor
from cavmarl.handoff.coordinator.message_coordinator import MessageCoordinator
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.shards.shard import Commands
from cavmarl.zones.kernels.zone_lookup import zones_of


class OwnershipRuntime:
    """The decisions about ownership in W worlds that a tick needs.

    By default, one zone owns all vehicles: no vehicle changes its owner, and nothing is recorded.

    Attributes:
        coordinators: one per world, if they are in this process.
        needs_ghosts: whether each tick must find ghosts and vehicles near borders.
        resumes: whether `go_on` can resume from what `save` has returned.
    """

    coordinators: tuple[Coordinator, ...] = ()
    needs_ghosts = False
    resumes = False

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,)."""

    def save(self, w: int) -> SavedOwnership | None:
        """Return the state on which the next changes of owner depend; None: not known here."""
        return None

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """Resume after worlds were loaded; None: ownership begins anew."""

    def begin(self, commands: Commands) -> None:
        """Change owners of vehicles before a tick, according to the committed rows."""

    def left(self, departures: DepartureQueue) -> None:
        """Record that the vehicles in `departures.passing` have left the world."""

    def entered(self, departures: DepartureQueue) -> None:
        """Record that the vehicles in `departures.passing` have entered the world."""

    def end(self) -> None:
        """End the tick, after all zones of this process have computed it."""

    def in_flight(self, w: int) -> list[TransferInFlight]:
        """Return the incomplete transfers of a world: vehicles that are offered to another zone."""
        return []


class WorldCoordinators(OwnershipRuntime):
    """The coordinators of W worlds in this process."""

    needs_ghosts = True

    def __init__(
        self,
        division: ZonedShards,
        coordinators: Sequence[Coordinator],  # one per world
        digests: RowDigests | None = None,  # digests of zones' rows; None: not needed
        monitor: InvariantMonitor | None = None,  # checks every committed tick; None: no checks
    ) -> None:
        self.coordinators = tuple(coordinators)
        self.resumes = not any(isinstance(one, MessageCoordinator) for one in coordinators)
        self._division = division
        self._digests = digests
        self._monitor = monitor
        self._rows = [self._make_row_digest(w) for w in range(len(self.coordinators))]
        # Whether rows of a world have changed since its ghosts were renewed.
        self._rows_changed = [True] * len(self.coordinators)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,), with their present vehicles."""
        for w, coordinator in enumerate(self.coordinators):
            if chosen[w]:
                coordinator.reset()
                coordinator.entered(self._division.owners(w))
                self._rows_changed[w] = True
                if self._monitor is not None:
                    self._monitor.begin(w, coordinator.notes()[0])

    def save(self, w: int) -> SavedOwnership | None:
        """Return the state on which the next changes of owner depend, except the zones."""
        saved = self.coordinators[w].save()
        if saved is None or not self._rows_changed[w]:
            return saved
        # Rows have changed since vehicles near borders were recorded, so they must be found again.
        numbers = saved.numbers._replace(is_stirred=1, crossed=0)
        return saved._replace(numbers=numbers, near=saved.near[:0])

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """Resume after worlds were loaded.

        Args:
            saved: the ownership of each world; None: it begins anew, with the present vehicles.

        Raises:
            JournalError: a journal does not contain the position that the state names.
            ProtocolError: an invariant does not hold.
        """
        for w, coordinator in enumerate(self.coordinators):
            gone: Sequence[Departed] = ()
            if saved is None:
                coordinator.reset()
                coordinator.entered(self._division.owners(w))
                self._rows_changed[w] = True
            else:
                gone = coordinator.go_on(saved[w], self._rows_of(w))
                self._rows_changed[w] = bool(saved[w].numbers.is_stirred)
            if self._monitor is not None:
                table = coordinator.directory.table
                self._monitor.go_on(w, table, coordinator.notes()[0], gone)

    def _rows_of(self, w: int) -> dict[int, tuple[int, int]]:
        """Return (zone, epoch) of all vehicles of a world, by id."""
        found: dict[int, tuple[int, int]] = {}
        for zone in range(self._division.count):
            rows = self._division.owned(w, zone)
            pairs = zip(rows["id"].tolist(), rows["epoch"].tolist(), strict=True)
            found.update((vehicle, (zone, epoch)) for vehicle, epoch in pairs)
        return found

    def cut(self) -> None:
        """Let the next tick check all vehicles, after the zones have changed between two ticks."""
        for w, coordinator in enumerate(self.coordinators):
            births, gone = coordinator.notes()
            coordinator.resume(self._division.changes.settle_newborn(w, births), gone)
            self._rows_changed[w] = True

    def begin(self, commands: Commands) -> None:
        for w, coordinator in enumerate(self.coordinators):
            check_all, self._rows_changed[w] = self._rows_changed[w], False
            coordinator.begin(
                check_all, b"" if coordinator.journal is None else _digest(commands, w)
            )

    def end(self) -> None:
        """Commit the tick that all zones have computed.

        Raises:
            ProtocolError: an invariant does not hold in this tick.
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
                self._rows_changed[w] |= not coordinator.is_open

    def entered(self, departures: DepartureQueue) -> None:
        for w, coordinator in enumerate(self.coordinators):
            new = departures.passing[w, : departures.num_passing[w]]
            if len(new):
                zones = np.empty(len(new), dtype=np.int32)
                zones_of(self._division.zones, new, len(new), zones)
                coordinator.entered(zip(new["id"].tolist(), zones.tolist(), strict=True))

    def _make_row_digest(self, w: int) -> Callable[[int], int]:
        digests = self._digests
        if digests is None:
            return lambda zone: 0
        return lambda zone: digests.of(self._division.owned(w, zone))


def _digest(commands: Commands, w: int) -> bytes:
    """Return a digest, 16 bytes, of the actions of a world's agents."""
    digest = blake2b(commands.controls[w].tobytes(), digest_size=16)
    digest.update(commands.meta_actions[w].tobytes())
    if commands.declared.any():
        digest.update(commands.declared[w].tobytes())
    if commands.inserted.any():
        digest.update(commands.inserted[w].tobytes())
    if commands.external.any():
        digest.update(commands.external[w].tobytes())
    if commands.overridden.any():
        digest.update(commands.overridden[w].tobytes())
    if commands.lane_changes.any():
        digest.update(commands.lane_changes[w].tobytes())
    if commands.signal_choices.size:
        digest.update(commands.signal_choices[w].tobytes())
    return digest.digest()
