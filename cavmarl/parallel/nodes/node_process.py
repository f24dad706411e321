"""The process of a node: it hosts some zones of W worlds, and runs the ticks beside the others."""

from __future__ import annotations

import json
import os
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CavmarlError, MessageError, NodeRefusedError
from cavmarl.core.tracebacks import traceback_text
from cavmarl.engine.shard_clock import ShardClock
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.parallel.network.code_stamp import code_stamp
from cavmarl.parallel.network.transport import Bytes, Place
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
from cavmarl.parallel.nodes.node_loads import told_of
from cavmarl.parallel.nodes.node_network import RemoteNetwork
from cavmarl.parallel.nodes.node_peers import NodePeers
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.peer_faults import LinkLostError, read_json, reading
from cavmarl.parallel.nodes.state_replicas import StateReplicas
from cavmarl.parallel.nodes.zone_endpoints import ZoneEndpoints, hosting_of, unpacked
from cavmarl.parallel.nodes.zone_moves import living_of, nodes_of, read_order
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import WORLD_TASKS, Task, WorldTask, commands_of

MEASURED_TICKS = 10  # one of so many shows what zones cost
HANDSHAKE_S = 60.0  # for the other nodes to call
DIFFERENT = "are read as something else on this machine: {} is the caller's folder"


def _saved(payload: Any, first: int) -> dict[str, Any]:
    return {"saved": saved_of(payload)}


def _nothing(payload: None, first: int) -> dict[str, Any]:
    return {}


def _states(worlds: LocalWorlds) -> NDArray[np.float32]:
    worlds.write_states()
    return worlds.arrays.states


def _proposal(worlds: LocalWorlds) -> Any:
    return proposal_of(worlds.simulation)


# What the first node answers: an array as its bytes, all else as JSON.
_OF_FIRST: dict[Task, WorldTask] = {
    **WORLD_TASKS,
    Task.WRITE_STATES: WorldTask(_states, _nothing),
    Task.SAVE: WorldTask(LocalWorlds.save_worlds, _nothing, worlds_payload),
    Task.CHECK: WorldTask(LocalWorlds.refusal, _saved),
    Task.PROPOSE: WorldTask(_proposal, _nothing),
}


