"""`MovableWorlds`: worlds of a worker that may move to other workers.

Worlds move between two commands. A worker that gives worlds away writes them to its outbox, which
all workers can read (PACK). Then each worker restarts with the worlds that it has kept and with its
new worlds, which it finds in the outboxes of other workers (UNPACK). Both tasks give the same
result if they are repeated, so a worker that dies during a move is replaced as usual. The bounds,
which say which worker has which worlds, belong to the committed state.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.state.state_image import Image
from cavmarl.parallel.workers.worker_worlds import WorkerWorlds
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task

Array = NDArray[Any]
Share = list[Array]
MakeWorlds = Callable[[int, int], LocalWorlds]


class MovableWorlds(WorkerWorlds):
    """Worlds with consecutive numbers, which may be replaced by other worlds between commands."""

    def __init__(
        self,
        make: MakeWorlds,  # makes the worlds [first, last), given these two numbers
        bounds: Sequence[int],  # first world of each worker, and the number of worlds
        number: int,  # number of this worker
        outboxes: Sequence[Image],  # outboxes of all workers
        spent_s: NDArray[np.float64],  # (W,) total processor time of each world, updated
    ) -> None:
        self._make = make
        self._number = number
        self._outboxes = outboxes
        self._spent_s = spent_s
        self._bounds = np.array(bounds, dtype=np.int64)
        super().__init__(make(*self._range), self._range[0])
        self.tasks = {Task.PACK: self._pack, Task.UNPACK: self._unpack}

    @property
    def _range(self) -> tuple[int, int]:
        first, last = self._bounds[self._number : self._number + 2].tolist()
        return first, last

    def step(self) -> None:
        """Step; divide the processor time among the worlds in proportion to their vehicles."""
        began_ns = time.thread_time_ns()
        super().step()
        spent_s = 1e-9 * (time.thread_time_ns() - began_ns)
        vehicles = self.worlds.simulation.running() + 1
        self._spent_s[slice(*self._range)] += vehicles * (spent_s / float(vehicles.sum()))

    def _pack(self, bounds: Sequence[int]) -> None:
        """Write the worlds that leave this worker to its outbox."""
        first = self._range[0]
        leaving = _leaving(self._bounds, bounds, self._number)
        if leaving:
            shares = (self.worlds.share_of(world - first) for world in leaving)
            self._outboxes[self._number].write([array for share in shares for array in share])

    def _unpack(self, bounds: Sequence[int]) -> None:
        first, last = bounds[self._number : self._number + 2]
        if (first, last) == self._range:
            self._bounds[:] = bounds
            return
        own = self._range[0]
        found = {world: self.worlds.share_of(world - own) for world in range(*self._range)}
        found |= self._read_outboxes(bounds, range(first, last))
        worlds = self._make(first, last)
        worlds.load(worlds.join([found[world] for world in range(first, last)]))
        self._bounds[:] = bounds
        self.use(worlds, first)

    def _read_outboxes(self, bounds: Sequence[int], wanted: range) -> dict[int, Share]:
        dtypes = [array.dtype for array in self.worlds.share_of(0)]
        found = {}
        for number, outbox in enumerate(self._outboxes):
            leaving = _leaving(self._bounds, bounds, number)
            if number == self._number or not set(leaving) & set(wanted):
                continue
            arrays = iter(outbox.read(dtypes * len(leaving)))
            for world in leaving:
                found[world] = [next(arrays) for _ in dtypes]
        return found

    def save(self) -> list[Array]:
        """Return the bounds of all workers, and the state on which the next step depends."""
        saved, parts = self.worlds.save(), self.worlds.num_parts
        sizes = np.array([len(rows) for rows in saved[-parts:]], dtype=np.int64)
        return [self._bounds, *saved[:-parts], sizes, _concatenated(saved[-parts:])]

    def load(self, saved: Sequence[Array]) -> None:
        bounds, *rest, sizes, rows = saved
        before = self._range
        self._bounds[:] = bounds
        if self._range != before:
            self.use(self._make(*self._range), self._range[0])
        ends = np.concatenate([[0], np.cumsum(sizes)]).tolist()
        self.worlds.load([*rest, *(rows[first:last] for first, last in pairwise(ends))])


def _leaving(before: Array, after: Sequence[int], number: int) -> list[int]:
    """Return the worlds that a worker gives away."""
    first, last = before[number : number + 2].tolist()
    kept = range(*after[number : number + 2])
    return [world for world in range(first, last) if world not in kept]


def _concatenated(parts: Sequence[Array]) -> Array:
    """Concatenate records as raw bytes; NumPy would copy them field by field."""
    dtype = parts[0].dtype
    raw = np.dtype((np.void, dtype.itemsize))
    joined: Array = np.concatenate([part.view(raw) for part in parts]).view(dtype)
    return joined
