"""The process of a node: it hosts some zones of W worlds, and runs the ticks beside the others.

python -m cavmarl.parallel.nodes.node_process HOST PORT NUMBER    # the secret on standard input
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import numpy as np

from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.ownership.reactions import Hosting
from cavmarl.parallel.hosts.listener import Listener, call
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.nodes.kept_states import KeptStates
from cavmarl.parallel.nodes.links import (
    Bytes,
    FrameKind,
    LinkLostError,
    Links,
    NodeFrame,
    RecoveryOrderedError,
)
from cavmarl.parallel.nodes.meeting import calls_of
from cavmarl.parallel.nodes.node_frames import cases_of, command_of, results_of, told_cases
from cavmarl.parallel.nodes.node_peers import NodePeers
from cavmarl.parallel.nodes.zone_hosts import ZoneHosts
from cavmarl.parallel.recipe import CHANGED, world_of
from cavmarl.parallel.worlds_job import Task, commands_of
from cavmarl.shards.executor import SerialExecutor
from cavmarl.shards.shard import Shard

MEETING_S = 60.0  # for the other nodes to call


class NodeExecutor:
    """Runs phases on the shards of this node; the other shards' rows stay on the same side."""

    def __init__(self, own: Sequence[Shard], foreign: Sequence[Shard]) -> None:
        self._executor = SerialExecutor(own)
        self._first, self._foreign = own[0], foreign

    def each(self, phase: str, *arguments: Any) -> None:
        self._executor.each(phase, *arguments)
        if phase in ("advance", "commit"):
            for shard in self._foreign:
                shard.face(self._first.side, self._first.next_side)


