"""`Coordinator`: what a coordinator of one world is, however it reaches its zones.

It decides which zone advances which vehicle to the next tick, and sees it done. How rows change
hands is done by the division.

`LocalCoordinator` lives in the process of all of its zones; over nodes there is another one,
`NodeCoordinator`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.messages import Birth, Record, Removed


class Near(NamedTuple):
    """A vehicle that another zone has to be told of; see `kernels.borders.NEAR`."""

    vehicle: int
    source: int
    row: int
    target: int
    crossed: bool
    depth_m: float


class Watcher(Protocol):
    """Is told what happens, as `ownership.trace.Trace` is."""

    def logged(self, records: Iterable[Record]) -> None:
        """Records, in the order of the journal."""
        ...


class Coordinator(ABC):
    """Decides ownership, tick by tick: `begin`, then the zones' work, then `end`."""

    def __init__(self, directory: Directory, journal: Journal | None) -> None:
        self._directory = directory
        self.journal = journal  # what takes the records
        self.switched = 0  # vehicles that have changed their owner
        self._watchers: tuple[Watcher, ...] = ()
        self._births: list[Birth] = []
        self._gone: list[Removed] = []  # between two ticks
        self._removed: list[Removed] = []  # in the tick

    @property
    def directory(self) -> Directory:
        return self._directory

    @property
    def tick(self) -> int:
        return self._directory.table.tick

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether a tick has been begun and is not committed."""

    def watch(self, watcher: Watcher) -> None:
        """Tell one more of all that happens from now on."""
        self._watchers = (*self._watchers, watcher)

    def notes(self) -> tuple[tuple[Birth, ...], tuple[Removed, ...]]:
        """Vehicles born since the last BEGIN, and gone since the last COMMIT."""
        return tuple(self._births), tuple(self._gone)

    def resume(self, births: Iterable[Birth] = (), gone: Iterable[Removed] = ()) -> None:
        self._births, self._gone, self._removed = list(births), list(gone), []

    def entered(self, vehicles: Iterable[tuple[int, int]]) -> None:
        """(id, zone) of vehicles that are new since the last BEGIN."""
        self._births.extend(Birth(vehicle, zone, b"") for vehicle, zone in vehicles)

    def left(self, vehicles: Iterable[tuple[int, int]]) -> None:
        """(id, reason) of vehicles that have left the world."""
        place = self._removed if self.is_open else self._gone
        place.extend(Removed(vehicle, reason) for vehicle, reason in vehicles)

    @abstractmethod
    def reset(self) -> None:
        """Begin an episode without vehicles."""

    @abstractmethod
    def begin(
        self,
        everybody: bool,  # look at all rows: they have changed since the ghosts were renewed
        inputs: bytes = b"",  # digest of the actions
    ) -> None:
        """Decide the way to the next tick, and let rows change hands.

        Raises:
            ProtocolError: a vehicle was lost or doubled, or it cannot be decided.
            ConfigError: a zone has not seen a vehicle that enters it.
        """

    @abstractmethod
    def end(
        self,
        rows: Callable[[int], int],  # zone → digest of its rows
    ) -> None:
        """Commit the tick, through which every zone is.

        Raises:
            ProtocolError: a vehicle was lost or doubled.
        """

    @abstractmethod
    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """(vehicle, owner, zone that it was offered to, how it stands), between two ticks."""

    def close(self) -> None:
        """Close the journal."""
        if self.journal is not None:
            self.journal.close()

    def _record(self, *records: Record) -> None:
        if self.journal is not None:
            self.journal.append(records)
        for watcher in self._watchers:
            watcher.logged(records)