class NodeProgram:
    """One node.

    Attributes:
        zones: that it hosts.
    """

    _replicas: StateReplicas  # once it has begun

    def __init__(self, system: NodeSystem, links: Links, address: str, secret: bytes) -> None:
        self.zones: tuple[int, ...] = ()
        self._system, self._links = system, links
        self._address = address  # of this machine, as the caller reaches it
        self._secret = secret
        self._network: RemoteNetwork | None = None
        self._number = -1  # until the caller has said it
        self._generation = 0
        self._actions: deque[NodeFrame] = deque()  # that have been sent here after all
        # Tasks that all nodes do, each for its zones; the first node does the others.
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
        """Load the world, and say where other nodes can call.

        Raises:
            NodeRefusedError: the caller does not want this one.
        """
        links = self._links
        told = {"code": code_stamp(), "machine": socket.gethostname(), "pid": os.getpid()}
        links.send(COORDINATOR, FrameKind.JOIN, 0, [json.dumps(told).encode()])
        with reading(COORDINATOR):
            job = read_json(self._receive_next(FrameKind.JOB), dict)
            files = [WorldFile(*told) for told in job["files"]]
        self._fetch(files)
        message = with_local_files(job["message"], files)
        worlds = self._system.worlds_of(message, DIFFERENT, job["num_worlds"], job["in_next_step"])
        self._run_worlds(worlds)
        self._lease_ticks = job["lease_ticks"]
        self._listener = self._system.listen(self._address, self._secret)
        said = [*self._listener.place, *neighbours_as_json(worlds.simulation)]
        links.send(COORDINATOR, FrameKind.READY, 0, [json.dumps(said).encode()])

    def _run_worlds(self, worlds: LocalWorlds) -> None:
        """Do commands with these worlds from now on."""
        self._worlds = worlds
        self._commands = commands_of(worlds.arrays)
        self._inputs, self._results = Inputs(worlds.arrays), ResultStream(worlds.arrays)
        self._logs = worlds.keep_logs()
        v2x = worlds.world.config.v2x
        if v2x.enabled and v2x.channel.external:
            self._network = RemoteNetwork(self._links, worlds.simulation.messages)

    def _fetch(self, files: Sequence[WorldFile]) -> None:
        """Get those that this machine does not have."""
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
        """What the caller sends next, while it may send this node away."""
        frame = self._links.receive_next(COORDINATOR)
        if frame.kind is not kind:
            raise MessageError(f"the caller sent {frame.kind.name}, not {kind.name}")
        return frame.data

    def _share(self, zones: Any, runs: Any, hostings: Any, generation: int) -> None:
        """Host the zones that are this node's from now on."""
        simulation, mine = self._worlds.simulation, zones[self._number]
        self.zones = tuple(mine)
        self._living = living_of(zones)
        told = [
            [hosting_of(bytes.fromhex(run), some[zone]) for zone in mine]
            for run, some in zip(runs, hostings, strict=True)
        ]
        self._peers = NodePeers(simulation, self._links, zones, self._number, generation << 32)
        mounted = simulation.mounted
        arrays = self._worlds.arrays
        carried = [arrays.controls, arrays.meta_actions]
        carried += [] if mounted is None else mounted.arrays()
        settings, division = simulation.config.zones, simulation.division
        self._endpoints = ZoneEndpoints(
            division, mine, nodes_of(zones), told, limits_of(settings, division.codec.schema),
            self._links, carried, self._peers.checks, generation=generation,
            is_checked=settings.check_invariants, ticks=self._lease_ticks,
        )  # fmt: skip
        self._run_own()

    def _run_own(self) -> None:
        """Run the phases of this node's zones from now on."""
        simulation = self._worlds.simulation
        own = [simulation.shards[zone] for zone in self.zones]
        foreign = [shard for shard in simulation.shards if shard.zone not in self.zones]
        every = simulation.config.workers.balance_steps
        self._clock = ShardClock(own, MEASURED_TICKS) if every else None
        plain = NodeExecutor(own, foreign)
        executor = plain if self._clock is None else TimedNodeExecutor(plain, self._clock)
        simulation.zones.host_zones(self._peers, self._endpoints, executor)

    def _receive(self, number: int, frame: NodeFrame) -> None:
        """Take an urgent frame."""
        is_caller = number == COORDINATOR
        match frame.kind:
            case FrameKind.MESSAGES:
                self._endpoints.receive(frame)
            case FrameKind.KEEP if not is_caller:
                self._replicas.receive(number, frame)
            case FrameKind.AGENT if not is_caller:
                self._endpoints.receive_agent(frame)
            case FrameKind.GIVE if not is_caller:
                self._replicas.receive_given(number, frame)
            case FrameKind.ACTIONS if is_caller:
                self._actions.append(frame)
            case FrameKind.RECEPTIONS if is_caller and self._network is not None:
                self._network.receive(frame)
            case FrameKind.PING if is_caller:
                said = json.dumps(self._links.awaited).encode()
                self._links.send(COORDINATOR, FrameKind.PONG, frame.number, [said])
            case _:
                raise MessageError(f"it sends no frame of kind {frame.kind.name}")

    def serve(self) -> NoReturn:
        """Do what the coordinator asks for.

        Raises:
            NeededNoMoreError: it asks for no more.
            LinkLostError: it is gone.
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
                self._go_back(ordered.frame)
            except LinkLostError as lost:
                self._miss(lost)
                self._go_back(None)

    def _go_back(self, frame: NodeFrame | None) -> None:
        """Others are lost: wait for the coordinator to say where to go on."""
        while True:
            try:
                while frame is None or frame.kind is not FrameKind.RECOVER:
                    frame = self._links.receive_next(COORDINATOR)
                self._recover(frame)
                return
            except RecoveryOrderedError as ordered:
                frame = ordered.frame
            except LinkLostError as lost:
                self._miss(lost)
                frame = None

    def _miss(self, lost: LinkLostError) -> None:
        """Tell the coordinator of a node that cannot be reached: others may not see it."""
        if lost.peer == COORDINATOR:
            raise lost
        self._links.drop(lost.peer)
        said = lost.peer.to_bytes(4, "little")
        self._links.send(COORDINATOR, FrameKind.MISSED, self._generation, [said])

    def _recover(self, frame: NodeFrame) -> None:
        """Begin, or go back to a state that was kept, with the zones that the coordinator names."""
        links, data, before = self._links, frame.data, self._worlds
        with reading(COORDINATOR):
            at = 8 + int.from_bytes(data[:8], "little")
            told = read_order(data[8:at], before.world.partition.count)
            partition = read_zones(told["partition"])
        self._generation = frame.number
        is_new, num_worlds = self._number < 0, told["num_worlds"]
        if num_worlds != len(before.arrays.mask) or (told["begins"] and not is_new):
            self._run_worlds(before.of_number(num_worlds))
            before.close()
            if not is_new:
                self._replicas.begin_anew(self._worlds, self._logs)
        if is_new or self._worlds is not before:
            self._number = told["number"]
            self._received_actions = ReceivedActions(self._worlds.arrays, self._number)
        if is_new:
            self._replicas = StateReplicas(self._worlds, self._logs, links, self._number)
            links.urgent = self._receive
        self._is_reporter = told["first"] == self._number
        if self._network is not None:
            self._network.begin(frame.number, self._is_reporter)
        for number in told["lost"]:
            links.drop(number)
        zones = told["zones"]
        others = [node for node, some in enumerate(zones) if some and node != self._number]
        self._meet(told["places"], others)
        self._worlds.simulation.zones.set_zones(partition)
        self._share(zones, told["runs"], told["hostings"], frame.number)
        state, mine = told["state"], zones[self._number]
        if told["begins"]:  # what is kept elsewhere has come when the SYNC after it comes
            self._peers.keep_own(self._worlds.simulation.everywhere)
            self._replicas.keep(state, self._living)
        for node in others:
            links.send(node, FrameKind.SYNC, frame.number)
        for node in others:
            while True:
                found = links.receive_next(node)
                if found.kind is FrameKind.SYNC and found.number == frame.number:
                    break
        if not told["begins"]:
            if len(data) > at:
                with reading(COORDINATOR):
                    self._replicas.resume_from(state, data[at:])
            adopted = [number for number, heir in told["heirs"] if heir == self._number]
            donors = [donor for donor, taker in told["donors"] if taker == self._number]
            takers = [taker for donor, taker in told["donors"] if donor == self._number]
            self._replicas.load(state, adopted, donors, takers, mine, self._generation, self._check)
        self._endpoints.report()

    def _meet(self, places: Mapping[int, Place], others: Sequence[int]) -> None:
        """Connect with new nodes, by their places; of two of them the higher one calls.

        Raises:
            LinkLostError: one cannot be reached.
            RecoveryOrderedError: the coordinator knows of more by now.
        """
        links, number, times = self._links, self._number, self._generation
        is_new = number in places
        for other in others if is_new else places:
            links.drop(other)  # of an attempt that came to nothing
        for other in others:
            if other in places and (not is_new or other < number):
                found = call_node(self._system, places[other], self._secret, number, times, other)
                links.add(other, found)
        if is_new:
            links.wanted = callers = [
                node for node in others if node not in places or node > number
            ]
            called = accept_nodes(
                self._system, self._listener, callers, times, HANDSHAKE_S, self._check
            )
            links.wanted = ()
            for other, connection in called.items():
                links.add(other, connection)

    def _check(self) -> None:
        """Raises RecoveryOrderedError: the coordinator has something newer to say."""
        self._links.pump(0.0)
        if self._links.has(COORDINATOR):
            raise RecoveryOrderedError(None)

    def _perform(self, frame: NodeFrame) -> None:
        with reading(COORDINATOR):
            if frame.kind is not FrameKind.COMMAND:
                raise MessageError(f"it sends no frame of kind {frame.kind.name} here")
            task, payload, at = command_of(frame.data)
        self._replicas.settle()
        if frame.number:
            self._replicas.keep(frame.number, self._living)
        if perform := self._of_all.get(task):
            perform(payload, frame.data, at)
        else:
            self._look(task, payload)

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
            told = task.read(payload, 0)
        task.method(self._worlds, **told)
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
        told = told_of(payload, self._links, self._worlds.simulation, self.zones)
        self._answer([json.dumps([self._number, *told]).encode()])

    def _suggest(self, payload: None, data: memoryview, at: int) -> None:
        WORLD_TASKS[Task.SUGGEST].perform(self._worlds, payload)
        where = np.flatnonzero(self._peers.own.reshape(-1))
        found = self._worlds.arrays.suggested.reshape(-1, 2)[where]
        self._answer([where.data, found.reshape(-1).data])

    def _await_actions(self, data: memoryview, at: int) -> int:
        """Return when it is known what all agents of this node do in the next step: their end.

        Those of other nodes are refused, with the number of their owner.

        Raises:
            RecoveryOrderedError: the coordinator wants something else by now.
        """
        received, owner = self._received_actions, self._peers.owner
        received.begin(owner)
        with reading(COORDINATOR):
            wrong, end = received.read(data, at, owner)
        if len(wrong):
            said = refusal(wrong, owner)
            self._links.send(COORDINATOR, FrameKind.NOT_MINE, self._generation, said)
        while received.are_due:
            while self._actions:
                late = self._actions.popleft()
                if late.number == self._generation:
                    with reading(COORDINATOR):
                        received.read(late.data, 0, owner)
            if received.are_due:
                self._links.check_recovery()
                self._links.pump(None)
        return end

    def _results_of(self, chosen: NDArray[np.bool_], of_step: bool) -> Bytes:
        peers = self._peers
        return self._results.packed(peers.own, chosen, peers.stepped, of_step, self._is_reporter)

    def _look(self, task: Task, payload: Any) -> None:
        """Answer what only the first node can, which has the whole world meanwhile."""
        worlds, answer = self._worlds, list[Bytes]()
        with self._peers.whole(worlds.simulation):
            if self._is_first:
                found = _OF_FIRST[task].perform(worlds, payload)
                is_array = isinstance(found, np.ndarray)
                answer = [found.reshape(-1).data if is_array else json.dumps(found).encode()]
        self._answer(answer)

    @property
    def _is_first(self) -> bool:
        """Whether this node has whole worlds where one is asked for."""
        return self._number == self._living[0]

    def _answer(self, pieces: Sequence[Bytes]) -> None:
        self._links.send(COORDINATOR, FrameKind.RESULT, self._generation, pieces)

    @property
    def generation(self) -> int:
        """How often nodes have come and gone."""
        return self._generation


def _ignore(number: int, frame: NodeFrame) -> Exception | None:
    """Before a node has begun, it hears no messages of the protocol."""
    return None


def run_node(
    place: Place,  # where the caller listens
    secret: bytes,
    number: int,  # that it would have; ANYONE: any
    note: Callable[[str], None] = lambda text: None,  # what is told of its life
    system: NodeSystem = MACHINE,
) -> bool:
    """The whole life of a node.

    Returns:
        whether it is needed no more, as the caller has said; else the caller is gone.

    Raises:
        OSError: no process listens there.
        EOFError: the caller wants no more, or is busy.
        MessageError: what listens there does not know the secret, or speaks another version.
        NodeRefusedError: the caller does not want it.
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
        said = [
            type(error).__name__,
            str(error),
            "" if isinstance(error, CavmarlError) else traceback_text(error),
        ]
        with suppress(LinkLostError, NeededNoMoreError):
            links.send(COORDINATOR, FrameKind.FAILED, node.generation, [json.dumps(said).encode()])
            links.flush()
            while True:
                links.pump(None)
        return False
    finally:
        links.close()


def run_on_ray(place: Place, secret: bytes, number: int) -> None:
    """The same as an actor, which Ray starts again if it ends before it is needed no more."""
    if not run_node(place, secret, number):
        os._exit(1)
