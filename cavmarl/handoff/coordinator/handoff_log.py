"""`HandoffLog`: approaches and changes of owner in one world whose zones share a process."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, ProtocolError
from cavmarl.handoff.division import ZonedShards
from cavmarl.ownership.decisions import refused
from cavmarl.ownership.messages import Birth, Switch
from cavmarl.zones.kernels.ownership_changes import NOT_OWNED


class OwnerChange(NamedTuple):
    """A change of owner; see `zones.kernels.ownership_changes.CHANGE`."""

    tick: int
    vehicle: int
    source: int
    target: int
    epoch: int
    place: int
    approached: int
    prepare_depth_m: float
    switch_depth_m: float
    release_depth_m: float
    ms: float


class SavedBorders(NamedTuple):
    """The saved `BorderRecords` of one world."""

    tick: int
    acknowledged: int
    aborted: int
    crossed: int
    owned: int
    known: int
    near: NDArray[np.void]  # NEAR (n,)
    coming: NDArray[np.void]  # COMING (n,)
    before: NDArray[np.void]  # COMING (n,) of the tick before


class HandoffLog:
    """Hands vehicles over to the zones that contain them, and keeps changes until they are read."""

    def __init__(self, division: ZonedShards, world: int) -> None:
        self._division = division
        self._world = world
        self._book = division.book
        self._hand_over = division.changes.hand_over_all
        self._release = division.changes.release_all
        self._neighbours = division.neighbours
        self._teleports: set[tuple[int, int]] = set()  # (tick, vehicle) of changes not read yet

    def hand_over(
        self,
        check_all: bool,  # whether to check all rows: some have changed since ghosts were renewed
        vehicles: int,  # expected number of vehicles
        newborn: Sequence[Birth],  # entered since the last BEGIN; these vehicles keep their owner
    ) -> int:  # number of changes
        """Change the owners of vehicles that have crossed a border, according to committed rows.

        Raises:
            ConfigError: a zone has no ghost of a vehicle that enters it.
            ProtocolError: a vehicle enters a zone that is not a neighbour of its old zone, although
                the zones have not changed and vehicles are not teleported.
        """
        division, book, w = self._division, self._book, self._world
        changed = 0
        if check_all or book.num_crossed.item(w):
            if newborn:
                book.newborn[w, : len(newborn)] = [birth.vehicle for birth in newborn]
            changed = self._hand_over(
                division.zones, division.borders, division.zoned, division.side,
                w, check_all, len(newborn), book,
            )  # fmt: skip
            if changed < 0:
                self._refuse(changed)
        if changed:
            self._note_teleports(changed)
        self._neighbours = division.neighbours
        # Vehicles that entered after the ghosts were renewed have not been checked.
        if book.owned.item(w) != (vehicles if check_all else vehicles - len(newborn)):
            raise ProtocolError(
                f"the zones own {division.counts(w)} vehicles, but {vehicles} are expected"
            )
        book.ms[w] = 1e3 * perf_counter()
        return changed

    def _note_teleports(self, changed: int) -> None:
        """Record the teleports among the newest changes: their zones are not neighbours."""
        division, last = self._division, len(self)
        new = self._book.changes[self._world, last - changed : last]
        near = division.neighbours[new["source"], new["target"]]
        if near.all():
            return
        are_cut = self._neighbours is not division.neighbours
        far = new[~near]
        if not (are_cut or division.may_teleport):
            raise self._no_neighbour(OwnerChange(*far[0].item()))
        self._teleports.update(zip(far["tick"].tolist(), far["vehicle"].tolist(), strict=True))

    def teleports(self, switches: Iterable[Switch], tick: int) -> tuple[int, ...]:
        """Return the vehicles whose new owner in a tick is not a neighbour of the old owner."""
        if not self._teleports:
            return ()
        return tuple(s.vehicle for s in switches if (tick, s.vehicle) in self._teleports)

    def forget_teleports(self, tick: int) -> None:
        """Forget the teleports up to a tick."""
        if self._teleports:
            self._teleports = {entry for entry in self._teleports if entry[0] > tick}

    def _refuse(self, why: int) -> None:
        change = OwnerChange(*self._book.changes[self._world, len(self)].item())
        if why == NOT_OWNED:
            raise ConfigError(f"zone {change.source} does not own vehicle {change.vehicle}")
        if not self._division.neighbours[change.source, change.target]:
            raise self._no_neighbour(change)
        raise self._division.changes.unseen(change.vehicle, change.target)

    def _no_neighbour(self, change: OwnerChange) -> ProtocolError:
        zones = np.flatnonzero(self._division.neighbours[change.source]).tolist()
        return ProtocolError(refused(change.vehicle, change.source, change.target, zones))

    def release(self, changed: int) -> None:
        """Complete the newest changes at the end of their tick."""
        division = self._division
        self._release(
            division.zones, division.zoned, division.side,
            self._world, changed, 1e3 * perf_counter(), self._book,
        )  # fmt: skip

    def __len__(self) -> int:
        return self._book.num_changes.item(self._world)

    def newest(self, count: int) -> list[OwnerChange]:
        last = len(self)
        found = self._book.changes[self._world, last - count : last]
        return [OwnerChange(*change) for change in found.tolist()]

    def take(self, but: int = 0) -> NDArray[np.void]:
        """Return and remove all changes CHANGE (n,), except the `but` newest changes."""
        last = len(self)
        changes = self._book.changes[self._world]
        taken: NDArray[np.void] = changes[: last - but].copy()
        changes[:but] = changes[last - but : last].copy()
        self._book.num_changes[self._world] = but
        return taken

    def take_counts(self) -> tuple[int, int]:
        """Return and clear two sums over ticks: near vehicles, and vehicles that turned back."""
        acknowledged, aborted = self._book.acknowledged, self._book.aborted
        counts = acknowledged.item(self._world), aborted.item(self._world)
        acknowledged[self._world] = aborted[self._world] = 0
        return counts

    def coming(self) -> list[tuple[int, int]]:
        """Return (vehicle, zone to which it was offered) of the last complete tick."""
        book, w = self._book, self._world
        turn = 1 - book.turn.item(w)
        entries = book.coming[w, turn, : book.num_coming[w, turn]]
        return list(zip(entries["vehicle"].tolist(), entries["target"].tolist(), strict=True))

    def save(self) -> SavedBorders:
        """Return the state of vehicles near borders, on which the next tick depends."""
        book, w = self._book, self._world
        now = book.turn.item(w)
        num_now, num_before = book.num_coming[w, now], book.num_coming[w, 1 - now]
        return SavedBorders(
            book.tick.item(w),
            book.acknowledged.item(w),
            book.aborted.item(w),
            book.num_crossed.item(w),
            book.owned.item(w),
            book.known.item(w),
            book.near[w, : book.num_near[w]],
            book.coming[w, now, :num_now],
            book.coming[w, 1 - now, :num_before],
        )

    def go_on(self, saved: SavedBorders) -> None:
        """Resume from a state that `save` returned. Durations count from this call."""
        book, w = self._book, self._world
        now = book.turn.item(w)
        self.reset(saved.tick)
        self._neighbours = self._division.neighbours
        book.acknowledged[w], book.aborted[w] = saved.acknowledged, saved.aborted
        book.num_crossed[w], book.owned[w], book.known[w] = saved.crossed, saved.owned, saved.known
        book.num_near[w] = len(saved.near)
        book.near[w, : len(saved.near)] = saved.near
        book.ms[w] = 1e3 * perf_counter()
        for turn, coming in ((now, saved.coming), (1 - now, saved.before)):
            book.num_coming[w, turn] = len(coming)
            book.coming[w, turn, : len(coming)] = coming
            book.coming["ms"][w, turn, : len(coming)] = book.ms[w]

    def reset(self, tick: int) -> None:
        self._book.num_changes[self._world] = 0
        self._teleports.clear()
        self._book.tick[self._world] = tick
