"""`InvariantMonitor`: checks of the invariants of ownership after every tick of every world.

One compiled pass over the rows (`kernels.invariant_checks`) adds up hashes of the vehicles by zone,
and finds vehicles that have entered or left. The expected owners come from the coordinators'
records, at a cost that grows with the changes. `coordinator.violations` describes violations in
detail.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ProtocolError
from cavmarl.driving.vehicles import GHOST_FIELDS
from cavmarl.handoff.coordinator.handoff_log import OwnerChange
from cavmarl.handoff.coordinator.row_digests import digest_tables
from cavmarl.handoff.coordinator.violations import Violations
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.kernels.invariant_checks import (
    ANY_LATE,
    FINDING,
    KIND_NONE,
    TALLY,
    CheckTime,
    make_kept,
    make_strays,
    owner_hash,
    watch,
)
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Birth, Commit, Record, Reset
from cavmarl.ownership.table import Table
from cavmarl.ownership.trace import LOG, TraceEntry, describe
from cavmarl.ownership.trace_check import Owner, TraceChecker

WORD = 1 << 64


class Departed(NamedTuple):
    """A vehicle that has left the world since the last tick."""

    vehicle: int
    zone: int  # the vehicle's last owner
    epoch: int


def _add(sums: NDArray[np.uint64], zone: int, term: int) -> None:
    sums[zone] = (int(sums[zone]) + term) % WORD


def _nothing() -> None:
    """Do nothing: there are no late records."""


class OwnersOnRecord:
    """The owners according to the records of a coordinator, with a check of the records.

    This class receives the same records as a `Trace`. A coordinator that delays its records first
    announces changes of owner with `foretold`.

    Attributes:
        entered: number of vehicles that have entered.
        left: number of vehicles that have left.
        ask: function that makes the coordinator write its outstanding records.
    """

    def __init__(
        self,
        zones: int,
        limits: Limits,
    ) -> None:
        self.entered = self.left = 0  # since the reset
        self._checker = TraceChecker(limits.deferral, limits.lifetime, is_direct=True)
        self._sums = np.zeros(zones, dtype=np.uint64)
        self._current = self._sums  # `_sums`, including announced changes
        self.ask: Callable[[], None] = _nothing

    @property
    def owners(self) -> dict[int, Owner]:
        """The (zone, epoch) of each vehicle at the committed tick, by id."""
        self.ask()
        return self._checker.owners

    def logged(self, records: Iterable[Record]) -> None:
        """Receive records. Raises ProtocolError if a record cannot come from a correct run."""
        for record in records:
            self._take(record)
            if isinstance(record, Reset):
                self.entered = self.left = 0
                self._current = self._sums = np.zeros_like(self._sums)
            elif isinstance(record, Commit):
                self._commit()

    def foretold(self, changes: Iterable[OwnerChange]) -> None:
        """Receive changes of owner of the committed tick, whose records follow later."""
        sums = self._current = self._current.copy()
        for change in changes:
            _add(sums, change.source, -int(owner_hash(change.vehicle, change.epoch - 1)))
            _add(sums, change.target, int(owner_hash(change.vehicle, change.epoch)))

    def go_on(self, table: Table) -> None:
        """Resume with the table of a coordinator that resumes from a saved state."""
        self._checker.go_on(table)
        self.entered, self.left = len(table.owners), 0
        sums = self._current = self._sums = np.zeros_like(self._sums)
        for vehicle, (zone, epoch) in table.owners.items():
            _add(sums, zone, int(owner_hash(vehicle, epoch)))

    def sums(self, births: Sequence[Birth], gone: Sequence[Departed] = ()) -> NDArray[np.uint64]:
        """Return sums (k,) of `owner_hash` by zone, including changes not recorded yet."""
        if not (births or gone):
            return self._current
        sums = self._current.copy()
        for vehicle, zone, _ in births:
            _add(sums, zone, int(owner_hash(vehicle, 0)))
        for vehicle, zone, epoch in gone:
            _add(sums, zone, -int(owner_hash(vehicle, epoch)))
        return sums

    def _take(self, record: Record) -> None:
        entry = TraceEntry(LOG, record)
        try:
            self._checker.take(entry)
        except ProtocolError as error:
            raise ProtocolError(
                f"tick {record.tick}: order of records: {describe(entry)}: {error}"
            ) from None

    def _commit(self) -> None:
        sums = self._current = self._sums  # the records now include all announced changes
        for vehicle, before, after in self._checker.changes:
            if before is None:
                self.entered += 1
            else:
                _add(sums, before[0], -int(owner_hash(vehicle, before[1])))
            if after is None:
                self.left += 1
            else:
                _add(sums, after[0], int(owner_hash(vehicle, after[1])))


class InvariantMonitor:
    """Raises ProtocolError after the first tick in which an invariant does not hold.

    Its memory grows with the size of the worlds, but not with the length of their run.
    """

    def __init__(
        self, division: ZonedShards, records: Sequence[OwnersOnRecord], longest_move_m: float
    ) -> None:
        self._division = division
        self._records = tuple(records)
        self._limit_m = longest_move_m
        _, count, num_worlds, capacity = division.zoned.rows.shape
        self._ticks = [0] * num_worlds
        self._vehicles: list[set[int]] = [set() for _ in range(num_worlds)]
        # The results of the last check and of the check before it.
        self._kept = [
            (make_kept(count, capacity), make_kept(count, capacity)) for _ in range(num_worlds)
        ]
        self._strays = make_strays(count, capacity)
        self._masks, self._factors = digest_tables(GHOST_FIELDS)
        self._words = division.zoned.rows.view(np.uint64).reshape(
            *division.zoned.rows.shape, len(self._masks)
        )
        self._tallies = np.zeros(division.count, dtype=TALLY)
        self._found = np.zeros(1, dtype=FINDING)
        self._watch = specialized(watch)

    def begin(self, w: int, births: Sequence[Birth]) -> None:
        """Check a world that has been reset. Raises ProtocolError if an invariant does not hold."""
        self._begin(w)
        self._check_world(w, births, new_late=0)

    def go_on(
        self, w: int, table: Table, births: Sequence[Birth], gone: Sequence[Departed] = ()
    ) -> None:
        """Check a world that resumes from a saved state.

        Raises:
            ProtocolError: an invariant does not hold.
        """
        self._records[w].go_on(table)
        self._begin(w)
        self._check_world(w, births, new_late=ANY_LATE, gone=gone)

    def _begin(self, w: int) -> None:
        self._ticks[w] = self._division.ticks(w)[0]
        self._kept[w][0].num[:] = 0
        self._vehicles[w].clear()

    def end(self, w: int, births: Sequence[Birth]) -> None:
        """Check a world after a tick. Raises ProtocolError if an invariant does not hold."""
        self._ticks[w] += 1
        self._check_world(w, births, new_late=1)

    def _check_world(
        self, w: int, births: Sequence[Birth], new_late: int, gone: Sequence[Departed] = ()
    ) -> None:
        division, record = self._division, self._records[w]
        clock = CheckTime(self._ticks[w], new_late, self._limit_m)
        before, now = self._kept[w]
        kind = self._watch(
            division.zones, division.halo, division.zoned, self._words, division.side, w, clock,
            self._masks, self._factors, before, now, self._strays,
            record.entered + len(births) - record.left - len(gone), record.sums(births, gone),
            self._tallies, self._found,
        )  # fmt: skip
        self._kept[w] = now, before
        holds = (
            kind == KIND_NONE
            and self._are_single(w)
            and all(tick == clock.tick for tick in division.ticks(w))
        )
        if not holds:
            vehicle = int(self._found["vehicle"][0])
            violations = Violations(division, w, clock, before)
            violations.explain(kind, vehicle, record.owners, births)

    def _are_single(self, w: int) -> bool:
        """Record entered and left vehicles. Return whether no vehicle has entered twice."""
        entered = self._strays.entered[: self._found["entered"].item()].tolist()
        left = self._strays.left[: self._found["left"].item()].tolist()
        vehicles = self._vehicles[w]
        vehicles.difference_update(left)
        total = len(vehicles) + len(entered)
        vehicles.update(entered)
        return len(vehicles) == total
