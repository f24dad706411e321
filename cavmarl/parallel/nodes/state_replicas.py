"""`StateReplicas`: kept states of the zones of a node, and of the previous node of the ring.

From time to time, between two steps, each node keeps its state, and sends a replica to the next
live node. When a node is lost, the next node takes over its zones, and all nodes go back to the
newest state that all of them have. They repeat the commands since then, which gives the same bytes.
When zones move to another node, for example a new node, all nodes also go back to a kept state.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from numpy.typing import NDArray

from cavmarl.core.errors import MessageError, WorkerError
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.peer_faults import reading
from cavmarl.parallel.nodes.zone_moves import living_of
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.traffic.sumo.sumo_history import ToldLog

Array = NDArray[Any]
KEPT = 2  # number of kept states, since the newest one may not have arrived at all nodes


class StateReplicas:
    """The states that one node keeps.

    Attributes:
        own: states of this node, by their numbers.
        others: node → states that the node has sent, by their numbers.
    """

    def __init__(
        self, worlds: LocalWorlds, logs: Sequence[ToldLog], links: Links, number: int
    ) -> None:
        self._worlds = worlds
        self._logs = logs  # logs of commands to SUMO
        self._links = links
        self._number = number
        self.own: dict[int, Bytes] = {}
        self.others: dict[int, dict[int, Bytes]] = {}
        self._arrived: dict[int, NodeFrame] = {}  # newest replica of each sender, unread
        self._given: dict[int, NodeFrame] = {}  # state of each node that gives zones away
        self._is_settled = True  # whether no state was kept since `settle`

    def begin_anew(self, worlds: LocalWorlds, logs: Sequence[ToldLog]) -> None:
        """Switch to other worlds; replicas stay, since their senders may already have switched."""
        self._worlds, self._logs = worlds, logs
        self.own.clear()
        self._given.clear()

    def settle(self) -> None:
        """Drop older states, since the newest state has arrived at all nodes."""
        if self._is_settled:
            return
        self._is_settled = True
        newest = max(self.own, default=0)
        for states in (self.own, *self.others.values()):
            for old in [number for number in states if number < newest]:
                del states[old]

    def keep(self, state: int, living: Sequence[int]) -> list[Array]:
        """Keep and return the current state, and send a replica to the next live node."""
        saved = self._worlds.save()
        data = to_bytes(saved)
        _add(self.own, state, data)
        self._is_settled = False
        if len(living) > 1:
            to = living[(living.index(self._number) + 1) % len(living)]
            self._links.send(to, FrameKind.KEEP, state, [data])
        else:
            logs = to_bytes([log.words for log in self._logs])
            self._links.send(COORDINATOR, FrameKind.KEEP, state, [logs, data])
        return saved

    def resume_from(self, state: int, data: Bytes) -> None:
        """Resume from a state that the coordinator has kept for the only node, which is lost.

        Raises:
            ConfigError: the state belongs to other worlds.
        """
        _drop_later(self.own, -1)
        like = [*(log.words for log in self._logs), *self._worlds.save()]
        found = from_bytes(data, like)
        saved = found[len(self._logs) :]
        self._worlds.check(saved)
        for log, words in zip(self._logs, found, strict=False):
            log.take_up(words)
        self.own[state] = to_bytes(saved)

    def receive(self, number: int, frame: NodeFrame) -> None:
        """Store the replica of another node unread; `await_replica` reads it."""
        self._arrived[number] = frame

    def await_replica(
        self, state: int, zones: Sequence[Sequence[int]], like: Sequence[Array]
    ) -> None:
        """Wait for the state of the previous live node, check it, and keep it.

        The check detects a damaged state while its sender is still alive.

        Args:
            state: number of the state.
            zones: zones of each node.
            like: state of this node with the same number.

        Raises:
            LinkLostError: the previous node has not sent the state, or its state is damaged.
            RecoveryOrderedError: the coordinator has ordered a recovery.
        """
        living, arrived = living_of(zones), self._arrived
        previous = living[living.index(self._number) - 1]
        if previous == self._number:
            return

        def has_come() -> bool:
            return previous in arrived and arrived[previous].number == state

        self._links.await_urgent(previous, has_come)
        data = arrived.pop(previous).data
        with reading(previous):
            self._check_zones(self._read(data, like), zones[previous])
        _add(self.others.setdefault(previous, {}), state, data)
        self._is_settled = False

    def _check_zones(self, saved: Sequence[Array], zones: Sequence[int]) -> None:
        """Raise MessageError if a state has vehicles of zones other than `zones`."""
        count = self._worlds.world.partition.count
        first = len(saved) - self._worlds.simulation.num_worlds * count
        found = {n % count for n, rows in enumerate(saved[first:]) if len(rows)}
        if not found <= {*zones}:
            raise MessageError(f"its state has vehicles of zones {sorted(found - {*zones})}")

    def receive_given(self, number: int, frame: NodeFrame) -> None:
        """Store the state of another node, from which this node takes over zones."""
        self._given[number] = frame

    def load(
        self,
        state: int,
        lost: Sequence[int],  # nodes whose zones this node takes over
        donors: Sequence[int],  # nodes that give zones to this node
        takers: Sequence[int],  # nodes that receive zones of this node
        zones: Sequence[int],  # new zones of this node
        generation: int,  # number of changes of nodes
    ) -> None:
        """Resume from a kept state.

        Later states are dropped; otherwise they would count as the newest states.

        Raises:
            LinkLostError: a donor has disconnected, or its state is damaged.
            RecoveryOrderedError: the coordinator has ordered another recovery.
            WorkerError: this node has no replica of the state of a lost node.
        """
        for states in (self.own, *self.others.values()):
            _drop_later(states, state)
        like = self._worlds.save()
        own = self.own.get(state)
        saved = None if own is None else self._read(own, like)
        for number in lost:
            found = self.others.get(number, {}).get(state)
            if saved is None or found is None:
                raise WorkerError(f"there is no replica of the state of node {number}")
            saved[self._first - 1] += self._join(saved, self._read(found, like), like)
        if takers and saved is not None:
            data = to_bytes(saved)
            for taker in takers:
                self._links.send(taker, FrameKind.GIVE, generation, [data])
        for donor in donors:
            self._links.await_urgent(donor, partial(self._has_given, donor, generation))
            with reading(donor):
                given = self._read(self._given.pop(donor).data, like)
                if saved is not None:
                    self._join(saved, given, like)
            if saved is None:
                saved = given
                saved[self._first - 1][...] = 0  # contacts stay with the node that counted them
        if saved is None:
            raise WorkerError(f"there is no replica of state {state}")
        count = self._worlds.world.partition.count
        for n in range(self._first, len(saved)):
            if (n - self._first) % count not in zones:
                saved[n] = saved[n][:0]
        self._worlds.load_own(saved, zones[0])

    def _has_given(self, donor: int, generation: int) -> bool:
        return donor in self._given and self._given[donor].number == generation

    def _read(self, data: Bytes, like: Sequence[Array]) -> list[Array]:
        """Read a kept state. Raises ConfigError: the worlds cannot resume from the state."""
        saved = from_bytes(data, like)
        self._worlds.check(saved, is_whole=False)
        return saved

    @property
    def _first(self) -> int:
        """Index of the vehicles of the first zone among the saved arrays."""
        simulation, zones = self._worlds.simulation, self._worlds.world.partition.count
        return len(self._worlds.save()) - simulation.num_worlds * zones

    def _join(self, saved: list[Array], other: Sequence[Array], like: Sequence[Array]) -> Array:
        """Add the vehicles of another node, and the state of its agents, to a saved state.

        Returns:
            (W,) contacts that the other node has counted.

        Raises:
            MessageError: both states have vehicles of a zone.
        """
        simulation, zones = self._worlds.simulation, self._worlds.world.partition.count
        first = self._first
        kept = {id(array) for array in simulation.agent_arrays()}
        agent_arrays = [n for n, array in enumerate(like) if id(array) in kept]
        for n in range(first, len(saved)):
            if not len(other[n]):
                continue
            if len(saved[n]):
                raise MessageError(f"its state also has vehicles of zone {(n - first) % zones}")
            saved[n] = other[n]
            w = (n - first) // zones
            agents = other[n]["agent"][other[n]["agent"] >= 0]
            for k in agent_arrays:
                saved[k][w, agents] = other[k][w, agents]
        return other[first - 1]


def _add(states: dict[int, Bytes], state: int, data: Bytes) -> None:
    states[state] = data
    for old in sorted(states)[:-KEPT]:
        del states[old]


def _drop_later(states: dict[int, Bytes], state: int) -> None:
    for later in [number for number in states if number > state]:
        del states[later]
