"""`NodePool`: the processes of nodes, what they are told, and what is done when some are lost."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError, WorkerError, WorkerFailureError
from cavmarl.core.processes import is_fork, refuse_fork
from cavmarl.engine.compilation import compiled_before
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import prepare_runs
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.reactions import Hosting
from cavmarl.parallel.commanded_worlds import own_error
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.nodes.leases import lease_ticks, leases_of
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame, said_by
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.newcomers import Newcomer, Newcomers
from cavmarl.parallel.nodes.node_actions import NodeCommand, read_refusal
from cavmarl.parallel.nodes.node_coordinator import NodeCoordinator
from cavmarl.parallel.nodes.node_cuts import PoolState, ZoneCut, read_neighbours, told_zones
from cavmarl.parallel.nodes.node_files import files_of
from cavmarl.parallel.nodes.node_starters import Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.node_watch import NodeWatch, SilentNodeError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, read_json, reading
from cavmarl.parallel.nodes.zone_hosts import read_report, told_hostings
from cavmarl.parallel.nodes.zone_moves import ZoneMoves, living_of, moves_of, name_of, nodes_of
from cavmarl.parallel.recipe import recipe_of
from cavmarl.parallel.step_arrays import StepArrays, layout_of
from cavmarl.parallel.step_placement import StepPlacement
from cavmarl.parallel.work_shares import parts_of
from cavmarl.zones.kernels.agent_frames import UNOWNED

log = logging.getLogger("cavmarl.nodes")

KEEP_S = 0.2  # so much of work may have to be done again
END_S = 1.0  # for nodes to hear that they are needed no more
SPARES = 1  # nodes more than are wanted that may wait for another one's end

Found = TypeVar("Found")

Read: TypeAlias = Callable[[int, memoryview], Found]
"""Reads what the node of a number has found."""


class NodePool:
    """The nodes of W worlds, the same zones of each at each node, and what they are to do.

    Attributes:
        zones: that each node hosts.
        pids: of the nodes' processes, each on its machine.
        losses: how many nodes were lost.
        recoveries: how often the worlds have gone back because of that.
        replacements: how many nodes host zones in the place of others.
        redirected: how many actions a node has refused that was not the owner of the agent.

    Raises:
        ConfigError: a setting that such worlds cannot have, or more nodes than zones.
        WorkerError: a node cannot be started.
    """

    _owner: NDArray[np.int32]  # (W · A,) the node that owns each agent, as far as is known
    _performed: NodeCommand | None = None  # what they do now

    def __init__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from
        num_worlds: int,  # W
        nodes: int,  # n, from 1 to the zones of a world
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
        hosts: str = "",  # what starts the nodes; see `start_nodes`
        route: Route = straight,  # where to call in order to reach a place
        system: NodeSystem = MACHINE,  # that the nodes are on
        start: Start = start_nodes,  # starts them
    ) -> None:
        self.world, self._route = world, route
        self.in_next_step = in_next_step
        config, count = world.config, world.partition.count
        layout = layout_of(config, world.capacity, num_worlds).items()
        self.arrays = StepArrays.of({name: np.zeros(shape, kind) for name, (kind, shape) in layout})
        self._placement = StepPlacement(world, 1, nodes, is_here=False)
        self.zones = self._homes = parts_of(self._placement.plans, count)[0].zones
        self._living = living_of(self.zones)
        self._generation = 0
        self._teller = 0
        self._cut = ZoneCut(told_zones(world.partition), Neighbours(()))
        self._state = PoolState(1, self.zones, 0, self._cut)  # that all nodes can go back to
        self._opened: PoolState | None = None  # that they keep before the next command
        self._next_state = 2
        self._keep_again_s = -math.inf  # by the clock of `_links`
        self._log: list[NodeCommand] = []  # since that state
        self._lost: list[int] = []
        self._is_torn = False
        self.losses = self.recoveries = self.replacements = self.redirected = 0
        self._timeout_s, self._pid = config.workers.timeout_s, os.getpid()
        self._ticks_per_step = config.clock.ticks_per_step
        self._links = Links(_nothing, system)
        self._watch = NodeWatch(self._links, lambda: self._starter.stopped())
        self._nodes: dict[int, Newcomer] = {}  # what is known of each that lives
        self._new: dict[int, tuple[str, int]] = {}  # where the others can call those of them
        runs = prepare_runs(config.zones, num_worlds)
        self._lease_ticks = lease_ticks(config)
        self._coordinator = NodeCoordinator(
            [run.run for run in runs],
            nodes_of(self.zones),
            limits_of(config.zones),
            self._links,
            [None if run.journal is None else Journal(run.journal, anew=True) for run in runs],
            config.zones.check_invariants,
        )
        self._links.urgent = self._hear
        self._runs = [run.run.hex() for run in runs]
        if not compiled_before():
            LocalWorlds(unwatched(world), 1, warm=True)
        job = {
            "recipe": recipe_of(world, base_dir),
            "num_worlds": num_worlds,
            "in_next_step": in_next_step,
            "lease_ticks": self._lease_ticks,
        }
        files = files_of(config, base_dir)
        self._starter, listener = start(hosts, nodes, config.workers, base_dir, route)
        self._newcomers = Newcomers(listener, job, files, self._room, count, system)
        try:
            self._begin(nodes)
        except BaseException:
            self.close()
            raise

    def _begin(self, nodes: int) -> None:
        """Wait until so many nodes have joined, and give them their zones, again if one is lost."""
        join_timeout_s = self.world.config.workers.join_timeout_s
        self._owner = np.full(self.arrays.mask.size, UNOWNED, dtype=np.int32)
        hostings: list[list[Hosting]] = []
        while self._new or len(self._nodes) < nodes:
            try:
                missing = nodes - len(self._nodes)
                self._newcomers.await_ready(missing, join_timeout_s, self._trouble)
                self._seat()
                neighbours = self._nodes[0].neighbours
                assert neighbours is not None
                self._cut = self._cut._replace(neighbours=neighbours)
                self._state = self._state._replace(cut=self._cut)
                hostings = hostings or self._coordinator.host(neighbours)
                self._tell_zones(hostings, ZoneMoves(self.zones, {}, []), begins=True)
                self._commit()
                self._new.clear()
            except LinkLostError as lost:
                self._lose(lost, has_begun=False)
                self._generation += 1  # what nodes say of this attempt counts no more
        self._is_torn = False

    def _trouble(self) -> str | None:
        """Why nodes that are awaited do not come. Raises LinkLostError: one that had is lost."""
        self._links.pump(0.0)
        return self._starter.trouble()

    @property
    def pids(self) -> list[int]:
        return [self._nodes[number].pid for number in sorted(self._nodes)]

    def _room(self) -> int:
        return len(self._homes) - len(self._nodes) + SPARES

    def _seat(self) -> None:
        """Let those that are ready host the zones that a lost node had at the beginning."""
        empty = [n for n in range(len(self._homes)) if n not in self._nodes]
        for ready in list(self._newcomers.ready)[: len(empty)]:
            newcomer, connection = self._newcomers.take(ready)
            number = newcomer.asked if newcomer.asked in empty else empty[0]
            empty.remove(number)
            assert newcomer.place is not None
            self._links.add(number, connection)
            self._nodes[number], self._new[number] = newcomer, self._route(newcomer.place)
            if number in self._lost:
                self._lost.remove(number)

    def _take(self, kind: FrameKind) -> dict[int, NodeFrame]:
        """The next frame of all living nodes, by rising numbers.

        Raises:
            LinkLostError: a node is lost.
        """
        found: dict[int, NodeFrame] = {}
        while missing := [n for n in self._living if n not in found] if found else self._living:
            wait = partial(self._links.take, missing)
            for number, frame in self._watch.wait(self._living, self._timeout_s, wait).items():
                if frame.number == self._generation:
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
        if self.world.config.traffic.source != "native":
            return False
        self._newcomers.look(0.0)
        is_fresh = self._state.zones == self.zones and not self._is_torn
        if not (self._newcomers.ready and is_fresh and len(self._nodes) < len(self._homes)):
            return False
        before = len(self._nodes)
        self._seat()
        self.replacements += len(self._nodes) - before
        self._is_torn, self._opened = True, None
        return True

    def _begin_state(self) -> None:
        """Let all nodes keep what they have before the next command."""
        switched = self._coordinator.switched
        self._opened = PoolState(self._next_state, self.zones, switched, self._cut)
        self._next_state += 1

    def _perform(self, command: NodeCommand) -> dict[int, memoryview]:
        """Do a command once; what each node has found. Raises LinkLostError: one is lost."""
        kept = self._opened.number if self._opened and self._log and command is self._log[-1] else 0
        self._performed = command
        leases = leases_of(command.ticks, self._lease_ticks)
        lease = self._begin_lease() if leases else {}
        for number in self._living:
            pieces = command.of_node(number, self._owner, lease.get(number, b""))
            self._links.send(number, FrameKind.COMMAND, kept, pieces)
        if not command.changes:
            return {n: frame.data for n, frame in self._take(FrameKind.RESULT).items()}
        results = self._commit()
        for _ in range(1, leases):
            self._coordinator.lease(self._begin_lease(), self._ticks_per_step)
            results = self._commit()
        if command.cut is not None:
            count = self.world.partition.count
            with reading(self._teller):
                near = read_neighbours(read_json(results[self._teller], list), count)
            self._cut = ZoneCut(command.cut, near)
            self._coordinator.know(near)
        return results

    def _begin_lease(self) -> dict[int, bytes]:
        """What nodes are to be told before the next ticks."""
        decide = partial(self._watch.wait, self._living, self._timeout_s, self._coordinator.begin)
        lease = decide()
        while self._coordinator.is_late:
            self._coordinator.lease(lease, 0)
            self._commit()
            lease = decide()
        return lease

    def _hear(self, number: int, frame: NodeFrame) -> Exception | None:
        """Take an urgent frame.

        Returns:
            an error of a node, for the caller.
        """
        is_present = frame.number == self._generation
        match frame.kind:
            case FrameKind.MISSED:
                peer = int.from_bytes(frame.data, "little")
                if is_present and peer in self._nodes:
                    self._watch.hear_missed(number, peer)
            case FrameKind.FAILED:
                name, text, trace = map(str, said_by(frame))
                part = name_of(self._homes[number])
                failure = WorkerFailureError(number, part, name, text, trace)
                found = own_error(failure)
                found.__cause__ = None if found is failure else failure
                return found
            case FrameKind.PONG:
                self._watch.hear_pong(number, frame)
            case FrameKind.NOT_MINE:
                if is_present:
                    self._send_on(frame)
            case FrameKind.MESSAGES:
                self._coordinator.hear(number, frame)
            case _:
                raise MessageError(f"a node sends no frame of kind {frame.kind.name}")
        return None

    def _send_on(self, frame: NodeFrame) -> None:
        """Send actions that a node refuses to the owners that it names.

        Raises:
            MessageError: there are no such agents, or owners.
        """
        found = read_refusal(frame.data, self._owner.size, set(self._living))
        if self._performed is None or (actions := self._performed.actions) is None:
            raise MessageError("actions are refused where there are none")
        for owner in np.unique(found[1]).tolist():
            agents = found[0, found[1] == owner]
            self._owner[agents] = owner
            self.redirected += len(agents)
            self._links.send(owner, FrameKind.ACTIONS, self._generation, [actions.some(agents)])

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
            self._starter.replace(node.asked, is_silent)
        elif why := self._starter.retry(node.asked, node.pid, is_silent):
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
        moves = moves_of(state.zones, self._homes, self._lost, self._nodes, state.number)
        self.zones, self._living = moves.zones, living_of(moves.zones)
        self._owner[~np.isin(self._owner, self._living)] = UNOWNED  # of lost ones any may be
        self._generation += 1
        self._cut = state.cut
        self._coordinator.know(state.cut.neighbours)
        hostings = self._coordinator.recover(nodes_of(self.zones), state.switched)
        self._tell_zones(hostings, moves, begins=False)
        self._commit()
        self._new.clear()
        self._is_torn = False
        self._keep_again_s = -math.inf
        self.recoveries += bool(moves.heirs)

    def _tell_zones(
        self,
        hostings: Sequence[Sequence[Hosting]],
        moves: ZoneMoves,
        begins: bool,
    ) -> None:
        """Let the nodes host their zones from now on."""
        told = {
            "begins": begins,
            "lost": self._lost,
            "heirs": list(moves.heirs.items()),
            "donors": moves.donors,
            "places": list(self._new.items()),
            "zones": moves.zones,
            "partition": self._cut.partition,
            "first": self._first_teller(),
            "state": self._state.number,
            "runs": self._runs,
            "hostings": told_hostings(hostings),
        }
        for number in self._living:
            data = json.dumps({**told, "number": number}).encode()
            self._links.send(number, FrameKind.RECOVER, self._generation, [data])

    def _first_teller(self) -> int:
        """The node that tells what all know alike: one that has been there in the last step."""
        old = [number for number in self._living if number not in self._new]
        self._teller = self._teller if self._teller in old else (old or self._living)[0]
        return self._teller

    def _commit(self) -> dict[int, memoryview]:
        """Wait for the nodes to be through with a tick.

        Returns:
            what else they have sent with it, first of all the one that tells what all know alike.

        Raises:
            LinkLostError: one is lost, or has sent what cannot be.
        """
        told, results = {}, {}
        frames = self._take(FrameKind.REPORT)
        for number in sorted(frames, key=self._teller.__ne__):  # else by rising numbers
            with reading(number):
                messages, said, more = read_report(frames[number].data, len(self._runs))
                self._coordinator.check(number, messages, said)
            told[number] = messages, said
            results[number] = more
        self._coordinator.commit(told)
        return results

    def close(self) -> None:
        """End the nodes; a fork of the pool's process has no right to."""
        if is_fork(self._pid):
            return
        self._links.end(END_S)
        self._newcomers.close()
        self._coordinator.close()
        self._starter.close()


def _nothing(number: int, frame: NodeFrame) -> Exception | None:
    """Before a tick there are no messages."""
    return None
