"""Commands to nodes as bytes."""

from __future__ import annotations

import json
import struct
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.parallel.worlds.tasks import Task

_HEAD = struct.Struct("<II")
_INPUTS: Mapping[Task, tuple[str, ...]] = {
    Task.STEP: (
        "declared",
        "inserted",
        "external",
        "overridden",
        "lane_changes",
        "signal_choices",
    ),
    Task.RESET: ("chosen",),
}


def pieces_of(task: Task, payload: Any, arrays: StepArrays) -> list[bytes]:
    """Return a command as pieces of a frame: task, payload, and the arrays for all nodes."""
    text = b"" if payload is None else json.dumps(payload).encode()
    read = [getattr(arrays, name) for name in _INPUTS.get(task, ())]
    return [_HEAD.pack(task, len(text)) + text, *(each.tobytes() for each in read if each.size)]


def command_of(data: memoryview) -> tuple[Task, Any, int]:
    """Read a command; return the task, the payload, and the offset of the arrays in bytes."""
    task, size = _HEAD.unpack_from(data)
    at = _HEAD.size + size
    return Task(task), json.loads(bytes(data[_HEAD.size : at])) if size else None, at


class Inputs:
    """The arrays that all nodes read from a command."""

    def __init__(self, arrays: StepArrays) -> None:
        every = {task: [_flat(getattr(arrays, name)) for name in _INPUTS[task]] for task in _INPUTS}
        self._parts = {task: [part for part in parts if part.size] for task, parts in every.items()}

    def read(self, task: Task, data: memoryview, at: int) -> int:
        """Read the arrays of a task; return where they end."""
        for part in self._parts[task]:
            part[:] = np.frombuffer(data, np.uint8, part.size, at)
            at += part.size
        return at


def worlds_payload(saved: Sequence[bytes]) -> list[str]:
    """Return the payload of saved worlds; see `LocalWorlds.save_worlds`."""
    return [b64encode(one).decode() for one in saved]


def saved_of(payload: Sequence[str]) -> list[bytes]:
    """Return the saved worlds of a payload."""
    return [b64decode(one) for one in payload]


def _flat(array: NDArray[Any]) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)
