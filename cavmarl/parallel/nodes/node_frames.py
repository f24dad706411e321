"""Commands and results as bytes, between the caller and its nodes."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.nodes.links import Bytes
from cavmarl.parallel.step_arrays import StepArrays
from cavmarl.parallel.worlds_job import Task

_HEAD = struct.Struct("<II")
_INPUTS: Mapping[Task, tuple[str, ...]] = {
    Task.STEP: ("controls", "meta_actions", "declared"),
    Task.RESET: ("chosen",),
}
_COMMON = (
    "rewards", "terminations", "truncations", "acted", "vehicle_done", "vehicle_ids", "mask",
    "terms", "arrivals", "ticks", "episode_over",
)  # fmt: skip


def pieces_of(task: Task, letter: Any, arrays: StepArrays) -> list[Bytes]:
    """A command: the task, what it is told, and the arrays that it reads."""
    said = json.dumps(letter).encode()
    read = (_flat(getattr(arrays, name)).data for name in _INPUTS.get(task, ()))
    return [_HEAD.pack(task, len(said)), said, *read]


def command_of(data: memoryview, arrays: StepArrays) -> tuple[Task, Any]:
    """The same at the other end; the arrays are written to those that are given."""
    task, size = _HEAD.unpack_from(data)
    at = _HEAD.size + size
    for name in _INPUTS.get(Task(task), ()):
        at = _fill(_flat(getattr(arrays, name)), data, at)
    return Task(task), json.loads(bytes(data[_HEAD.size : _HEAD.size + size]))


def results_of(
    arrays: StepArrays,
    own: NDArray[np.bool_],  # (W, A) agents whose observations this node has
    before: NDArray[np.bool_],  # (W, A) those of before worlds began anew
    with_common: bool,  # what all nodes know alike goes along
) -> list[Bytes]:
    """What a step or a reset gave, as one node has it."""
    ended = arrays.episode_over | arrays.terminations.any(axis=1)
    pieces: list[Bytes] = []
    if with_common:
        pieces += [_flat(getattr(arrays, name)).data for name in _COMMON]
    for mask, name in ((own, "observations"), (before & ended[:, None], "final_observations")):
        where = np.flatnonzero(mask.reshape(-1))
        rows = getattr(arrays, name).reshape(mask.size, -1)[where]
        pieces += [np.int64(where.size).tobytes(), where.data, _flat(rows).data]
    return pieces


def take_results(
    data: memoryview,
    arrays: StepArrays,
    with_common: bool,  # it comes from the node that tells what all know alike: the first one
    of_step: bool,  # and not of a reset
) -> None:
    """Write what a node has sent to the arrays."""
    at = 0
    if with_common:
        for name in _COMMON:
            at = _fill(_flat(getattr(arrays, name)), data, at)
        if of_step:
            ended = arrays.episode_over | arrays.terminations.any(axis=1)
            arrays.final_observations[ended] = 0.0
    for name in ("observations", "final_observations"):
        num = int(np.frombuffer(data, np.int64, 1, at)[0])
        at += 8
        if num:
            target = getattr(arrays, name)
            target = target.reshape(-1, target.shape[2])
            where = np.frombuffer(data, np.int64, num, at)
            at += where.nbytes
            rows = np.frombuffer(data, target.dtype, num * target.shape[1], at)
            target[where] = rows.reshape(num, -1)
            at += rows.nbytes


def _flat(array: NDArray[Any]) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)


def _fill(flat: NDArray[np.uint8], data: memoryview, at: int) -> int:
    flat[:] = np.frombuffer(data, np.uint8, flat.size, at)
    return at + flat.size
