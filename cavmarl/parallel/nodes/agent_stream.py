"""Frames about agents, which kernels write and read."""

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
    UNOWNED,
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
    "terms", "arrivals", "ticks", "episode_over", "signal_observations", "signal_rewards",
    "signal_terms", "signal_masks", "signal_decides", "signal_counts", "signal_states",
    "signal_history", "signal_loops", "final_signal_observations",
)  # fmt: skip


class _Room:
    """A buffer for a frame."""

    def __init__(self, size: int) -> None:  # maximum in bytes
        self.words = np.empty(-(-size // 8), dtype=np.int64)
        self.data = self.words.view(np.uint8)


def _tables(arrays: Sequence[Array]) -> tuple[NDArray[np.uint8], ...]:
    """Return arrays (W, A, …) as the bytes of each agent, (W · A, b), as views."""
    num = arrays[0].shape[0] * arrays[0].shape[1]
    assert all(array.flags.c_contiguous for array in arrays), "tables have to be views"
    return tuple(_flat(array).reshape(num, array.nbytes // max(num, 1)) for array in arrays)


def _flat(array: Array) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)


def _size(tables: Sequence[Array]) -> int:
    """Return the size of a frame of all agents."""
    return 8 + sum(8 * len(tables[0]) + table.size for table in tables)


def _read(data: memoryview) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the whole words and the bytes of a frame. Raises MessageError: it is too short."""
    if len(data) < 8:
        raise MessageError(f"{len(data)} bytes are not a frame about agents")
    return np.frombuffer(data, np.int64, len(data) // 8), np.frombuffer(data, np.uint8)


class AgentStream:
    """Sends rows of tables of agents from each node to the other nodes."""

    def __init__(self, tables: Sequence[Array]) -> None:  # (W, A, …)
        self._tables = _tables(tables)
        self._flags = [
            part
            for part, table in zip(self._tables, tables, strict=True)
            if table.dtype == np.bool_
        ]
        self._room = _Room(_size(self._tables))
        self._mine = np.zeros(len(self._tables[0]), dtype=np.bool_)
        self._note = specialized(note_own, checks=False)
        self._pack = specialized(pack_agents, checks=False)
        self._unpack = specialized(take_agents, checks=False)

    def packed(
        self,
        present: Flags,  # (W, A) agents for which this node has sensed
        chosen: Flags,  # (W,) worlds whose agents are sent
        number: int,  # number of this node
        own: Flags,  # (W, A) output: agents for which this node sensed last
        owner: NDArray[np.int32],  # (W · A,) output: node of each agent
    ) -> Bytes:
        """Return a frame about the agents of this node, valid until the next call."""
        room = self._room
        self._note(present, chosen, number, own, self._mine, owner)
        return room.data[: self._pack(self._mine, self._tables, room.words, room.data)].data

    def read(self, data: memoryview, number: int, owner: NDArray[np.int32]) -> NDArray[np.int64]:
        """Write the frame of node `number` to the tables; record the node as owner of its agents.

        Returns:
            the agents of that node.

        Raises:
            MessageError: the bytes are not a frame about agents, or name agents that are unknown
                or belong to another node.
        """
        words, content = _read(data)
        unowned = np.count_nonzero(owner == UNOWNED)
        if self._unpack(self._tables, words, content, number, owner) != len(data):
            raise MessageError(f"{len(data)} bytes are not a frame about agents")
        if np.count_nonzero(owner == UNOWNED) != unowned - words.item(0):
            raise MessageError("a frame names agents of other nodes, or an agent twice")
        agents = words[1 : 1 + words.item(0)]
        if any(flags[agents].max(initial=0) > 1 for flags in self._flags):
            raise MessageError("a flag of an agent is neither true nor false")
        return agents


class ResultStream:
    """Results of a step or a reset, from nodes to the caller."""

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
        own: Flags,  # (W, A) agents for which this node has sensed
        chosen: Flags,  # (W,) worlds that were reset or stepped
        before: Flags,  # (W, A) `own` before the autoreset
        of_step: bool,
        with_common: bool,  # include the results that all nodes share
    ) -> Bytes:
        """Return the results of this node, valid until the next call."""
        room = self._room
        arguments = self._outcome, own, chosen, before, of_step, with_common, self._mine
        return room.data[: self._pack(*arguments, room.words, room.data)].data

    def read(
        self,
        data: memoryview,
        chosen: Flags,  # (W,) worlds that were reset or stepped
        of_step: bool,
        with_common: bool,  # the node sends the common results, and is read first
        number: int,  # number of the node
        owner: NDArray[np.int32],  # (W · A,) output: node of each agent
    ) -> None:
        """Write the results of a node to the arrays.

        Raises:
            MessageError: the bytes are not results, or name unknown agents.
        """
        arguments = self._outcome, chosen, of_step, with_common, number, owner, self._unread
        if not self._unpack(*arguments, *_read(data)):
            raise MessageError(f"{len(data)} bytes are not the results of a node")
