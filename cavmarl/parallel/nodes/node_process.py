"""The process of a node: it hosts some zones of W worlds, and runs ticks with the other nodes."""

from __future__ import annotations

import json
import os
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CavmarlError, MessageError, NodeRefusedError
from cavmarl.core.tracebacks import traceback_text
from cavmarl.engine.shard_clock import ShardClock
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.code_stamp import code_stamp
from cavmarl.parallel.network.transport import Bytes, Connection, Place
from cavmarl.parallel.nodes.agent_stream import ResultStream
from cavmarl.parallel.nodes.link import FrameKind, NeededNoMoreError, NodeFrame
from cavmarl.parallel.nodes.links import Links, RecoveryOrderedError
from cavmarl.parallel.nodes.node_actions import ReceivedActions, refusal
from cavmarl.parallel.nodes.node_cuts import cut_worlds, neighbours_as_json, proposal_of, read_zones
from cavmarl.parallel.nodes.node_executor import NodeExecutor, TimedNodeExecutor
from cavmarl.parallel.nodes.node_files import WorldFile, with_local_files
from cavmarl.parallel.nodes.node_frames import (
    Inputs,
    command_of,
    saved_of,
    worlds_payload,
)
from cavmarl.parallel.nodes.node_handshake import accept_nodes, call_node
from cavmarl.parallel.nodes.node_loads import load_report
from cavmarl.parallel.nodes.node_network import RemoteNetwork
from cavmarl.parallel.nodes.node_peers import SHARE_BITS, NodePeers
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.node_watch import Pong
from cavmarl.parallel.nodes.peer_faults import LinkLostError, read_json, reading
from cavmarl.parallel.nodes.state_replicas import StateReplicas
from cavmarl.parallel.nodes.zone_endpoints import ZoneEndpoints, hosting_of, unpacked
from cavmarl.parallel.nodes.zone_moves import living_of, nodes_of, read_order
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import WORLD_TASKS, Task, WorldTask, commands_of

MEASURED_TICKS = 10  # one tick in 10 measures the costs of zones
HANDSHAKE_S = 60.0  # time for the other nodes to call
DIFFERENT = "differ on this machine from the caller's files in {}"


def _saved(payload: Any, first: int) -> dict[str, Any]:
    return {"saved": saved_of(payload)}


def _nothing(payload: None, first: int) -> dict[str, Any]:
    return {}


def _states(worlds: LocalWorlds) -> NDArray[np.float32]:
    worlds.write_states()
    return worlds.arrays.states


def _proposal(worlds: LocalWorlds) -> Any:
    return proposal_of(worlds.simulation)


# Tasks of the first node. It answers with the bytes of an array, or with JSON.
_OF_FIRST: dict[Task, WorldTask] = {
    **WORLD_TASKS,
    Task.WRITE_STATES: WorldTask(_states, _nothing),
    Task.SAVE: WorldTask(LocalWorlds.save_worlds, _nothing, worlds_payload),
    Task.CHECK: WorldTask(LocalWorlds.refusal, _saved),
    Task.PROPOSE: WorldTask(_proposal, _nothing),
}


