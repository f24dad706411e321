"""Commands and results as bytes, between the caller and its nodes."""

from __future__ import annotations

import json
import struct
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.nodes.links import Bytes
from cavmarl.parallel.step_arrays import StepArrays
from cavmarl.parallel.worlds_job import Task

_HEAD = struct.Struct("<II")
_INPUTS: Mapping[Task, tuple[str, ...]] = {
    Task.STEP: ("declared", "inserted"),
    Task.RESET: ("chosen",),
}
_COMMON = (
    "rewards", "terminations", "truncations", "acted", "vehicle_done", "vehicle_ids", "mask",
    "terms", "arrivals", "ticks", "episode_over",
)  # fmt: skip


def pieces_of(task: Task, payload: Any, arrays: StepArrays) -> list[Bytes]:
    """A command: the task, what it is told, and the arrays that all nodes read."""
    said = json.dumps(payload).encode()
    read = (_flat(getattr(arrays, name)).data for name in _INPUTS.get(task, ()))
    return [_HEAD.pack(task, len(said)), said, *read]


def command_of(data: memoryview, arrays: StepArrays) -> tuple[Task, Any, int]:
    """The same at the other end, and where it ends; the arrays are written to those given."""
    task, size = _HEAD.unpack_from(data)
    at = _HEAD.size + size
    for name in _INPUTS.get(Task(task), ()):
        at = _fill(_flat(getattr(arrays, name)), data, at)
    return Task(task), json.loads(bytes(data[_HEAD.size : _HEAD.size + size])), at


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
    for mask, sensed in zip((own, before & ended[:, None]), _sensed(arrays), strict=True):
        where = np.flatnonzero(mask.reshape(-1))
        pieces.append(np.int64(where.size).tobytes())
        if where.size:
            pieces += [where.data, *(_flat(_by_agent(array)[where]).data for array in sensed)]
    return pieces


def _sensed(arrays: StepArrays) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """What agents have sensed, (W, A, …), and the same of those that have ended."""
    found = []
    for observations, rig in (
        (arrays.observations, arrays.frames),
        (arrays.final_observations, arrays.final_frames),
    ):
        found.append([observations, *(array for frames in rig.values() for array in frames)])
    return found[0], found[1]


def clear_sensed(arrays: StepArrays, chosen: NDArray[np.bool_]) -> None:
    """Agents without a vehicle have zeros, in the chosen worlds (W,)."""
    for array in _sensed(arrays)[0]:
        array[chosen] = 0


def _by_agent(array: NDArray[Any]) -> NDArray[Any]:
    """(W, A, …) as (W · A, …), a view."""
    return array.reshape(-1, *array.shape[2:])


def take_results(
    data: memoryview,
    arrays: StepArrays,
    with_common: bool,  # it comes from the node that tells what all know alike: the first one
    of_step: bool,  # and not of a reset
) -> NDArray[np.int64]:
    """Write what a node has sent to the arrays; the agents that it owns, over all worlds."""
    at = 0
    own = np.zeros(0, dtype=np.int64)
    if with_common:
        for name in _COMMON:
            at = _fill(_flat(getattr(arrays, name)), data, at)
        if of_step:
            ended = arrays.episode_over | arrays.terminations.any(axis=1)
            for array in _sensed(arrays)[1]:
                array[ended] = 0
    for is_final, sensed in enumerate(_sensed(arrays)):
        num = int(np.frombuffer(data, np.int64, 1, at)[0])
        at += 8
        if num:
            where = np.frombuffer(data, np.int64, num, at)
            at += where.nbytes
            own = own if is_final else where
            for target in map(_by_agent, sensed):
                rows = np.frombuffer(data, target.dtype, num * target[0].size, at)
                target[where] = rows.reshape(num, *target.shape[1:])
                at += rows.nbytes
    return own


def worlds_payload(saved: Sequence[bytes], only_reads: bool = False) -> dict[str, Any]:
    """Worlds as bytes, as a payload; see `LocalWorlds.save_worlds`."""
    return {"saved_worlds": [b64encode(one).decode() for one in saved], "only_reads": only_reads}


def saved_of(payload: Mapping[str, Any]) -> list[bytes]:
    return [b64decode(one) for one in payload["saved_worlds"]]


def _flat(array: NDArray[Any]) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)


def _fill(flat: NDArray[np.uint8], data: memoryview, at: int) -> int:
    flat[:] = np.frombuffer(data, np.uint8, flat.size, at)
    return at + flat.size
