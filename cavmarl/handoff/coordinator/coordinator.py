"""`Coordinator`: the base class of coordinators of one world.

A coordinator decides which zone advances each vehicle to the next tick, and checks the result. The
division (`ZonedShards`) moves the rows.

`LocalCoordinator` needs all zones in its process. `MessageCoordinator` is used instead if other
simulators run some of these zones, and `NodeCoordinator` if nodes host the zones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple, Protocol

from cavmarl.core.errors import ProtocolError
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.messages import Birth, Record, Removed

if TYPE_CHECKING:
    from cavmarl.handoff.coordinator.invariant_monitor import Departed
    from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership


class Near(NamedTuple):
    """A vehicle near another zone, or beyond its border; see `zones.kernels.borders.NEAR`."""

    vehicle: int
    source: int
    row: int
    target: int
    crossed: bool
    depth_m: float


class Watcher(Protocol):
    """A receiver of records, such as `InvariantMonitor`."""

    def logged(self, records: Iterable[Record]) -> None:
        """Receive records, in the order of the journal."""
        ...


class Coordinator(ABC):
    """Decides ownership, tick by tick: `begin`, then the zones advance, then `end`."""

    def __init__(self, directory: Directory, journal: Journal | None) -> None:
        self._directory = directory
        self.journal = journal  # stores the records
        self.switched = 0  # number of changes of owner
        self._watchers: tuple[Watcher, ...] = ()
        self._births: list[Birth] = []
        self._gone: list[Removed] = []  # vehicles that left between two ticks
        self._removed: list[Removed] = []  # vehicles that left in the current tick

    @property
    def directory(self) -> Directory:
        return self._directory

    @property
    def tick(self) -> int:
        return self._directory.table.tick

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """True if a tick has begun and is not committed."""

    def watch(self, watcher: Watcher) -> None:
        """Also send all further records to this watcher."""
        self._watchers = (*self._watchers, watcher)

    def notes(self) -> tuple[tuple[Birth, ...], tuple[Removed, ...]]:
        """Return vehicles that entered since the last BEGIN or left since the last COMMIT."""
        return tuple(self._births), tuple(self._gone)

    def resume(self, births: Iterable[Birth] = (), gone: Iterable[Removed] = ()) -> None:
        self._births, self._gone, self._removed = list(births), list(gone), []

    def entered(self, vehicles: Iterable[tuple[int, int]]) -> None:
        """Add new vehicles, (id, zone), since the last BEGIN."""
        self._births.extend(Birth(vehicle, zone, b"") for vehicle, zone in vehicles)

    def left(self, vehicles: Iterable[tuple[int, int]]) -> None:
        """Add vehicles, (id, reason), that have left the world."""
        place = self._removed if self.is_open else self._gone
        place.extend(Removed(vehicle, reason) for vehicle, reason in vehicles)

    @abstractmethod
    def reset(self) -> None:
        """Begin an episode without vehicles."""

    @abstractmethod
    def save(self) -> SavedOwnership | None:
        """Return the state between two ticks, except zones and rows; None: no state is kept."""

    @abstractmethod
    def go_on(
        self,
        saved: SavedOwnership,  # the result of `save`
        rows: Mapping[int, tuple[int, int]],  # (zone, epoch) of all owned rows, by vehicle id
    ) -> list[Departed]:  # the vehicles that have left since the last recorded tick
        """Resume from a saved state.

        Raises:
            JournalError: the journal does not contain the position that the state names.
        """

    @abstractmethod
    def begin(
        self,
        check_all: bool,  # whether to check all rows: some have changed since ghosts were renewed
        inputs: bytes = b"",  # digest of the actions
    ) -> None:
        """Decide the owners for the next tick, and move rows between owners.

        Raises:
            ProtocolError: a vehicle was lost or duplicated, or the owner cannot be decided.
            ConfigError: a zone has no ghost of a vehicle that enters it.
        """

    @abstractmethod
    def end(
        self,
        rows: Callable[[int], int],  # zone → digest of its rows
    ) -> None:
        """Commit the tick that all zones have computed.

        Raises:
            ProtocolError: a vehicle was lost or duplicated.
        """

    @abstractmethod
    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """Return (vehicle, owner, zone to which it is offered, state), between two ticks."""

    def close(self) -> None:
        """Close the journal."""
        if self.journal is not None:
            self.journal.close()

    def _check(self, births: Iterable[Birth], counts: list[int]) -> None:
        """Compare the numbers of vehicles in the updated table with the rows of the zones."""
        owned = list(self._directory.table.counts.values())
        for birth in births:
            owned[birth.zone] += 1
        if counts != owned:
            raise ProtocolError(
                f"tick {self.tick}: the zones own {counts} vehicles, but {owned} are expected"
            )

    def _record(self, *records: Record) -> None:
        if self.journal is not None:
            self.journal.append(records)
        for watcher in self._watchers:
            watcher.logged(records)
