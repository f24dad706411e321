"""`Recovery`: a tick in which a host dies is begun again from the committed state.

The host of a zone that dies is fenced, and its zone is given to another; a coordinator that dies is
made anew from its journal. Either way the half tick is thrown away and run again. It reads the
same rows, so it leads to the same ones.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.core.errors import JournalError, LostTickError
from cavmarl.handoff.coordinator.coordinators import Coordinators
from cavmarl.handoff.fault_injection.committed_store import COUNTS, CommittedStore
from cavmarl.handoff.fault_injection.injected_faults import (
    CoordinatorDeath,
    Crashes,
    FaultyPhases,
    ZoneDeath,
    give_up,
)
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator
from cavmarl.ownership.directory import StoreError
from cavmarl.shards.shard import Shard

GARBAGE = 0xA5  # what is in a memory that is lost, byte by byte


class Revival(NamedTuple):
    """What it took to go on after a death."""

    tick: int  # of the run, that was on its way
    point: str  # at which it died
    zone: int | None  # whose host it was; None: the coordinator
    ms: float  # from the death to the tick's next beginning


class Recovery:
    """Runs ticks of one world until they are committed."""

    def __init__(
        self,
        shards: Sequence[Shard],  # whose hosts may die
        coordination: Coordinators,  # of the one world
        coordinator: MessageCoordinator,  # its own
        store: CommittedStore,  # the committed state
        phases: FaultyPhases,  # of the tick, in which hosts may die
        crashes: Crashes,  # which processes die where
        # new hosts that a zone may have for one tick, and new coordinators that may come to the
        # same point
        repeats: int,
    ) -> None:
        self.revivals: list[Revival] = []  # one for each death
        self._shards = tuple(shards)
        self._coordination = coordination
        self._coordinator = coordinator
        self._store = store
        self._phases = phases
        self._crashes = crashes
        self._repeats = repeats
        self._deaths: Counter[int | str] = Counter()  # in the tick

    def run(self, tick: Callable[[], None]) -> None:
        """One tick, as often as it takes; after an error the worlds are at the committed tick.

        Raises:
            LostTickError: every host of a zone dies of it; every coordinator dies of it.
        """
        self._deaths.clear()
        self._crashes.tick = self._coordinator.tick + 1
        while True:
            self._phases.on = True
            try:
                tick()
            except (ZoneDeath, CoordinatorDeath, StoreError) as death:
                self._phases.on = False
                if self._revive(death):
                    return
            else:
                self._phases.on = False
                return

    def _revive(self, death: ZoneDeath | CoordinatorDeath | StoreError) -> bool:
        """Whether the tick has been committed all the same."""
        began = time.perf_counter()
        if isinstance(death, CoordinatorDeath):
            self._lose_gate()
            is_done = self._restart()
            self._count(death.point)
            self._note(death.point, None, began)
            return is_done
        zones = death.zones if isinstance(death, StoreError) else (death.zone,)
        for zone in zones:
            self._lose(self._shards[zone])
        self._coordination.load()
        coordinator = self._coordinator
        for zone in zones:
            self._count(zone, death.cause if isinstance(death, ZoneDeath) else "with wrong rows")
            if isinstance(death, ZoneDeath):
                give_up(coordinator, death)
            else:
                coordinator.fence(zone)
            coordinator.host(zone)
            point = death.point if isinstance(death, ZoneDeath) else "wrong rows"
            self._note(point, zone, began)
        return False

    def _count(self, dead: int | str, cause: str = "") -> None:
        """Note that the host of a zone has died, or the coordinator at a point."""
        self._deaths[dead] += 1
        if self._deaths[dead] <= self._repeats:
            return
        tick, times = self._crashes.tick, self._deaths[dead]
        if isinstance(dead, int):
            raise LostTickError(tick, times, dead, cause)
        raise LostTickError(tick, times, cause=dead)

    def _restart(self) -> bool:
        """A new coordinator reads the journal; whether the tick stands in it as committed."""
        coordinator, journal = self._coordinator, self._coordinator.journal
        if journal is None:
            raise JournalError("a coordinator that dies without a journal is gone for good")
        coordinator.journal = journal.reopened()
        coordinator.restart(tuple(coordinator.journal.read()))
        is_done = coordinator.tick == self._crashes.tick
        if is_done:
            self._store.flip()
        self._coordination.load()
        coordinator.resend()
        if is_done:
            self._coordination.check()
        return is_done

    def _lose(self, shard: Shard) -> None:
        worlds = shard.worlds
        for array in (*shard.sides, *(getattr(worlds, name) for name in COUNTS)):
            array.view(np.uint8)[...] = GARBAGE

    def _lose_gate(self) -> None:
        for array in self._store.shared():
            array.view(np.uint8)[...] = GARBAGE

    def _note(self, point: str, zone: int | None, began: float) -> None:
        ms = 1000.0 * (time.perf_counter() - began)
        self.revivals.append(Revival(self._crashes.tick, point, zone, ms))