class NodeProgram:
    """The program of a node.

    Attributes:
        zones: hosted by this node.
    """

    _replicas: StateReplicas  # set by the first RECOVER

    def __init__(self, system: NodeSystem, links: Links, address: str, secret: bytes) -> None:
        self.zones: tuple[int, ...] = ()
        self._system, self._links = system, links
        self._address = address  # address of this machine that the caller can reach
        self._secret = secret
        self._network: RemoteNetwork | None = None
        self._number = -1  # the caller sends it with the first RECOVER
        self._generation = 0
        self._synchronized: set[int] = set()  # nodes whose SYNC of this generation has arrived
        # world, vehicle and zone of each offer that was answered recently
        self._answered: list[tuple[int, int, int]] = []
        # node → fault in one of its frames, repeated in later reports: earlier ones may be void
        self._faults: dict[int, str] = {}
        self._witness: int | None = None  # node that claims that a recovery is ordered
        self._actions: deque[NodeFrame] = deque()  # forwarded actions
        # Tasks that each node carries out for its zones; all other tasks are for the first node.
        self._of_all: dict[Task, Callable[[Any, memoryview, int], None]] = {
            Task.STEP: self._step,
            Task.RESET: self._reset,
            Task.LOAD: self._load,
            Task.CUT: self._cut,
            Task.COSTS: self._report_costs,
            Task.LOADS: self._report_loads,
            Task.SUGGEST: self._suggest,
        }

    def join(self) -> None:
        """Load the world, and send the place where other nodes can call.

        Raises:
            NodeRefusedError: the caller refuses this node.
        """
        links = self._links
        join = {"code": code_stamp(), "machine": socket.gethostname(), "pid": os.getpid()}
        links.send(COORDINATOR, FrameKind.JOIN, 0, [json.dumps(join).encode()])
        with reading(COORDINATOR):
            job = read_json(self._receive_next(FrameKind.JOB), dict)
            files = [WorldFile(*fields) for fields in job["files"]]
        self._fetch(files)
        message = with_local_files(job["message"], files)
        worlds = self._system.worlds_of(message, DIFFERENT, job["num_worlds"], job["in_next_step"])
        self._run_worlds(worlds)
        self._lease_ticks = job["lease_ticks"]
        self._listener = self._system.listen(self._address, self._secret)
        ready = [*self._listener.place, *neighbours_as_json(worlds.simulation)]
        links.send(COORDINATOR, FrameKind.READY, 0, [json.dumps(ready).encode()])

    def _run_worlds(self, worlds: LocalWorlds) -> None:
        """Carry out commands with these worlds from now on."""
        self._worlds = worlds
        self._commands = commands_of(worlds.arrays)
        self._inputs, self._results = Inputs(worlds.arrays), ResultStream(worlds.arrays)
        self._logs = worlds.keep_logs()
        v2x = worlds.world.config.v2x
        if v2x.enabled and v2x.channel.external:
            self._network = RemoteNetwork(self._links, worlds.simulation.messages)

    def _fetch(self, files: Sequence[WorldFile]) -> None:
        """Receive the files that this machine does not have."""
        wanted = [n for n, file in enumerate(files) if file.found() is None]
        if not wanted:
            return
        self._links.send(COORDINATOR, FrameKind.WANTED, 0, [json.dumps(wanted).encode()])
        with reading(COORDINATOR):
            data = self._receive_next(FrameKind.FILES)
            at = 8 + int.from_bytes(data[:8], "little")
            for n, size in zip(wanted, read_json(data[8:at], list), strict=True):
                files[n].keep(bytes(data[at : at + size]))
                at += size

    def _receive_next(self, kind: FrameKind) -> memoryview:
        """Receive a frame of this kind from the caller, which may refuse this node instead."""
        frame = self._links.receive_next(COORDINATOR)
        if frame.kind is not kind:
            raise MessageError(f"the caller sent {frame.kind.name}, not {kind.name}")
        return frame.data

    def _host(self, zones: Any, runs: Any, hostings: Any, generation: int) -> None:
        """Host the zones of this node, as the caller has assigned them."""
        simulation, mine = self._worlds.simulation, zones[self._number]
        self.zones = tuple(mine)
        self._zones_of, self._living = zones, living_of(zones)
        own_hostings = [
            [hosting_of(bytes.fromhex(run), some[zone]) for zone in mine]
            for run, some in zip(runs, hostings, strict=True)
        ]
        self._peers = NodePeers(simulation, self._links, zones, self._number, generation)
        mounted = simulation.mounted
        arrays = self._worlds.arrays
        carried = [arrays.controls, arrays.meta_actions]
        carried += [] if mounted is None else mounted.arrays()
        settings, division = simulation.config.zones, simulation.division
        limits = limits_of(settings, division.codec.schema)
        gate = simulation.zones.gate
        if gate is not None:  # the coordinator awaits an answer for each vehicle in each lease
            limits = replace(limits, backoff=0)
        self._endpoints = ZoneEndpoints(
            division, mine, nodes_of(zones), own_hostings, limits,
            self._links, carried, self._peers.checks, self._answered, generation=generation,
            is_checked=settings.check_invariants, ticks=self._lease_ticks, gate=gate,
        )  # fmt: skip
        self._run_own()

    def _run_own(self) -> None:
        """From now on, run only the phases of the zones of this node."""
        simulation = self._worlds.simulation
        own = [simulation.shards[zone] for zone in self.zones]
        foreign = [shard for shard in simulation.shards if shard.zone not in self.zones]
        every = simulation.config.workers.balance_steps
        self._clock = ShardClock(own, MEASURED_TICKS) if every else None
        plain = NodeExecutor(own, foreign)
        executor = plain if self._clock is None else TimedNodeExecutor(plain, self._clock)
        simulation.zones.host_zones(self.zones, self._peers, self._endpoints, executor)

    def _receive(self, number: int, frame: NodeFrame) -> None:
        """Apply an urgent frame."""
        is_caller = number == COORDINATOR
        match frame.kind:
            case FrameKind.MESSAGES if not is_caller:
                if frame.is_of(self._generation, number in self._synchronized):
                    self._endpoints.receive(number, frame)
            case FrameKind.KEEP if not is_caller:
                self._replicas.receive(number, frame)
            case FrameKind.AGENT if not is_caller:
                if frame.is_of(self._generation, number in self._synchronized):
                    self._endpoints.receive_agent(number, frame)
            case FrameKind.GIVE if not is_caller:
                if frame.is_of(self._generation, number in self._synchronized):
                    self._replicas.receive_given(number, frame)
            case FrameKind.ACTIONS if is_caller:
                self._actions.append(frame)
            case FrameKind.RECEPTIONS if is_caller and self._network is not None:
                self._network.receive(frame)
            case FrameKind.PING if is_caller:
                self._answer_ping(frame)
            case _:
                raise MessageError(f"it must not send frames of kind {frame.kind.name}")

    def _answer_ping(self, frame: NodeFrame) -> None:
        """Report the frames and actions that this node awaits."""
        witnesses = [] if self._witness is None else [self._witness]
        due = self._received_actions.due()
        pong = Pong(self._links.awaited, witnesses, self._answered, due)
        self._links.send(COORDINATOR, FrameKind.PONG, frame.number, [json.dumps(pong).encode()])

    def serve(self) -> NoReturn:
        """Carry out the commands of the coordinator.

        Raises:
            NeededNoMoreError: the coordinator has dismissed this node.
            LinkLostError: the coordinator has disconnected.
        """
        while True:
            try:
                frame = self._links.receive_next(COORDINATOR)
                if frame.kind is FrameKind.RECOVER:
                    self._recover(frame)
                elif frame.kind is FrameKind.LEASE:
                    with reading(COORDINATOR):
                        leased = unpacked(frame.data)
                    self._endpoints.note(leased)
                else:
                    self._perform(frame)
            except RecoveryOrderedError as ordered:
                self._witness = ordered.witness
                self._go_back(ordered.frame)
            except LinkLostError as lost:
                self._report_missed(lost)
                self._go_back(None)

    def _go_back(self, frame: NodeFrame | None) -> None:
        """Wait for the order of the coordinator to recover, and carry it out."""
        while True:
            try:
                while frame is None or frame.kind is not FrameKind.RECOVER:
                    frame = self._links.receive_next(COORDINATOR)
                self._witness = None
                self._recover(frame)
                return
            except RecoveryOrderedError as ordered:
                frame, self._witness = ordered.frame, ordered.witness
            except LinkLostError as lost:
                self._report_missed(lost)
                frame = None

    def _report_missed(self, lost: LinkLostError) -> None:
        """Tell the coordinator that a node cannot be reached, or has sent a bad frame.

        If a frame of the coordinator seems bad, this node is at fault, so it reports itself.
        """
        is_coordinator = lost.peer == COORDINATOR
        if is_coordinator and (not lost.fault or self._number < 0):
            raise lost
        number = self._number if is_coordinator else lost.peer
        if not is_coordinator:
            self._links.drop(number)
        if lost.fault:
            self._faults[number] = lost.fault
        peer, fault = number.to_bytes(4, "little"), self._faults.get(number, "").encode()
        self._links.send(COORDINATOR, FrameKind.MISSED, self._generation, [peer, fault])

    def _recover(self, frame: NodeFrame) -> None:
        """Start, or go back to a kept state, with the zones that the coordinator assigns."""
        links, data, before = self._links, frame.data, self._worlds
        with reading(COORDINATOR):
            at = 8 + int.from_bytes(data[:8], "little")
            order = read_order(data[8:at], before.world.partition.count)
            partition = read_zones(order["partition"])
        self._generation = frame.number
        self._synchronized.clear()
        is_new, num_worlds = self._number < 0, order["num_worlds"]
        if num_worlds != len(before.arrays.mask) or (order["begins"] and not is_new):
            self._run_worlds(before.of_number(num_worlds))
            before.close()
            if not is_new:
                self._replicas.begin_anew(self._worlds, self._logs)
        if is_new or self._worlds is not before:
            self._number = order["number"]
            self._received_actions = ReceivedActions(self._worlds.arrays, self._number)
        self._received_actions.are_due = False
        if is_new:
            self._replicas = StateReplicas(self._worlds, self._logs, links, self._number)
            links.urgent = self._receive
        self._is_reporter = order["first"] == self._number
        if self._network is not None:
            self._network.begin(frame.number, self._number, order["first"])
        for number in order["lost"]:
            links.drop(number)
        zones = order["zones"]
        others = [node for node, some in enumerate(zones) if some and node != self._number]
        self._connect(order["places"], others)
        self._worlds.simulation.zones.set_zones(partition)
        self._host(zones, order["runs"], order["hostings"], frame.number)
        state, mine = order["state"], zones[self._number]
        if order["begins"]:  # when the SYNC below arrives, the replica has arrived, too
            self._peers.drop_foreign_rows(self._worlds.simulation.everywhere)
            saved = self._replicas.keep(state, self._living)
        for node in others:
            links.send(node, FrameKind.SYNC, frame.number)
        for node in others:
            self._await_sync(node)
        if order["begins"]:
            self._replicas.await_replica(state, zones, saved)
        if not order["begins"]:
            if len(data) > at:
                with reading(COORDINATOR):
                    self._replicas.resume_from(state, data[at:])
            adopted = [number for number, heir in order["heirs"] if heir == self._number]
            donors = [donor for donor, taker in order["donors"] if taker == self._number]
            takers = [taker for donor, taker in order["donors"] if donor == self._number]
            self._replicas.load(state, adopted, donors, takers, mine, self._generation)
        self._endpoints.report()

    def _await_sync(self, number: int) -> None:
        """Drop the frames of earlier generations of another node.

        Raises:
            LinkLostError: the node has disconnected, or has sent no SYNC.
            RecoveryOrderedError: the coordinator has ordered another recovery.
        """
        links, generation = self._links, self._generation
        while True:
            frame = links.receive_next(number)
            is_sync = frame.kind is FrameKind.SYNC
            if is_sync and frame.number > generation:
                links.unread(number, frame)
                raise RecoveryOrderedError(None, number)
            is_share = frame.kind is FrameKind.SHARE
            if (is_sync and frame.data) or (is_share and frame.number >> SHARE_BITS >= generation):
                raise LinkLostError(number, MessageError("it has sent no SYNC"))
            if is_sync and frame.number == generation:
                self._synchronized.add(number)
                return

    def _connect(self, places: Mapping[int, Place], others: Sequence[int]) -> None:
        """Connect to new nodes; of two new nodes, the node with the higher number calls.

        Raises:
            LinkLostError: a node cannot be reached.
            RecoveryOrderedError: the coordinator has sent a newer order.
        """
        links, number, times = self._links, self._number, self._generation
        is_new = number in places
        for other in others if is_new else places:
            links.drop(other)  # left by a failed attempt
        for other in others:
            if other in places and (not is_new or other < number):
                found = call_node(self._system, places[other], self._secret, number, times, other)
                self._add(other, found)
        if is_new:
            links.wanted = callers = [
                node for node in others if node not in places or node > number
            ]
            called = accept_nodes(
                self._system, self._listener, callers, times, HANDSHAKE_S, self._check_orders
            )
            links.wanted = ()
            for other, connection in called.items():
                self._add(other, connection)

    def _add(self, number: int, connection: Connection) -> None:
        self._links.add(number, connection)
        self._faults.pop(number, None)

    def _check_orders(self) -> None:
        """Raise RecoveryOrderedError if the coordinator has sent a newer order."""
        self._links.pump(0.0)
        if self._links.has(COORDINATOR):
            raise RecoveryOrderedError(None)

    def _perform(self, frame: NodeFrame) -> None:
        with reading(COORDINATOR):
            if frame.kind is not FrameKind.COMMAND:
                raise MessageError(f"it must not send frames of kind {frame.kind.name} here")
            task, payload, at = command_of(frame.data)
        self._replicas.settle()
        if frame.number:
            saved = self._replicas.keep(frame.number, self._living)
            self._replicas.await_replica(frame.number, self._zones_of, saved)
        if perform := self._of_all.get(task):
            perform(payload, frame.data, at)
        else:
            self._do_alone(task, payload)

    def _step(self, payload: None, data: memoryview, at: int) -> None:
        worlds = self._worlds
        at = self._await_actions(data, at)
        with reading(COORDINATOR):
            at = self._inputs.read(Task.STEP, data, at)
            leased = unpacked(data[at:])
        self._endpoints.lease(leased)
        self._peers.begin_step()
        worlds.step(self._commands)
        self._endpoints.report([self._results_of(worlds.simulation.everywhere, of_step=True)])

    def _reset(self, payload: Any, data: memoryview, at: int) -> None:
        task = WORLD_TASKS[Task.RESET]
        with reading(COORDINATOR):
            self._inputs.read(Task.RESET, data, at)
            keywords = task.read(payload, 0)
        task.method(self._worlds, **keywords)
        self._endpoints.report([self._results_of(self._worlds.arrays.chosen, of_step=False)])

    def _load(self, payload: Any, data: memoryview, at: int) -> None:
        with reading(COORDINATOR):
            saved = saved_of(payload)
        WORLD_TASKS[Task.LOAD].perform(self._worlds, saved)
        self._endpoints.report()

    def _cut(self, payload: Any, data: memoryview, at: int) -> None:
        simulation = self._worlds.simulation
        cut_worlds(simulation, self._peers, payload)
        self._run_own()
        self._endpoints.report([json.dumps(neighbours_as_json(simulation)).encode()])

    def _report_costs(self, payload: None, data: memoryview, at: int) -> None:
        spent_s = [] if self._clock is None else self._clock.take_s().tolist()
        of_zones = list(zip(self.zones, spent_s, strict=False))
        running = self._worlds.simulation.running().tolist()
        self._answer([json.dumps([of_zones, running]).encode()])

    def _report_loads(self, payload: Any, data: memoryview, at: int) -> None:
        report = load_report(payload, self._links, self._worlds.simulation, self.zones)
        self._answer([json.dumps([self._number, *report]).encode()])

    def _suggest(self, payload: None, data: memoryview, at: int) -> None:
        WORLD_TASKS[Task.SUGGEST].perform(self._worlds, payload)
        where = np.flatnonzero(self._peers.own.reshape(-1))
        found = self._worlds.arrays.suggested.reshape(-1, 2)[where]
        self._answer([where.data, found.reshape(-1).data])

    def _await_actions(self, data: memoryview, at: int) -> int:
        """Wait for the actions of all agents of this node; return where they end in the data.

        Actions of agents of other nodes are refused with the numbers of the owners.

        Raises:
            RecoveryOrderedError: the coordinator has ordered a recovery.
        """
        received, owner = self._received_actions, self._peers.owner
        received.begin(owner)
        with reading(COORDINATOR):
            wrong, end = received.read(data, at, owner)
        if len(wrong):
            refused = refusal(wrong, owner)
            self._links.send(COORDINATOR, FrameKind.NOT_MINE, self._generation, refused)
        self._links.wanted = (COORDINATOR,)
        while received.are_due:
            while self._actions:
                late = self._actions.popleft()
                if late.number == self._generation:
                    with reading(COORDINATOR):
                        received.read(late.data, 0, owner)
            if received.are_due:
                self._links.check_recovery()
                self._links.pump(None)
        self._links.wanted = ()
        return end

    def _results_of(self, chosen: NDArray[np.bool_], of_step: bool) -> Bytes:
        peers = self._peers
        return self._results.packed(peers.own, chosen, peers.stepped, of_step, self._is_reporter)

    def _do_alone(self, task: Task, payload: Any) -> None:
        """Run a task on the first node, to which the other nodes send their parts of the worlds."""
        worlds, answer = self._worlds, list[Bytes]()
        with self._peers.whole(worlds.simulation):
            if self._is_first:
                found = _OF_FIRST[task].perform(worlds, payload)
                is_array = isinstance(found, np.ndarray)
                answer = [found.reshape(-1).data if is_array else json.dumps(found).encode()]
        self._answer(answer)

    @property
    def _is_first(self) -> bool:
        """True if this node carries out the tasks for a single node."""
        return self._number == self._living[0]

    def _answer(self, pieces: Sequence[Bytes]) -> None:
        self._links.send(COORDINATOR, FrameKind.RESULT, self._generation, pieces)

    def close(self) -> None:
        """End the simulators of zones, if any."""
        if hasattr(self, "_worlds"):
            self._worlds.close()

    @property
    def generation(self) -> int:
        """Number of changes of nodes."""
        return self._generation


