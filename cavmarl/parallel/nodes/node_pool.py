"""`NodePool`: the processes of nodes, what they are told, and what is done when some are lost."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError, WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.core.processes import is_fork, refuse_fork
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import WorldRun
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.reactions import Hosting
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.joining_nodes import JoiningNode
from cavmarl.parallel.nodes.leases import lease_ticks, leases_of
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame, read_list
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_actions import NodeCommand, ZoneRects, read_refusal
from cavmarl.parallel.nodes.node_coordinator import NodeCoordinator
from cavmarl.parallel.nodes.node_cuts import PoolState, ZoneCut, read_neighbours, zones_as_json
from cavmarl.parallel.nodes.node_starters import Route, straight
from cavmarl.parallel.nodes.node_supply import NodeSupply
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.node_watch import NodeWatch, SilentNodeError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, read_json, reading
from cavmarl.parallel.nodes.state_replicas import KEPT
from cavmarl.parallel.nodes.zone_endpoints import hostings_as_json, read_report
from cavmarl.parallel.nodes.zone_moves import (
    ZoneMoves,
    Zones,
    living_of,
    moves_of,
    name_of,
    nodes_of,
)
from cavmarl.parallel.worlds.world_errors import original_error
from cavmarl.zones.kernels.agent_frames import UNOWNED

log = logging.getLogger("cavmarl.nodes")

KEEP_S = 0.2  # so much of work may have to be done again
END_S = 1.0  # for nodes to hear that they are needed no more

Found = TypeVar("Found")

Read: TypeAlias = Callable[[int, memoryview], Found]
"""Reads what the node of a number has found."""


class NodePool:
    """The nodes of W worlds, the same zones of each at each node, and what they are to do.

    Attributes:
        zones: that each node hosts.
        pids: of the nodes' processes, each on its machine.
        reporter: number of the node that tells what all know alike.
        owner: (W · A,) the node that owns each agent, as far as is known.
        partition: the zones' rectangles, as `node_cuts.zones_as_json` gives them.
        coordinator: of the ownership of vehicles.
        joining_nodes: nodes that have joined and host nothing yet.
        generation: how often nodes have come and gone.
        losses: how many nodes were lost.
        recoveries: how often the worlds have gone back because of that.
        replacements: how many nodes host zones in the place of others.
        redirected: how many actions a node has refused that was not the owner of the agent.

    Raises:
        ConfigError: a setting that such worlds cannot have, or more nodes than zones.
        WorkerError: a node cannot be started.
    """

    owner: NDArray[np.int32]
    _performed: NodeCommand | None = None  # what they do now
    _exchanged = 0  # answers of a network simulator that nodes have got in the present command

    def __init__(
        self,
        world: World,  # what each is made of
        runs: Sequence[WorldRun],  # (W,) of the worlds
        zones: Zones,  # that each node hosts to begin with
        supply: NodeSupply,  # where the nodes come from
        *,
        answer: Callable[[memoryview], bytes],  # what a network simulator says to an EXCHANGE
        system: NodeSystem = MACHINE,  # that the nodes are on
        route: Route = straight,  # where to call in order to reach a place
    ) -> None:
        self._is_native = world.config.traffic.source == "native"
        self._supply, self._route, self._answer = supply, route, answer
        self.joining_nodes = supply.joining_nodes
        config = world.config
        self.zones = self._homes = zones
        self.generation = 0
        self._next_state = 1
        self._lost: list[int] = []
        self._is_torn = False
        self._successions = 0  # in the present command
        self._max_retries = config.workers.max_retries
        self.losses = self.recoveries = self.replacements = self.redirected = 0
        self._timeout_s, self._pid = config.workers.timeout_s, os.getpid()
        self._num_ids, self._num_zones = config.population.num_ids, world.partition.count
        self._partition = zones_as_json(world.partition)
        self._ticks_per_step = config.clock.ticks_per_step
        self._links = Links(_nothing, system)
        self._watch = NodeWatch(self._links, self._stopped)
        self._nodes: dict[int, JoiningNode] = {}  # what is known of each that lives
        self._new: dict[int, tuple[str, int]] = {}  # where the others can call those of them
        self._lease_ticks, self._settings = lease_ticks(config), config.zones
        self._links.urgent = self._receive
        self._prepare(runs)
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def _prepare(self, runs: Sequence[WorldRun]) -> None:
        """Have worlds that have not begun."""
        self.zones = self._homes
        self._living = living_of(self.zones)
        self.reporter = 0
        self._cut = ZoneCut(self._partition, Neighbours(()))
        # What all nodes can go back to, and what they keep before the next command.
        self._state = PoolState(self._next_state, self.zones, 0, self._cut)
        self._opened: PoolState | None = None
        self._next_state += 1
        self._kept: dict[int, Bytes] = {}  # states of the only node that there was, by numbers
        self._keep_again_s = -math.inf  # by the clock of `_links`
        self._log: list[NodeCommand] = []  # since the state
        self.owner = np.full(len(runs) * self._num_ids, UNOWNED, dtype=np.int32)
        self.coordinator = NodeCoordinator(
            [run.run for run in runs],
            nodes_of(self.zones),
            limits_of(self._settings),
            self._links,
            [None if run.journal is None else Journal(run.journal, anew=True) for run in runs],
            self._settings.check_invariants,
        )
        self._runs = [run.run.hex() for run in runs]

    def begin_anew(self, runs: Sequence[WorldRun]) -> None:
        """Let the nodes have other worlds, or another number of them, which have not begun.

        Raises:
            WorkerError: too many nodes were lost.
        """
        self.coordinator.close()
        self.generation += 1
        self._prepare(runs)
        self._begin()

    def _begin(self) -> None:
        """Wait until all nodes have joined, and give them their zones, again if one is lost."""
        hostings: list[list[Hosting]] = []
        while True:
            try:
                if missing := self.num_nodes - len(self._nodes):
                    self._seat(missing)
                neighbours = self._nodes[0].neighbours
                assert neighbours is not None
                self._cut = self._cut._replace(neighbours=neighbours)
                self._state = self._state._replace(cut=self._cut)
                hostings = hostings or self.coordinator.host(neighbours)
                self._send_zones(hostings, ZoneMoves(self.zones, {}, []), begins=True)
                self._commit()
            except LinkLostError as lost:
                self._lose(lost, has_begun=False)
                self.generation += 1  # what nodes say of this attempt counts no more
            else:
                self._new.clear()
                self._is_torn = False
                return

    def _pump(self) -> None:
        """Hear the nodes that are there. Raises LinkLostError: one of them is lost."""
        self._links.pump(0.0)

    def _stopped(self) -> set[int]:
        stopped = self._supply.stopped()
        return {number for number, node in self._nodes.items() if node.asked in stopped}

    @property
    def pids(self) -> list[int]:
        return [self._nodes[number].pid for number in sorted(self._nodes)]

    @property
    def first(self) -> int:
        """The number of the node that answers what only one of them has to."""
        return self._living[0]

    @property
    def num_nodes(self) -> int:
        """How many nodes host zones if none is lost."""
        return len(self._homes)

    @property
    def machines(self) -> list[tuple[str, int]]:
        """The machine and the process of each living node."""
        return [(node.machine, node.pid) for node in self._nodes.values()]

    @property
    def partition(self) -> ZoneRects:
        return self._cut.partition

    def _seat(self, num: int, waits: bool = True) -> None:
        """Let nodes that are ready host the zones that lost nodes had at the beginning."""
        empty = [n for n in range(len(self._homes)) if n not in self._nodes]
        for joining_node, connection in self._supply.take(num, self._pump, waits):
            number = joining_node.asked if joining_node.asked in empty else empty[0]
            empty.remove(number)
            assert joining_node.place is not None
            self._links.add(number, connection)
            self._nodes[number], self._new[number] = joining_node, self._route(joining_node.place)
            if number in self._lost:
                self._lost.remove(number)

    def _receive_all(self, kind: FrameKind) -> dict[int, NodeFrame]:
        """The next frame of all living nodes, by rising numbers.

        Raises:
            LinkLostError: a node is lost.
        """
        found: dict[int, NodeFrame] = {}
        while missing := [n for n in self._living if n not in found] if found else self._living:
            wait = partial(self._links.receive, missing)
            for number, frame in self._watch.wait(self._living, self._timeout_s, wait).items():
                if frame.number == self.generation:
                    found[number] = frame
        for number, frame in found.items():
            if frame.kind is not kind:
                raise LinkLostError(number, MessageError(f"{frame.kind.name}, not {kind.name}"))
        return dict(sorted(found.items()))

    # Commands, and what becomes of them when nodes are lost

    def run(self, command: NodeCommand, read: Read[Found]) -> list[Found]:
        """Let all nodes do a command.

        Args:
            command: what they are to do.
            read: reads what a node has found, of a number; what fails in it is that node's fault.

        Returns:
            what was read, first of all of the node that tells what all know alike.

        Raises:
            WorkerDeathError: no node has kept the zones of lost ones, or too many were lost.
        """
        refuse_fork(self._pid, "the nodes")
        self._successions = 0
        if command.changes and self._links.now_s() > self._keep_again_s:
            if not self._replace_lost():
                self._begin_state()
        if command.changes:
            self._log.append(command)
        try:
            results = self._insist(command, read)
        except BaseException:  # it is as if the command had never been given
            self._is_torn, self._opened = True, None
            if command.changes:
                self._log.pop()
            raise
        if command.changes and self._opened is not None:
            self._state, self._opened = self._opened, None
            self._log = self._log[-1:]
            self._keep_again_s = self._links.now_s() + KEEP_S
        return results

    def undo(self) -> None:
        """Let the last command, which has changed the worlds, never have been given."""
        self._is_torn, self._opened = True, None
        self._log.pop()

    def move(self, zones: Zones) -> None:
        """Let the zones have other homes from now on; errors as of `run`."""
        before, self._homes = self._homes, zones
        self._is_torn, self._opened = True, None
        try:
            self._insist(None, unread)
        except BaseException:
            self._homes = before
            raise

    def _insist(self, command: NodeCommand | None, read: Read[Found]) -> list[Found]:
        """Do a command, or none, again and again, until no node is lost meanwhile."""
        while True:
            try:
                if self._is_torn:
                    self._recover()
                    changes = command is not None and command.changes
                    for one in self._log[: -1 if changes else None]:
                        self._perform(one)
                return [] if command is None else self._read(self._perform(command), read)
            except LinkLostError as lost:
                self._lose(lost)

    def _read(self, results: Mapping[int, memoryview], read: Read[Found]) -> list[Found]:
        """Read what nodes have found. Raises LinkLostError: one has found what cannot be."""
        found = []
        for number, data in results.items():
            with reading(number):
                found.append(read(number, data))
        return found

    def _replace_lost(self) -> bool:  # whether the worlds go back for that
        """Let nodes that have joined meanwhile host what lost ones had.

        They get it from those that have it now, out of the newest state. With SUMO none can: what
        SUMO was told up to now is in no state.
        """
        if not self._is_native:
            return False
        is_ready = self._supply.look()
        is_fresh = self._state.zones == self.zones and not self._is_torn
        before = len(self._nodes)
        if not (is_ready and is_fresh and before < len(self._homes)):
            return False
        self._seat(len(self._homes) - before, waits=False)
        self.replacements += len(self._nodes) - before
        self._is_torn, self._opened = True, None
        return True

    def _begin_state(self) -> None:
        """Let all nodes keep what they have before the next command."""
        switched = self.coordinator.switched
        self._opened = PoolState(self._next_state, self.zones, switched, self._cut)
        self._next_state += 1

    def _perform(self, command: NodeCommand) -> dict[int, memoryview]:
        """Do a command once; what each node has found. Raises LinkLostError: one is lost."""
        kept = self._opened.number if self._opened and self._log and command is self._log[-1] else 0
        self._performed, self._exchanged = command, 0
        leases = leases_of(command.ticks, self._lease_ticks)
        lease = self._begin_lease() if leases else {}
        for number in self._living:
            pieces = command.of_node(number, self.owner, lease.get(number, b""))
            self._links.send(number, FrameKind.COMMAND, kept, pieces)
        if not command.changes:
            return {n: frame.data for n, frame in self._receive_all(FrameKind.RESULT).items()}
        results = self._commit()
        for _ in range(1, leases):
            self.coordinator.lease(self._begin_lease(), self._ticks_per_step)
            results = self._commit()
        if command.cut is not None:
            with reading(self.reporter):
                near = read_neighbours(read_json(results[self.reporter], list), self._num_zones)
            self._cut = ZoneCut(command.cut, near)
            self.coordinator.know(near)
        return results

    def _begin_lease(self) -> dict[int, bytes]:
        """What nodes are to be told before the next ticks."""
        decide = partial(self._watch.wait, self._living, self._timeout_s, self.coordinator.begin)
        lease = decide()
        while self.coordinator.is_late:
            self.coordinator.lease(lease, 0)
            self._commit()
            lease = decide()
        return lease

    def _receive(self, number: int, frame: NodeFrame) -> Exception | None:
        """Take an urgent frame.

        Returns:
            an error of a node, for the caller.
        """
        is_present = frame.number == self.generation
        match frame.kind:
            case FrameKind.MISSED:
                peer = int.from_bytes(frame.data, "little")
                if is_present and peer in self._nodes:
                    self._watch.report_missed(number, peer)
            case FrameKind.FAILED:
                name, text, trace = map(str, read_list(frame))
                part = name_of(self._homes[number])
                failure = WorkerFailureError(number, part, name, text, trace)
                found = original_error(failure)
                found.__cause__ = None if found is failure else failure
                return found
            case FrameKind.PONG:
                self._watch.receive_pong(number, frame)
            case FrameKind.KEEP:
                self._kept[frame.number] = frame.data
                for old in sorted(self._kept)[:-KEPT]:
                    del self._kept[old]
            case FrameKind.EXCHANGE:
                if is_present:
                    self._exchange(frame)
            case FrameKind.NOT_MINE:
                if is_present:
                    self._forward(frame)
            case FrameKind.MESSAGES:
                self.coordinator.receive(number, frame)
            case _:
                raise MessageError(f"a node sends no frame of kind {frame.kind.name}")
        return None

    def _exchange(self, frame: NodeFrame) -> None:
        """Tell all nodes what stations receive; of a step that is done again, what they did.

        Raises:
            MessageError: no step is taken.
        """
        known = None if self._performed is None else self._performed.receptions
        if known is None:
            raise MessageError("messages are sent where no step is taken")
        if self._exchanged == len(known):
            known.append(self._answer(frame.data))
        for node in self._living:
            answer = known[self._exchanged]
            self._links.send(node, FrameKind.RECEPTIONS, self.generation, [answer])
        self._exchanged += 1

    def _forward(self, frame: NodeFrame) -> None:
        """Send actions that a node refuses to the owners that it names.

        Raises:
            MessageError: there are no such agents, or owners.
        """
        found = read_refusal(frame.data, self.owner.size, set(self._living))
        if self._performed is None or (actions := self._performed.actions) is None:
            raise MessageError("actions are refused where there are none")
        for owner in np.unique(found[1]).tolist():
            agents = found[0, found[1] == owner]
            self.owner[agents] = owner
            self.redirected += len(agents)
            self._links.send(owner, FrameKind.ACTIONS, self.generation, [actions.some(agents)])

    def _lose(self, lost: LinkLostError, has_begun: bool = True) -> None:
        """A node is gone: nothing of it counts any more.

        Raises:
            WorkerError: it had not begun, and too many were lost like that.
        """
        is_silent = isinstance(lost, SilentNodeError)
        lost = lost if is_silent else self._watch.most_missed(lost)
        number = lost.peer
        self._is_torn = True
        self._watch.forget_missed()
        self._links.drop(number)
        node = self._nodes.pop(number, None)
        self._new.pop(number, None)
        if node is None:
            return
        self._lost.append(number)
        self.losses += 1
        zones = name_of(self._homes[number])
        log.warning("node %d on %s (%s) is lost: %s", number, node.machine, zones, lost)
        if has_begun:
            self._supply.replace(node, is_silent)
        elif why := self._supply.retry(node, is_silent):
            raise WorkerError(why) from lost

    def _recover(self) -> None:
        """Let the living nodes host the zones of the lost ones, as of the newest state they have.

        Zones whose home is another node that lives go there.

        Raises:
            LinkLostError: another one is lost.
            WorkerDeathError: what a lost one had is kept nowhere.
        """
        state = self._state
        self._opened = None
        moves, kept = self._moves()
        self.zones, self._living = moves.zones, living_of(moves.zones)
        self.owner[~np.isin(self.owner, self._living)] = UNOWNED  # of lost ones any may be
        self.generation += 1
        self._cut = state.cut
        self.coordinator.know(state.cut.neighbours)
        hostings = self.coordinator.recover(nodes_of(self.zones), state.switched)
        self._send_zones(hostings, moves, begins=False, kept=kept)
        self._commit()
        self._new.clear()
        self._is_torn = False
        self._keep_again_s = -math.inf
        self.recoveries += bool(moves.heirs or kept)

    def _moves(self) -> tuple[ZoneMoves, Bytes]:
        """Return which node hosts which zones from now on, and the state if it is kept here.

        If the only node is lost, another one takes its place.

        Raises:
            WorkerDeathError: what a lost node had is kept nowhere, or too many were lost.
        """
        state = self._state
        hosts, kept = living_of(state.zones), self._kept.get(state.number)
        if kept is None or len(hosts) > 1 or hosts[0] in self._nodes:
            moves = moves_of(state.zones, self._homes, self._lost, self._nodes, state.number)
            return moves, b""
        self._successions += 1
        if self._successions > self._max_retries:
            causes = [f"node {hosts[0]} was lost"] * self._successions
            name = name_of(state.zones[hosts[0]])
            raise WorkerDeathError(hosts[0], name, state.number, "step", causes)
        if not self._nodes:
            self._seat(1)
        successor = min(self._nodes)
        zones: Zones = [[] for _ in self._homes]
        zones[successor] = state.zones[hosts[0]]
        return ZoneMoves(zones, {}, []), kept

    def _send_zones(
        self,
        hostings: Sequence[Sequence[Hosting]],
        moves: ZoneMoves,
        begins: bool,
        kept: Bytes = b"",  # the state, if only this process has it
    ) -> None:
        """Let the nodes host their zones from now on."""
        told = {
            "num_worlds": len(self._runs),
            "begins": begins,
            "lost": self._lost,
            "heirs": list(moves.heirs.items()),
            "donors": moves.donors,
            "places": list(self._new.items()),
            "zones": moves.zones,
            "partition": self._cut.partition,
            "first": self._choose_reporter(),
            "state": self._state.number,
            "runs": self._runs,
            "hostings": hostings_as_json(hostings),
        }
        for number in self._living:
            data = json.dumps({**told, "number": number}).encode()
            size = len(data).to_bytes(8, "little")
            self._links.send(number, FrameKind.RECOVER, self.generation, [size, data, kept])

    def _choose_reporter(self) -> int:
        """The node that tells what all know alike: one that has been there in the last step."""
        old = [number for number in self._living if number not in self._new]
        self.reporter = self.reporter if self.reporter in old else (old or self._living)[0]
        return self.reporter

    def _commit(self) -> dict[int, memoryview]:
        """Wait for the nodes to be through with a tick.

        Returns:
            what else they have sent with it, first of all the one that tells what all know alike.

        Raises:
            LinkLostError: one is lost, or has sent what cannot be.
        """
        told, results = {}, {}
        frames = self._receive_all(FrameKind.REPORT)
        for number in sorted(frames, key=self.reporter.__ne__):  # else by rising numbers
            with reading(number):
                messages, said, more = read_report(frames[number].data, len(self._runs))
                self.coordinator.check(number, messages, said)
            told[number] = messages, said
            results[number] = more
        self.coordinator.commit(told)
        return results

    def close(self) -> None:
        """End the nodes; a fork of the pool's process has no right to."""
        if is_fork(self._pid):
            return
        self._links.end(END_S)
        self.coordinator.close()


def unread(number: int, data: memoryview) -> None:
    """What a node has found is of no use."""


def _nothing(number: int, frame: NodeFrame) -> Exception | None:
    """Before a tick there are no messages."""
    return None