class NodeProgram:
    """One node."""

    def __init__(self, links: Links, number: int, secret: bytes) -> None:
        self._links = links
        self._number = number
        self._secret = secret

    def join(self) -> None:
        """Load the world and meet the other nodes."""
        links = self._links
        job = json.loads(bytes(links.take([COORDINATOR])[COORDINATOR].data))
        world = unwatched(world_of(job["recipe"], CHANGED))
        num_worlds, zones = job["num_worlds"], job["zones"]
        self._worlds = worlds = LocalWorlds(
            world, num_worlds, warm=True, in_next_step=job["in_next_step"]
        )
        self._commands = commands_of(worlds.arrays)
        worlds.keep_logs()
        listener = Listener(job["address"], self._secret)
        links.send(COORDINATOR, FrameKind.READY, 0, [json.dumps(listener.place).encode()])
        places = json.loads(bytes(links.take([COORDINATOR])[COORDINATOR].data))
        for other in range(self._number):
            place = (str(places[other][0]), int(places[other][1]))
            links.add(other, call(place, self._secret, self._number))
        later = range(self._number + 1, len(places))
        for other, connection in sorted(calls_of(listener, later, MEETING_S).items()):
            links.add(other, connection)
        listener.close()
        self._kept = KeptStates(worlds, links, self._number)
        links.urgent = self._hear
        self._share(zones, job["runs"], job["hostings"], 0)
        self._peers.keep_own(worlds.simulation.everywhere)

    def _share(self, zones: Any, runs: Any, hostings: Any, generation: int) -> None:
        """Host the zones that are this node's from now on."""
        simulation, mine = self._worlds.simulation, zones[self._number]
        self._living = [node for node, some in enumerate(zones) if some]
        self._generation = generation
        node_of = [0] * simulation.partition.count
        for node, some in enumerate(zones):
            for zone in some:
                node_of[zone] = node
        told = [
            [_hosting(bytes.fromhex(run), some[zone]) for zone in mine]
            for run, some in zip(runs, hostings, strict=True)
        ]
        self._peers = NodePeers(simulation, self._links, zones, self._number, generation << 32)
        limits = limits_of(simulation.config.zones, simulation.division.codec.schema)
        mounted = simulation.mounted
        carried = [] if mounted is None else [*mounted.arrays()]
        self._hosts = ZoneHosts(
            simulation.division, mine, node_of, told, limits, self._links, carried, generation
        )
        shards = simulation.shards
        own = [shards[zone] for zone in mine]
        foreign = [shard for shard in shards if shard.zone not in mine]
        simulation.share(self._peers, self._hosts, NodeExecutor(own, foreign))

    def _hear(self, number: int, frame: NodeFrame) -> None:
        """Take an urgent frame."""
        if frame.kind is FrameKind.KEEP:
            self._kept.take(number, frame)
        elif frame.kind is FrameKind.AGENT:
            self._hosts.keep_agent(frame)
        elif frame.kind is FrameKind.PING:
            self._links.send(COORDINATOR, FrameKind.PONG, frame.number)
        else:
            self._hosts.hear(number, frame)

    def serve(self) -> None:
        """Do what the coordinator asks for, until it asks for no more."""
        while True:
            try:
                frame = self._links.take([COORDINATOR])[COORDINATOR]
                if frame.kind is FrameKind.RECOVER:
                    self._recover(frame)
                else:
                    self._perform(frame)
            except RecoveryOrderedError as ordered:
                self._go_back(ordered.frame)
            except LinkLostError as lost:
                if lost.peer == COORDINATOR:
                    raise
                self._go_back(None)

    def _go_back(self, frame: NodeFrame | None) -> None:
        """Others are lost: wait for the coordinator to say where to go on."""
        while True:
            try:
                while frame is None or frame.kind is not FrameKind.RECOVER:
                    frame = self._links.take([COORDINATOR])[COORDINATOR]
                self._recover(frame)
                return
            except RecoveryOrderedError as ordered:
                frame = ordered.frame
            except LinkLostError as lost:
                if lost.peer == COORDINATOR:
                    raise
                frame = None

    def _recover(self, frame: NodeFrame) -> None:
        """Go back to a state that was kept, with the zones that the coordinator names."""
        links, told = self._links, json.loads(bytes(frame.data))
        for number in told["lost"]:
            links.drop(number)
        self._share(told["zones"], told["runs"], told["hostings"], frame.number)
        others = [node for node in self._living if node != self._number]
        for node in others:
            links.send(node, FrameKind.SYNC, frame.number)
        for node in others:
            while True:
                found = links.take([node])[node]
                if found.kind is FrameKind.SYNC and found.number == frame.number:
                    break
        adopted = [number for number, heir in told["heirs"] if heir == self._number]
        self._kept.load(told["state"], adopted, told["zones"][self._number][0])
        self._hosts.report()

    def _perform(self, frame: NodeFrame) -> None:
        worlds, peers = self._worlds, self._peers
        task, letter = command_of(frame.data, worlds.arrays)
        if frame.number:
            self._kept.keep(frame.number, self._living)
        match task:
            case Task.STEP:
                peers.begin_step()
                worlds.step(self._commands)
                self._hosts.report(self._results(worlds.simulation.everywhere, stepped=True))
            case Task.RESET:
                chosen = worlds.arrays.chosen.copy()
                worlds.reset(letter["seed"], letter["first_world"])
                self._hosts.report(self._results(chosen, stepped=False))
            case Task.LOAD if not letter["only_reads"]:
                worlds.load_worlds(cases_of(letter))
                self._hosts.report()
            case Task.SUGGEST:
                worlds.suggest()
                where = np.flatnonzero(peers.own.reshape(-1))
                found = worlds.arrays.suggested.reshape(-1, 2)[where]
                self._answer([where.data, found.reshape(-1).data])
            case _:
                self._look(task, letter)

    def _results(self, sensed: Any, stepped: bool) -> list[Bytes]:
        peers = self._peers
        own = peers.own & sensed[:, None]
        before = peers.stepped if stepped else np.zeros_like(own)
        return results_of(self._worlds.arrays, own, before, with_common=self._is_first)

    def _look(self, task: Task, letter: Any) -> None:
        """Answer what only the first node can, which has the whole world meanwhile."""
        worlds, answer = self._worlds, None
        with self._peers.whole(worlds.simulation):
            if self._is_first:
                answer = self._found(task, letter)
        self._answer([] if answer is None else answer)

    def _found(self, task: Task, letter: Any) -> list[Bytes]:
        worlds = self._worlds
        found: Any
        if task == Task.WRITE_STATES:
            worlds.write_states()
            return [worlds.arrays.states.reshape(-1).data]
        if task == Task.STATE_HASH:
            found = worlds.state_hash(letter)
        elif task == Task.SAVE:
            found = told_cases(worlds.save_worlds())
        elif task == Task.LOAD:
            found = _refusal(worlds, cases_of(letter))
        elif task == Task.TRAFFIC_STATS:
            found = worlds.traffic_stats(letter)
        elif task == Task.DRIVEN:
            found = worlds.driven(*letter)
        else:
            found = worlds.signal_phases(letter).tolist()
        return [json.dumps(found).encode()]

    @property
    def _is_first(self) -> bool:
        """Whether this node tells what all know alike."""
        return self._number == self._living[0]

    def _answer(self, pieces: Sequence[Bytes]) -> None:
        self._links.send(COORDINATOR, FrameKind.RESULT, self._generation, pieces)

    def close(self) -> None:
        self._links.flush()


def _ignore(number: int, frame: NodeFrame) -> None:
    """Before a node has joined, it hears no messages of the protocol."""


def main() -> int:
    host, port, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    secret = bytes.fromhex(sys.stdin.readline().strip())
    links = Links(_ignore)
    links.add(COORDINATOR, call((host, port), secret, number))
    node = NodeProgram(links, number, secret)
    try:
        node.join()
        node.serve()
    except LinkLostError as lost:
        return 0 if lost.peer == COORDINATOR else _wait_for_the_end(links)
    except Exception as error:
        said = [
            type(error).__name__,
            str(error),
            "" if isinstance(error, CavmarlError) else traceback.format_exc(),
        ]
        links.send(COORDINATOR, FrameKind.FAILED, 0, [json.dumps(said).encode()])
        links.flush()
        return _wait_for_the_end(links)
    return 0


def _refusal(worlds: LocalWorlds, cases: Sequence[bytes]) -> str:
    """Why worlds cannot go on from these; empty: they can."""
    try:
        worlds.read_worlds(cases)
    except ConfigError as error:
        return str(error)
    return ""


def _hosting(run: bytes, numbers: Sequence[int]) -> Hosting:
    episode, tick, zone, incarnation = numbers
    return Hosting(run, episode, tick, zone, incarnation, {})


def _wait_for_the_end(links: Links) -> int:
    """Another node has gone: the coordinator says what becomes of this one, or ends."""
    try:
        while True:
            links.pump(None)
    except LinkLostError:
        return 1


if __name__ == "__main__":
    sys.exit(main())