def _ignore(number: int, frame: NodeFrame) -> Exception | None:
    """Ignore messages of the protocol before the first RECOVER."""
    return None


def run_node(
    place: Place,  # where the caller listens
    secret: bytes,
    number: int,  # preferred number; ANYONE: any number
    note: Callable[[str], None] = lambda text: None,  # receives notes on the progress
    system: NodeSystem = MACHINE,
) -> bool:
    """Run a node until the caller dismisses it or disconnects.

    Returns:
        True if the caller has dismissed the node; False if it has disconnected, or after an error.

    Raises:
        OSError: no process listens at the place.
        EOFError: the caller has closed the connection.
        MessageError: the listener does not know the secret, or has another version.
        NodeRefusedError: the caller refuses the node.
    """
    connection = system.open(place, secret, number, None)
    address = connection.address
    links = Links(_ignore, system)
    links.add(COORDINATOR, connection)
    node = NodeProgram(system, links, address, secret)
    note(f"has joined {place[0]}:{place[1]}")
    try:
        node.join()
        note("is ready")
        node.serve()
    except NodeRefusedError:
        raise
    except NeededNoMoreError:
        return True
    except LinkLostError:
        return False
    except Exception as error:
        failure = [
            type(error).__name__,
            str(error),
            "" if isinstance(error, CavmarlError) else traceback_text(error),
        ]
        with suppress(LinkLostError, NeededNoMoreError):
            content = json.dumps(failure).encode()
            links.send(COORDINATOR, FrameKind.FAILED, node.generation, [content])
            links.flush()
            while True:
                links.pump(None)
        return False
    finally:
        node.close()
        links.close()


def run_on_ray(place: Place, secret: bytes, number: int) -> None:
    """Run a node as an actor, which Ray restarts unless the caller has dismissed the node."""
    if not run_node(place, secret, number):
        os._exit(1)
