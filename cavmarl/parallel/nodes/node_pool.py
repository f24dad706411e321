"""`NodePool`: commands for the nodes of worlds, and recovery when nodes are lost."""

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
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices, read_json, reading
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

KEEP_S = 0.2  # time between kept states; a recovery repeats about this much work
END_S = 1.0  # time for nodes to end

Found = TypeVar("Found")

Read: TypeAlias = Callable[[int, memoryview], Found]
"""Reads the result of a node, whose number is the first argument."""


class NodePool:
    """The nodes of W worlds. A node hosts the same zones in each world.

    Attributes:
        zones: zones of each node.
        pids: process id of each node, on its machine.
        reporter: number of the node that reports the results that all nodes share.
        owner: (W · A,) node that owns each agent, as far as it is known.
        partition: rectangles of the zones, see `node_cuts.zones_as_json`.
        coordinator: decides about the ownership of vehicles.
        joining_nodes: nodes that have joined and host no zones yet.
        generation: number of changes of nodes.
        losses: number of lost nodes.
        recoveries: number of returns to a kept state because of lost nodes.
        replacements: number of nodes that have replaced lost nodes.
        redirected: number of actions that were refused by a node and forwarded to the owner.

    Raises:
        ConfigError: a setting is not supported, or there are more nodes than zones.
        WorkerError: a node cannot be started.
    """

    owner: NDArray[np.int32]
    _performed: NodeCommand | None = None  # the current command
    _exchanged = 0  # number of answers of a network simulator sent for this command

    def __init__(
        self,
        world: World,
        runs: Sequence[WorldRun],  # (W,)
        zones: Zones,  # initial zones of each node, its home zones
        supply: NodeSupply,
        *,
        answer: Callable[[memoryview], bytes],  # answers an EXCHANGE by a network simulator
        system: NodeSystem = MACHINE,
        route: Route = straight,  # maps a place to the place that other nodes call
    ) -> None:
        self._is_native = world.config.traffic.source == "native"
        self._supply, self._route, self._answer = supply, route, answer
        self.joining_nodes = supply.joining_nodes
        config = world.config
        self.zones = self._homes = zones
        self.generation = 0
        self._next_state = 1
        self._lost: list[int] = []  # lost nodes that no other node has replaced yet
        self._failed: set[int] = set()  # nodes that have ended with an error of their own
        self._is_torn = False  # whether nodes have to go back to the newest state first
        self._successions = 0  # losses of the only node in the current command
        self._max_retries = config.workers.max_retries
        self.losses = self.recoveries = self.replacements = self.redirected = 0
        self._timeout_s, self._pid = config.workers.timeout_s, os.getpid()
        self._num_ids, self._num_zones = config.population.num_ids, world.partition.count
        self._partition = zones_as_json(world.partition)
        self._ticks_per_step = config.clock.ticks_per_step
        self._links = Links(_nothing, system)
        self._refused: dict[int, int] = {}  # agent → node that has refused its action
        self._watch = NodeWatch(self._links, self._stopped, self._holder)
        self._nodes: dict[int, JoiningNode] = {}  # live nodes
        self._present: set[int] = set()  # nodes that have sent a frame in this generation
        self._new: dict[int, tuple[str, int]] = {}  # new nodes → where other nodes can call
        self._lease_ticks, self._settings = lease_ticks(config), config.zones
        self._links.urgent = self._receive
        self._prepare(runs)
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def _prepare(self, runs: Sequence[WorldRun]) -> None:
        """Prepare for worlds before their first reset."""
        self.zones = self._homes
        self._living = living_of(self.zones)
        self.reporter = 0
        self._cut = ZoneCut(self._partition, Neighbours(()))
        # The state to which all nodes can go back, and the state that they keep next.
        self._state = PoolState(self._next_state, self.zones, 0, self._cut)
        self._opened: PoolState | None = None
        self._next_state += 1
        self._kept: dict[int, Bytes] = {}  # replicas of the states of a single node, by numbers
        self._keep_again_s = -math.inf  # time of the next kept state, by the clock of `_links`
        self._log: list[NodeCommand] = []  # commands since the newest kept state
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
        """Replace the worlds by other worlds before their first reset; their number may change.

        Raises:
            WorkerError: too many nodes were lost.
        """
        self.coordinator.close()
        self._begin_generation()
        self._prepare(runs)
        self._begin()

    def _begin(self) -> None:
        """Wait until all nodes have joined, and assign zones; start over if a node is lost."""
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
                self.send_zones(hostings, ZoneMoves(self.zones, {}, []), begins=True)
                self.commit()
                self._check_kept(self._state.number)
            except LinkLostError as lost:
                self._lose(lost, has_begun=False)
                self._begin_generation()  # frames of this attempt are void
            else:
                self._new.clear()
                self._is_torn = False
                return

    def _begin_generation(self) -> None:
        """Count a change of nodes. Earlier frames of nodes are void from now on."""
        self.generation += 1
        self._present.clear()

    def _pump(self) -> None:
        """Serve the connected nodes. Raises LinkLostError: a node is lost."""
        self._links.pump(0.0)

    def _stopped(self) -> set[int]:
        stopped = self._supply.stopped()
        return {number for number, node in self._nodes.items() if node.asked in stopped}

    @property
    def pids(self) -> list[int]:
        return [self._nodes[number].pid for number in sorted(self._nodes)]

    @property
    def first(self) -> int:
        """Number of the node that carries out the tasks for a single node."""
        return self._living[0]

    @property
    def num_nodes(self) -> int:
        """Number of nodes if none is lost."""
        return len(self._homes)

    @property
    def machines(self) -> dict[int, tuple[str, int]]:
        """Machine and process of each live node, by its number."""
        return {number: (node.machine, node.pid) for number, node in self._nodes.items()}

    @property
    def partition(self) -> ZoneRects:
        return self._cut.partition

    def _seat(self, num: int, waits: bool = True) -> None:
        """Give ready nodes the numbers, and thus the home zones, of missing nodes."""
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
        """Receive a frame of the given kind from each live node, in ascending order of nodes.

        Raises:
            LinkLostError: a node is lost, or has sent another kind.
        """
        found: dict[int, NodeFrame] = {}
        while missing := [n for n in self._living if n not in found] if found else self._living:
            wait = partial(self._links.receive, missing)
            for number, frame in self._wait(wait).items():
                with reading(number):
                    if frame.is_of(self.generation, number in self._present):
                        if frame.kind is not kind:
                            raise MessageError(f"{frame.kind.name}, not {kind.name}")
                        found[number] = frame
        self._present.update(found)
        return dict(sorted(found.items()))

    def _wait(self, wait: Callable[[float], Found]) -> Found:
        """Wait until `wait` succeeds. Raises the errors of `NodeWatch.wait`."""
        return self._watch.wait(self._living, self._timeout_s, wait)

    def _holder(self, agent: int) -> int:
        """Return the node that has received the action of an agent, or has refused it."""
        return self._refused.get(agent, self.owner.item(agent))

    # Commands, and their repetition when nodes are lost

    def run(self, command: NodeCommand, read: Read[Found]) -> list[Found]:
        """Let all nodes carry out a command.

        Args:
            command: for all nodes.
            read: reads the result of a node; the node is at fault if `read` fails.

        Returns:
            what `read` returns for each node, the reporter first.

        Raises:
            WorkerDeathError: no node has a replica of a lost node, or too many were lost.
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
        except BaseException:  # the worlds return to the state before the command
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
        """Undo the last command, which has changed the worlds."""
        self._is_torn, self._opened = True, None
        self._log.pop()

    def move(self, zones: Zones) -> None:
        """Move zones to other nodes. Raises the errors of `run`."""
        before, self._homes = self._homes, zones
        self._is_torn, self._opened = True, None
        try:
            self._insist(None, unread)
        except BaseException:
            self._homes = before
            raise

    def _insist(self, command: NodeCommand | None, read: Read[Found]) -> list[Found]:
        """Carry out a command, if any; after each loss of a node, recover and try again."""
        while self._failed:
            number = self._failed.pop()
            self._lose(LinkLostError(number, MessageError("it has ended with an error")))
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
        """Read the results of nodes. Raises LinkLostError: a result is bad."""
        found = []
        for number, data in results.items():
            with reading(number):
                found.append(read(number, data))
        return found

    def _replace_lost(self) -> bool:  # whether the worlds go back to the newest state
        """Let nodes that have joined in the meantime replace lost nodes.

        The new nodes receive the zones of the newest state from the nodes that now host the zones.
        With SUMO this is impossible, since no kept state has all commands to SUMO so far.
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
        """Let all nodes keep their state before the next command."""
        switched = self.coordinator.switched
        self._opened = PoolState(self._next_state, self.zones, switched, self._cut)
        self._next_state += 1

    def _perform(self, command: NodeCommand) -> dict[int, memoryview]:
        """Carry out a command once; return the results. Raises LinkLostError: a node is lost."""
        kept = self._opened.number if self._opened and self._log and command is self._log[-1] else 0
        self._performed, self._exchanged = command, 0
        self._refused.clear()
        leases = leases_of(command.ticks, self._lease_ticks)
        lease = self._begin_lease() if leases else {}
        for number in self._living:
            pieces = command.of_node(number, self.owner, lease.get(number, b""))
            self._links.send(number, FrameKind.COMMAND, kept, pieces)
        if not command.changes:
            return {n: frame.data for n, frame in self._receive_all(FrameKind.RESULT).items()}
        results = self.commit()
        if kept:
            self._check_kept(kept)
        for _ in range(1, leases):
            self.coordinator.lease(self._begin_lease(), self._ticks_per_step)
            results = self.commit()
        if command.cut is not None:
            with reading(self.reporter):
                near = read_neighbours(read_json(results[self.reporter], list), self._num_zones)
            self._cut = ZoneCut(command.cut, near)
            self.coordinator.set_neighbours(near)
        return results

    def _begin_lease(self) -> dict[int, bytes]:
        """Return the lease of each node for the next ticks."""
        decide = partial(self._wait, self.coordinator.begin)
        lease = decide()
        while self.coordinator.is_late:
            self.coordinator.lease(lease, 0)
            self.commit()
            lease = decide()
        return lease

    def _receive(self, number: int, frame: NodeFrame) -> Exception | None:
        """Apply an urgent frame.

        Returns:
            an error that a node reports, to be raised in the caller.
        """
        match frame.kind:
            case FrameKind.PONG:
                self._watch.receive_pong(number, frame)
                return None
            case FrameKind.KEEP if self._living == [number]:
                self._keep(frame)
                return None
        is_present = frame.is_of(self.generation, number in self._present)
        match frame.kind:
            case FrameKind.FAILED:
                name, text, trace = map(str, read_list(frame))
                part = name_of(self._homes[number])
                failure = WorkerFailureError(number, part, name, text, trace)
                found = original_error(failure)
                found.__cause__ = None if found is failure else failure
                self._failed.add(number)
                return found
            case FrameKind.MISSED:
                peer, fault = int.from_bytes(frame.data[:4], "little"), bytes(frame.data[4:])
                check_indices("node", [peer], self.num_nodes)
                if is_present and peer in self._nodes:
                    self._watch.report_missed(number, peer, fault.decode())
            case FrameKind.EXCHANGE if number == self.reporter:
                if is_present:
                    self._exchange(frame)
            case FrameKind.NOT_MINE:
                if is_present:
                    self._forward(number, frame)
            case FrameKind.MESSAGES:
                if is_present:
                    self.coordinator.receive(number, frame)
            case _:
                raise MessageError(f"a node must not send frames of kind {frame.kind.name}")
        return None

    def _keep(self, frame: NodeFrame) -> None:
        """Keep a replica of the only node's state. Raises MessageError: no state was ordered."""
        check_indices("state", [frame.number], self._next_state)
        if frame.number == (self._opened or self._state).number:
            self._kept[frame.number] = frame.data
            for old in sorted(self._kept)[:-KEPT]:
                del self._kept[old]

    def _check_kept(self, state: int) -> None:
        """Raise LinkLostError if the only node has not sent a replica of its state."""
        if len(self._living) == 1 and state not in self._kept:
            raise LinkLostError(self.first, MessageError(f"it has not sent state {state}"))

    def _exchange(self, frame: NodeFrame) -> None:
        """Send the receptions to all nodes; in a repeated step, send the same receptions again.

        Raises:
            MessageError: no step is in progress.
        """
        known = None if self._performed is None else self._performed.receptions
        if known is None:
            raise MessageError("it sends an EXCHANGE without a step")
        if self._exchanged == len(known):
            known.append(self._answer(frame.data))
        for node in self._living:
            answer = known[self._exchanged]
            self._links.send(node, FrameKind.RECEPTIONS, self.generation, [answer])
        self._exchanged += 1

    def _forward(self, number: int, frame: NodeFrame) -> None:
        """Forward actions that a node has refused to their owners.

        Raises:
            MessageError: the agents or owners are unknown, or the node did not have their actions.
        """
        found = read_refusal(frame.data, self.owner.size, {*self._living} - {number})
        if (self.owner[found[0]] != number).any():
            raise MessageError("it refuses actions that it has not received")
        if self._performed is None or (actions := self._performed.actions) is None:
            raise MessageError("it refuses actions without a step")
        for owner in np.unique(found[1]).tolist():
            agents = found[0, found[1] == owner]
            self.owner[agents] = owner
            self._refused |= dict.fromkeys(agents.tolist(), number)
            self.redirected += len(agents)
            self._links.send(owner, FrameKind.ACTIONS, self.generation, [actions.some(agents)])

    def _lose(self, lost: LinkLostError, has_begun: bool = True) -> None:
        """Remove a lost node, and start another node in its place.

        Raises:
            WorkerError: too many nodes, including this node, were lost before they had begun work.
        """
        is_silent = isinstance(lost, SilentNodeError)
        lost = lost if is_silent else self._watch.most_missed(lost, self.generation)
        number = lost.peer
        self._is_torn = True
        self._watch.forget_missed()
        self._links.drop(number)
        node = self._nodes.pop(number, None)
        self._new.pop(number, None)
        self._present.discard(number)
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
        """Go back to the newest state of all nodes; live nodes take over zones of lost nodes.

        Zones whose home is another live node move to that node.

        Raises:
            LinkLostError: another node is lost.
            WorkerDeathError: there is no replica of a lost node.
        """
        state = self._state
        self._opened = None
        moves, kept = self._moves()
        self.zones, self._living = moves.zones, living_of(moves.zones)
        self.owner[~np.isin(self.owner, self._living)] = UNOWNED  # the owner may be any node
        self._begin_generation()
        self._cut = state.cut
        self.coordinator.set_neighbours(state.cut.neighbours)
        hostings = self.coordinator.recover(nodes_of(self.zones), state.switched)
        self.send_zones(hostings, moves, begins=False, kept=kept)
        self.commit()
        self._new.clear()
        self._is_torn = False
        self._keep_again_s = -math.inf
        self.recoveries += bool(moves.heirs or kept)

    def _moves(self) -> tuple[ZoneMoves, Bytes]:
        """Return the new zones of the nodes, and the replica of a state that only the caller has.

        If the only node is lost, another node takes its place.

        Raises:
            WorkerDeathError: there is no replica of a lost node, or too many were lost.
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
            cure = (
                "The log says why each node was lost; make the environment again, with a larger "
                f"workers.max_retries than {self._max_retries} if you expect more losses"
            )
            raise WorkerDeathError(hosts[0], name, state.number, "step", causes, cure)
        if not self._nodes:
            self._seat(1)
        successor = min(self._nodes)
        zones: Zones = [[] for _ in self._homes]
        zones[successor] = state.zones[hosts[0]]
        return ZoneMoves(zones, {}, []), kept

    def send_zones(
        self,
        hostings: Sequence[Sequence[Hosting]],
        moves: ZoneMoves,
        begins: bool,
        kept: Bytes = b"",  # replica of the state, if only this process has it
    ) -> None:
        """Send the order to recover, with the zones of all nodes."""
        order = {
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
            data = json.dumps({**order, "number": number}).encode()
            size = len(data).to_bytes(8, "little")
            self._links.send(number, FrameKind.RECOVER, self.generation, [size, data, kept])

    def _choose_reporter(self) -> int:
        """Return the reporter: a node that took part in the last step, if possible."""
        old = [number for number in self._living if number not in self._new]
        self.reporter = self.reporter if self.reporter in old else (old or self._living)[0]
        return self.reporter

    def commit(self) -> dict[int, memoryview]:
        """Wait for the reports of all nodes on a tick, and commit it.

        Returns:
            the results that were sent with the reports, the reporter's result first.

        Raises:
            LinkLostError: a node is lost, or has sent a bad report.
        """
        reports, results = {}, {}
        frames = self._receive_all(FrameKind.REPORT)
        for number in sorted(frames, key=self.reporter.__ne__):  # then in ascending order
            with reading(number):
                messages, of_worlds, more = read_report(frames[number].data, len(self._runs))
                self.coordinator.check(number, messages, of_worlds)
            reports[number] = messages, of_worlds
            results[number] = more
        self.coordinator.commit(reports)
        return results

    def close(self) -> None:
        """End the nodes, unless this process is a fork of the process that started them."""
        if is_fork(self._pid):
            return
        self._links.end(END_S)
        self.coordinator.close()


def unread(number: int, data: memoryview) -> None:
    """Ignore the result of a node."""


def _nothing(number: int, frame: NodeFrame) -> Exception | None:
    """Ignore messages before the first tick."""
    return None
