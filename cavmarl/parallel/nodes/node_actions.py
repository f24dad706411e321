"""`Actions`: what agents do in a step, which goes to the nodes that own their vehicles.

The caller knows which node sensed for an agent last. After nodes were lost, or zones moved, that
may be another one: a node that is told what an agent of another one does refuses it, with the
owner's number, and the caller sends it there. A node waits until it knows what all its agents do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.parallel.nodes.links import Bytes
from cavmarl.parallel.step_arrays import StepArrays

Agents = NDArray[np.int64]
"""Some, counted over all worlds."""

ZoneRects = list[list[float]]
"""Zones as `node_cuts.told_zones` gives them."""

UNOWNED = -1  # owns an agent that has no vehicle


class Actions(NamedTuple):
    """Those of all agents of W worlds in one step."""

    controls: NDArray[np.float64]  # (W · A, 2)
    meta_actions: NDArray[np.int64]  # (W · A,)
    mask: NDArray[np.bool_]  # (W · A,) agents that act

    @classmethod
    def of(cls, arrays: StepArrays) -> Actions:
        arrays_of = (arrays.controls.reshape(-1, 2), arrays.meta_actions, arrays.mask)
        return cls(arrays_of[0].copy(), arrays_of[1].flatten(), arrays_of[2].flatten())

    def of_nodes(
        self, numbers: Sequence[int], owner: NDArray[np.int32]
    ) -> Iterator[tuple[int, list[Bytes]]]:
        """What each node is told: of its agents, and of those that may get a vehicle anywhere.

        Args:
            numbers: of the nodes.
            owner: (W · A,) the node of each agent, as far as is known.
        """
        known = np.where(self.mask, owner, UNOWNED)
        unowned = self.some(np.flatnonzero(known == UNOWNED))
        for number in numbers:
            yield number, self.some(np.flatnonzero(known == number)) + unowned

    def some(self, agents: Agents) -> list[Bytes]:
        controls, meta_actions = self.controls[agents], self.meta_actions[agents]
        number = np.int64(len(agents)).tobytes()
        return [number, agents.data, controls.reshape(-1).data, meta_actions.data]


class NodeCommand(NamedTuple):
    """What all nodes are to do."""

    pieces: list[bytes]  # of its frame, the same for all
    changes: bool  # what the worlds are
    ticks: int  # of the worlds
    actions: Actions | None = None  # of a step
    cut: ZoneRects | None = None  # zones that the worlds have from then on
    receptions: list[bytes] | None = None  # what a network simulator has said so far, in a step

    def of_nodes(
        self, numbers: Sequence[int], owner: NDArray[np.int32]
    ) -> Iterator[tuple[int, list[Bytes]]]:
        """The pieces of the frame that each node gets; arguments as of `Actions.of_nodes`."""
        if self.actions is None:
            for number in numbers:
                yield number, list[Bytes](self.pieces)
        else:
            for number, own in self.actions.of_nodes(numbers, owner):
                yield number, [*self.pieces, *own]


def take_actions(data: memoryview, at: int, arrays: StepArrays) -> tuple[Agents, int]:
    """Write what some agents do to the arrays; which, and where in the data it ends."""
    (number,), at = _read(data, at, np.int64, 1)
    agents, at = _read(data, at, np.int64, int(number))
    controls, at = _read(data, at, np.float64, 2 * int(number))
    meta_actions, at = _read(data, at, np.int64, int(number))
    arrays.controls.reshape(-1, 2)[agents] = controls.reshape(-1, 2)
    arrays.meta_actions.reshape(-1)[agents] = meta_actions
    return agents, at


def refusal(agents: Agents, owner: NDArray[np.int32]) -> list[Bytes]:
    """What a node says of agents that are not its own: the number of the owner of each."""
    return [np.stack([agents, owner[agents]]).reshape(-1).data]


def read_refusal(data: memoryview, num_agents: int, nodes: set[int]) -> NDArray[np.int64]:
    """(2, n) agents, and the node that owns each.

    Raises:
        MessageError: it is none, or names agents or nodes that there are not.
    """
    if len(data) % 16:
        raise MessageError(f"a refusal of {len(data)} bytes is none")
    found = np.frombuffer(data, np.int64).reshape(2, -1)
    agents, owners = found
    if ((agents < 0) | (agents >= num_agents)).any() or not set(owners.tolist()) <= nodes:
        raise MessageError("a refusal names agents or nodes that there are not")
    return found


def _read(data: memoryview, at: int, kind: Any, num: int) -> tuple[NDArray[Any], int]:
    found = np.frombuffer(data, kind, num, at) if num else np.zeros(0, kind)
    return found, at + found.nbytes
