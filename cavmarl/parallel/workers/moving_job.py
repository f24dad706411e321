"""`MovingJob`: the job of a worker whose worlds may move to other workers.

Worlds go from worker to worker between two commands. A worker that gives some away puts them into
its outbox, which all workers can read (PACK); then each begins anew with what it has kept and what
it finds in the others' outboxes (UNPACK). Both say the same as often as they are asked, so a worker
that dies on the way is replaced as ever; where the worlds are is part of the state that is
committed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.state.state_image import Image
from cavmarl.parallel.workers.worlds_job import WorldsJob
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task

Array = NDArray[Any]
Share = list[Array]
MakeWorlds = Callable[[int, int], LocalWorlds]


class MovingJob(WorldsJob):
    """Some of the worlds, next to each other, and which ones may change."""

    def __init__(
        self,
        make: MakeWorlds,  # worlds from a number to before another one
        bounds: Sequence[int],  # the first world of each worker, and the end of the last one's
        number: int,  # of this worker
        outboxes: Sequence[Image],  # of all workers, in which they leave worlds for others
        spent_s: NDArray[np.float64],  # (W,) where the processor time of each world is added up
    ) -> None:
        self._make = make
        self._number = number
        self._outboxes = outboxes
        self._spent_s = spent_s
        self._bounds = np.array(bounds, dtype=np.int64)
        super().__init__(make(*self._range), self._range[0])

    @property
    def _range(self) -> tuple[int, int]:
        first, last = self._bounds[self._number : self._number + 2].tolist()
        return first, last

    def perform(self, task: int, payload: Any) -> Any:
        if task == Task.PACK:
            self._pack(payload)
        elif task == Task.UNPACK:
            self._unpack(payload)
        elif task == Task.STEP:
            self._spent_s[slice(*self._range)] += self.timed_step()
        else:
            return super().perform(task, payload)
        return None

    def _pack(self, bounds: Sequence[int]) -> None:
        """Leave the worlds that are to be another's in its outbox."""
        first = self._range[0]
        leaving = _leaving(self._bounds, bounds, self._number)
        if leaving:
            shares = (self._worlds.share_of(world - first) for world in leaving)
            self._outboxes[self._number].write([array for share in shares for array in share])

    def _unpack(self, bounds: Sequence[int]) -> None:
        first, last = bounds[self._number : self._number + 2]
        if (first, last) == self._range:
            self._bounds[:] = bounds
            return
        own = self._range[0]
        found = {world: self._worlds.share_of(world - own) for world in range(*self._range)}
        found |= self._found_in_outboxes(bounds, range(first, last))
        worlds = self._make(first, last)
        worlds.load(worlds.join([found[world] for world in range(first, last)]))
        self._bounds[:] = bounds
        self._take(worlds, first)

    def _found_in_outboxes(self, bounds: Sequence[int], wanted: range) -> dict[int, Share]:
        dtypes = [array.dtype for array in self._worlds.share_of(0)]
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
        """Where all worlds are, and what these ones' next step depends on."""
        saved, parts = self._worlds.save(), self._worlds.num_parts
        sizes = np.array([len(rows) for rows in saved[-parts:]], dtype=np.int64)
        return [self._bounds, *saved[:-parts], sizes, _in_one(saved[-parts:])]

    def load(self, saved: Sequence[Array]) -> None:
        bounds, *rest, sizes, rows = saved
        before = self._range
        self._bounds[:] = bounds
        if self._range != before:
            self._take(self._make(*self._range), self._range[0])
        ends = np.concatenate([[0], np.cumsum(sizes)]).tolist()
        self._worlds.load([*rest, *(rows[first:last] for first, last in pairwise(ends))])


def _leaving(before: Array, after: Sequence[int], number: int) -> list[int]:
    first, last = before[number : number + 2].tolist()
    kept = range(*after[number : number + 2])
    return [world for world in range(first, last) if world not in kept]


def _in_one(parts: Sequence[Array]) -> Array:
    """Records below one another; NumPy would copy them field by field."""
    dtype = parts[0].dtype
    raw = np.dtype((np.void, dtype.itemsize))
    joined: Array = np.concatenate([part.view(raw) for part in parts]).view(dtype)
    return joined
