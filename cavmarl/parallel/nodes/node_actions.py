"""`Actions`: what agents do in a step, which goes to the nodes that own their vehicles.

The caller knows which node sensed for an agent last. After nodes were lost, or zones moved, that
may be another one: a node that is told what an agent of another one does refuses it, with the
owner's number, and the caller sends it there. A node waits until it knows what all its agents do.
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
"""Some, counted over all worlds."""

ZoneRects = list[list[float]]
"""Zones as `node_cuts.zones_as_json` gives them."""

_pack = unchecked(pack_actions)


class Actions(NamedTuple):
    """Those of all agents of W worlds in one step."""

    controls: NDArray[np.float64]  # (W · A, 2)
    meta_actions: NDArray[np.int64]  # (W · A,)
    mask: NDArray[np.bool_]  # (W · A,) agents that act

    @classmethod
    def of(cls, arrays: StepArrays) -> Actions:
        arrays_of = (arrays.controls.reshape(-1, 2), arrays.meta_actions, arrays.mask)
        return cls(arrays_of[0].copy(), arrays_of[1].flatten(), arrays_of[2].flatten())

    def of_node(self, number: int, owner: NDArray[np.int32]) -> Bytes:
        """What a node is told: of its agents, and of those that may get a vehicle anywhere.

        Args:
            number: of the node.
            owner: (W · A,) the node of each agent, as far as is known.
        """
        words = np.empty(2 + 4 * len(owner), dtype=np.int64)
        return words[: _pack(*self, owner, number, words, words.view(np.float64))].data

    def some(self, agents: Agents) -> Bytes:
        """What the owner of some agents is told of them."""
        owner = np.full(len(self.mask), UNOWNED - 1, dtype=np.int32)
        owner[agents] = 0
        return self._replace(mask=np.ones_like(self.mask)).of_node(0, owner)


class NodeCommand(NamedTuple):
    """What all nodes are to do."""

    pieces: list[bytes]  # of its frame, the same for all
    changes: bool  # what the worlds are
    ticks: int  # of the worlds
    actions: Actions | None = None  # of a step
    cut: ZoneRects | None = None  # zones that the worlds have from then on
    receptions: list[bytes] | None = None  # what a network simulator has said so far, in a step

    def of_node(self, number: int, owner: NDArray[np.int32], lease: bytes) -> list[Bytes]:
        """The pieces of the frame that a node gets; arguments as of `Actions.of_node`.

        The actions begin at a whole word of 8 bytes, for kernels read them.
        """
        first, *rest = self.pieces
        told = [] if self.actions is None else [self.actions.of_node(number, owner)]
        return [first, *told, *rest, lease]


class ReceivedActions:
    """What agents do, as one node is told it step by step."""

    def __init__(self, arrays: StepArrays, number: int) -> None:  # `number`: of the node
        num = arrays.mask.size
        self._number = number
        self._arrays = arrays.controls.reshape(num, 2), arrays.meta_actions.reshape(num)
        self._missing = np.zeros(num, dtype=np.bool_)
        self._wrong = np.empty(num, dtype=np.int64)
        self._unpack = specialized(take_actions, checks=False)
        self.are_due = False  # some of the node's own agents have not been told of yet

    def begin(self, owner: NDArray[np.int32]) -> None:
        """A step begins; `owner`: (W · A,) the node of each agent."""
        np.equal(owner, self._number, out=self._missing)

    def read(self, data: memoryview, at: int, owner: NDArray[np.int32]) -> tuple[Agents, int]:
        """Write what agents do to the arrays; those that other nodes own, and where it ends.

        Raises:
            MessageError: the bytes tell of no actions.
        """
        words = np.frombuffer(data, np.int64, (len(data) - at) // 8, at)
        size, wrong, missing = self._unpack(
            words, words.view(np.float64), *self._arrays,
            self._missing, owner, self._number, self._wrong,
        )  # fmt: skip
        if size < 0:
            raise MessageError(f"{len(data)} bytes do not tell what agents do")
        self.are_due = missing > 0
        return self._wrong[:wrong], at + 8 * size


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
