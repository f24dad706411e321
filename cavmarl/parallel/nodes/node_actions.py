"""`Actions`: actions of agents in a step, which go to the nodes that own their vehicles.

The caller knows which node sensed for an agent last. After nodes were lost, or zones have moved,
the owner may be another node. If a node receives an action for an agent of another node, it refuses
the action and names the owner. Then the caller forwards the action. A node waits until it has the
actions of all its agents.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized, unchecked
from cavmarl.core.errors import MessageError
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.zones.kernels.agent_frames import UNOWNED, pack_actions, take_actions

Agents = NDArray[np.int64]
"""Agents, numbered through all worlds: `w * A + agent`."""

ZoneRects = list[list[float]]
"""Zones as a JSON value, see `node_cuts.zones_as_json`."""

_pack = unchecked(pack_actions)


class Actions(NamedTuple):
    """The actions of all agents of W worlds in one step."""

    controls: NDArray[np.float64]  # (W · A, 2)
    meta_actions: NDArray[np.int64]  # (W · A,)
    mask: NDArray[np.bool_]  # (W · A,) agents that act

    @classmethod
    def of(cls, arrays: StepArrays) -> Actions:
        """Copy the actions from step arrays."""
        arrays_of = (arrays.controls.reshape(-1, 2), arrays.meta_actions, arrays.mask)
        return cls(arrays_of[0].copy(), arrays_of[1].flatten(), arrays_of[2].flatten())

    def of_node(self, number: int, owner: NDArray[np.int32]) -> Bytes:
        """Return the actions for a node: of its agents, and of agents without an owner.

        Args:
            number: number of the node.
            owner: (W · A,) node of each agent, as far as it is known.
        """
        words = np.empty(2 + 4 * len(owner), dtype=np.int64)
        return words[: _pack(*self, owner, number, words, words.view(np.float64))].data

    def some(self, agents: Agents) -> Bytes:
        """Return the actions of some agents, for their owner."""
        owner = np.full(len(self.mask), UNOWNED - 1, dtype=np.int32)
        owner[agents] = 0
        return self._replace(mask=np.ones_like(self.mask)).of_node(0, owner)


class NodeCommand(NamedTuple):
    """A command to all nodes."""

    pieces: list[bytes]  # parts of its frame that are the same for all nodes
    changes: bool  # whether it changes the worlds
    ticks: int  # simulated ticks; 0 unless the command is a step
    actions: Actions | None = None  # actions of the agents, if the command is a step
    cut: ZoneRects | None = None  # new zones of the worlds
    receptions: list[bytes] | None = None  # answers of a network simulator so far in this step

    def of_node(self, number: int, owner: NDArray[np.int32], lease: bytes) -> list[Bytes]:
        """Return the pieces of the frame for a node, see `Actions.of_node`; `lease`: STEP messages.

        The actions start at a whole word of 8 bytes, since kernels read them.
        """
        first, *rest = self.pieces
        actions = [] if self.actions is None else [self.actions.of_node(number, owner)]
        return [first, *actions, *rest, lease]


class ReceivedActions:
    """The actions that a node receives for a step."""

    def __init__(self, arrays: StepArrays, number: int) -> None:  # `number` of the node
        num = arrays.mask.size
        self._number = number
        self._arrays = arrays.controls.reshape(num, 2), arrays.meta_actions.reshape(num)
        self._missing = np.zeros(num, dtype=np.bool_)
        self._wrong = np.empty(num, dtype=np.int64)
        self._unpack = specialized(take_actions, checks=False)
        self.are_due = False  # whether actions of agents of this node are missing

    def due(self) -> list[int]:
        """Return the agents of this node whose actions are missing in the current step."""
        return np.flatnonzero(self._missing).tolist() if self.are_due else []

    def begin(self, owner: NDArray[np.int32]) -> None:
        """Start a step; `owner`: (W · A,) node of each agent."""
        np.equal(owner, self._number, out=self._missing)

    def read(self, data: memoryview, at: int, owner: NDArray[np.int32]) -> tuple[Agents, int]:
        """Write received actions to the arrays.

        Returns:
            agents of other nodes, and where the actions end.

        Raises:
            MessageError: the bytes are not actions.
        """
        words = np.frombuffer(data, np.int64, (len(data) - at) // 8, at)
        size, wrong, missing = self._unpack(
            words, words.view(np.float64), *self._arrays,
            self._missing, owner, self._number, self._wrong,
        )  # fmt: skip
        if size < 0:
            raise MessageError(f"{len(data)} bytes are not actions of agents")
        self.are_due = missing > 0
        return self._wrong[:wrong], at + 8 * size


def refusal(agents: Agents, owner: NDArray[np.int32]) -> list[Bytes]:
    """Return a refusal of agents of other nodes, with the owner of each."""
    return [np.stack([agents, owner[agents]]).reshape(-1).data]


def read_refusal(data: memoryview, num_agents: int, nodes: set[int]) -> NDArray[np.int64]:
    """Read a refusal: (2, n) agents, and the owner of each.

    Raises:
        MessageError: the bytes are not a refusal, or name unknown agents or nodes.
    """
    if len(data) % 16:
        raise MessageError(f"{len(data)} bytes are not a refusal")
    found = np.frombuffer(data, np.int64).reshape(2, -1)
    agents, owners = found
    if ((agents < 0) | (agents >= num_agents)).any() or not set(owners.tolist()) <= nodes:
        raise MessageError("a refusal names unknown agents or nodes")
    return found
