"""What goes between processes about agents, as kernels write and read it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import MessageError
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.zones.kernels.agent_frames import (
    Outcome,
    note_own,
    pack_agents,
    pack_results,
    take_agents,
    take_results,
)

Array = NDArray[Any]
Flags = NDArray[np.bool_]

COMMON = (
    "rewards", "terminations", "truncations", "acted", "vehicle_done", "vehicle_ids", "mask",
    "terms", "arrivals", "ticks", "episode_over",
)  # fmt: skip


class _Room:
    """Where a frame is written."""

    def __init__(self, size: int) -> None:  # bytes, at most
        self.words = np.empty(-(-size // 8), dtype=np.int64)
        self.data = self.words.view(np.uint8)


def _tables(arrays: Sequence[Array]) -> tuple[NDArray[np.uint8], ...]:
    """(W, A, …) as bytes of each agent, (W · A, b), views."""
    num = arrays[0].shape[0] * arrays[0].shape[1]
    assert all(array.flags.c_contiguous for array in arrays), "these are views of them"
    return tuple(_flat(array).reshape(num, array.nbytes // max(num, 1)) for array in arrays)


def _flat(array: Array) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)


def _size(tables: Sequence[Array]) -> int:
    """Bytes of a frame of all agents."""
    return 8 + sum(8 * len(tables[0]) + table.size for table in tables)


def _read(data: memoryview) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Whole words of a frame, and its bytes. Raises MessageError: it has not got any."""
    if len(data) < 8:
        raise MessageError(f"{len(data)} bytes are not what a node tells of its agents")
    return np.frombuffer(data, np.int64, len(data) // 8), np.frombuffer(data, np.uint8)


class AgentStream:
    """Rows of some tables, between nodes."""

    def __init__(self, tables: Sequence[Array]) -> None:  # (W, A, …)
        self._tables = _tables(tables)
        self._room = _Room(_size(self._tables))
        self._mine = np.zeros(len(self._tables[0]), dtype=np.bool_)
        self._note = specialized(note_own, checks=False)
        self._pack = specialized(pack_agents, checks=False)
        self._unpack = specialized(take_agents, checks=False)

    def packed(
        self,
        present: Flags,  # (W, A) agents that have sensed in this node
        chosen: Flags,  # (W,) in these worlds
        number: int,  # of this node
        own: Flags,  # (W, A) written: those that have sensed here last
        owner: NDArray[np.int32],  # (W · A,) written: the node of each agent
    ) -> Bytes:
        """What is told of the agents of this node, until the next is packed."""
        room = self._room
        self._note(present, chosen, number, own, self._mine, owner)
        return room.data[: self._pack(self._mine, self._tables, room.words, room.data)].data

    def read(self, data: memoryview, number: int, owner: NDArray[np.int32]) -> None:
        """Write what node `number` tells to the tables, and that it owns these agents.

        Raises:
            MessageError: it is none, or is about agents that there are not.
        """
        if self._unpack(self._tables, *_read(data), number, owner) != len(data):
            raise MessageError(f"{len(data)} bytes are not what a node tells of its agents")


class ResultStream:
    """What a step or a reset gave, from nodes to the caller."""

    def __init__(self, arrays: StepArrays) -> None:
        sensed, final = (
            _tables([observations, *(array for frames in rig.values() for array in frames)])
            for observations, rig in (
                (arrays.observations, arrays.frames),
                (arrays.final_observations, arrays.final_frames),
            )
        )
        common = tuple(_flat(getattr(arrays, name)) for name in COMMON)
        self._outcome = Outcome(common, sensed, final, arrays.episode_over, arrays.terminations)
        size = sum(part.size for part in common) + _size(sensed) + _size(final)
        self._room = _Room(size + 16)
        self._mine = np.zeros(arrays.mask.size, dtype=np.bool_)
        self._unread = np.zeros(arrays.mask.size, dtype=np.int32)
        self._pack = specialized(pack_results, checks=False)
        self._unpack = specialized(take_results, checks=False)

    def packed(
        self,
        own: Flags,  # (W, A) agents that have sensed in this node
        chosen: Flags,  # (W,) the worlds that have been reset, or stepped
        before: Flags,  # (W, A) those of before worlds began anew
        of_step: bool,
        with_common: bool,  # what all nodes know alike goes along
    ) -> Bytes:
        """The results of one node, until the next are packed."""
        room = self._room
        told = self._outcome, own, chosen, before, of_step, with_common, self._mine
        return room.data[: self._pack(*told, room.words, room.data)].data

    def read(
        self,
        data: memoryview,
        chosen: Flags,  # (W,) the worlds that have been reset, or stepped
        of_step: bool,
        with_common: bool,  # it is the first one: it tells what all know alike
        number: int,  # of the node
        owner: NDArray[np.int32],  # (W · A,) written: the node of each agent
    ) -> None:
        """Write what a node has sent to the arrays.

        Raises:
            MessageError: it is none, or is about agents that there are not.
        """
        told = self._outcome, chosen, of_step, with_common, number, owner, self._unread
        if not self._unpack(*told, *_read(data)):
            raise MessageError(f"{len(data)} bytes are not the results of a node")
