"""`HostedWorlds`: the job of a host that runs some of the worlds for a remote caller."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.kernels.step_results import Results
from cavmarl.parallel.checkpoint.world_states import WorldMove, buffers, pack, unpack
from cavmarl.parallel.hosts.host_process import RemoteJob, TaskOutcome, serve
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.processes.shared_memory import Segment
from cavmarl.parallel.processes.state_image import Image
from cavmarl.parallel.recipe import ELSEWHERE, world_of
from cavmarl.parallel.step_arrays import StepArrays
from cavmarl.parallel.tasks import Task
from cavmarl.parallel.worlds_job import WorldsJob
from cavmarl.sensors.mounted.frames import Frames

Array = NDArray[Any]

_IMAGE_BYTES = 1 << 12

# Fields of `StepArrays` that every step writes.
_STEPPED = ("observations", "ticks", *Results._fields)
# Those that a reset writes, of the worlds that it is about.
_BEGUN = ("observations", "mask", "vehicle_ids", "vehicle_done", "terms", "ticks", "episode_over")


def inputs_of(task: int, arrays: StepArrays) -> list[Array]:
    """What goes into a task, at both ends."""
    if task == Task.STEP:
        return [arrays.controls, arrays.meta_actions, arrays.declared, arrays.inserted]
    return [arrays.chosen] if task == Task.RESET else []


def results_of(
    task: int,
    arrays: StepArrays,  # of the worlds that have done it
    ended: Sequence[int] | None,  # worlds in which something ended; None: none
) -> list[Array]:
    """What comes out of a task, at both ends."""
    if task == Task.STEP:
        finals = [arrays.final_observations, *_sensed(arrays.final_frames)]
        last = [array[w] for w in ended or () for array in finals]
        return [*(getattr(arrays, name) for name in _STEPPED), *_sensed(arrays.frames), *last]
    if task == Task.RESET:
        return [*(getattr(arrays, name) for name in _BEGUN), *_sensed(arrays.frames)]
    if task == Task.WRITE_STATES:
        return [arrays.states]
    return [arrays.suggested] if task == Task.SUGGEST else []


def _sensed(frames: Frames) -> Iterator[Array]:
    for sensor in frames.values():
        yield from sensor


def host_worlds(recipe: str, place: tuple[str, int], secret: bytes, number: int) -> None:
    """The whole life of a process that hosts worlds; see `host_process.serve`."""
    serve(partial(HostedWorlds, json.loads(recipe)), place, secret, number)


class HostedWorlds(RemoteJob):
    """Some of the worlds, next to each other; which ones, only their caller knows.

    Raises:
        WorkerError: this machine's files are not the caller's.
        CavmarlError: they cannot be read.
    """

    _worlds: LocalWorlds
    _job: WorldsJob

    def __init__(self, recipe: dict[str, Any]) -> None:
        self._world = world_of(recipe, ELSEWHERE)
        self._in_next_step: bool = recipe["in_next_step"]
        self._measures: bool = recipe["measures"]
        self._one = LocalWorlds(self._world, 1, warm=True)
        self._image = Image(Segment.make(_IMAGE_BYTES))
        self._make(recipe["size"])

    def fit(self, size: int) -> None:
        if size != len(self._worlds.arrays.mask):
            self._make(size)

    def inputs(self, task: int, payload: Any) -> list[Array]:
        if task == Task.UNPACK:
            move = WorldMove(*payload)
            self._coming = buffers(move.coming, move.bytes)
            return [*self._coming]
        return inputs_of(task, self._worlds.arrays)

    def perform(self, task: int, payload: Any) -> TaskOutcome:
        """Do a task.

        The answer to a step is in which worlds something ended; to PACK, how many worlds leave, and
        their bytes.
        """
        if task == Task.PACK:
            return self._pack(WorldMove(*payload))
        if task == Task.UNPACK:
            self._unpack(WorldMove(*payload))
            return TaskOutcome(None, ())
        if task == Task.STEP:
            return self._step()
        answer = self._job.perform(task, payload)
        return TaskOutcome(answer, results_of(task, self._worlds.arrays, answer))

    def _step(self) -> TaskOutcome:
        arrays, spent_s = self._worlds.arrays, []
        if self._measures:
            spent_s.append(self._job.timed_step())
        else:
            self._job.perform(Task.STEP, None)
        ended = arrays.episode_over | arrays.terminations.any(axis=1)
        answer = np.flatnonzero(ended).tolist() or None
        return TaskOutcome(answer, [*results_of(Task.STEP, arrays, answer), *spent_s])

    def _pack(self, move: WorldMove) -> TaskOutcome:
        """The bytes of all worlds that it does not keep."""
        kept = range(move.first, move.last)
        leaving = [w for w in range(len(self._worlds.arrays.mask)) if w not in kept]
        sizes, content = pack(self._image, [self._share_of(w) for w in leaving])
        return TaskOutcome([len(sizes), content.size], [sizes, content])

    def _unpack(self, move: WorldMove) -> None:
        """Go on with what it keeps and what has come."""
        kept = range(move.first, move.last)
        if not move.coming and len(kept) == len(self._worlds.arrays.mask):
            return
        dtypes = [array.dtype for array in self._share_of(0)]
        coming = unpack(self._image, *self._coming, dtypes)
        mine = map(self._share_of, kept)
        shares = [*coming[: move.before], *mine, *coming[move.before :]]
        worlds = self._new(len(shares))
        begun = results_of(Task.RESET, worlds.arrays, None)
        worlds.load(worlds.join([share[len(begun) :] for share in shares]))
        for w, share in enumerate(shares):
            for array, kept_row in zip(begun, share, strict=False):
                array[w : w + 1] = kept_row
        self._worlds, self._job = worlds, WorldsJob(worlds, 0)

    def _share_of(self, w: int) -> list[Array]:
        """What `save` would give if there were no world but one; views, to be copied."""
        begun = results_of(Task.RESET, self._worlds.arrays, None)
        return [*(array[w : w + 1] for array in begun), *self._worlds.share_of(w)]

    def save(self) -> list[Array]:
        begun = results_of(Task.RESET, self._worlds.arrays, None)
        return [*begun, *(log.words for log in self._logs), *self._worlds.save()]

    def load(self, saved: Sequence[Array]) -> None:
        begun = results_of(Task.RESET, self._worlds.arrays, None)
        rest = iter(saved[len(begun) :])
        for log in self._logs:
            log.take_up(next(rest))
        self._worlds.load(list(rest))
        for array, kept in zip(begun, saved, strict=False):
            array[:] = kept

    def close(self) -> None:
        self._worlds.close()
        self._one.close()

    def _new(self, size: int) -> LocalWorlds:
        return LocalWorlds(self._world, size, in_next_step=self._in_next_step, like=self._one)

    def _make(self, size: int) -> None:
        self._worlds = self._new(size)
        self._logs = self._worlds.keep_logs()
        self._job = WorldsJob(self._worlds, 0)
        self._rehearse()

    def _rehearse(self) -> None:
        """Begin and step once: the first time takes longer, and is none of a death's business.

        Nothing of it stays, since the next host of these worlds begins with a seed, or loads.
        """
        self._worlds.arrays.chosen[:] = True
        self._job.perform(Task.RESET, {"seed": 0, "first_world": 0})
        self._job.perform(Task.STEP, None)
        self._job.perform(Task.SUGGEST, None)
        self.load([array.copy() for array in self.save()])
