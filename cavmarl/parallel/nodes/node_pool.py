"""`NodePool`: the processes of nodes, what they are told, and what is done when some are lost."""

from __future__ import annotations

import json
import logging
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cavmarl.core.errors import WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.core.processes import start_dying_with_process
from cavmarl.engine.compilation import compiled_before
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import prepare_runs
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.reactions import Hosting
from cavmarl.parallel.commanded_worlds import own_error
from cavmarl.parallel.hosts.listener import Listener
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.nodes.links import (
    FrameKind,
    LinkLostError,
    Links,
    NodeFrame,
    SilenceError,
)
from cavmarl.parallel.nodes.meeting import calls_of
from cavmarl.parallel.nodes.node_coordinator import NodeCoordinator
from cavmarl.parallel.nodes.zone_hosts import read_report
from cavmarl.parallel.recipe import recipe_of
from cavmarl.parallel.step_arrays import StepArrays, layout_of
from cavmarl.parallel.step_placement import StepPlacement
from cavmarl.parallel.work_shares import parts_of

log = logging.getLogger("cavmarl.nodes")

NODE = "cavmarl.parallel.nodes.node_process"  # the program of a node
ADDRESS = "127.0.0.1"  # where nodes of this machine meet
PONG_S = 1.0  # for a living node to answer
KEEP_S = 0.2  # so much of work may have to be done again
START_S = 120.0  # for nodes to load their world; compiling takes longest


class NodeCommand(NamedTuple):
    """What all nodes are to do."""

    pieces: list[bytes]  # of its frame
    changes: bool  # what the worlds are
    ticks: int  # of the worlds


class _State(NamedTuple):
    """What nodes have kept before a command."""

    number: int
    zones: list[list[int]]  # that each node hosted
    switched: int  # vehicles that had changed their owner


class NodePool:
    """The nodes of W worlds, the same zones of each at each node, and what they are to do.

    Attributes:
        zones: that each node hosts.
        processes: of the nodes.
        recoveries: how often the worlds have gone back because nodes were lost.

    Raises:
        ConfigError: a setting that such worlds cannot have, or more nodes than zones.
        WorkerError: a node cannot be started.
    """

    def __init__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from
        num_worlds: int,  # W
        nodes: int,  # n, from 1 to the zones of a world
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
    ) -> None:
        self.world = world
        self.in_next_step = in_next_step
        config, count = world.config, world.partition.count
        layout = layout_of(config, world.capacity, num_worlds).items()
        self.arrays = StepArrays.of({name: np.zeros(shape, kind) for name, (kind, shape) in layout})
        self._placement = StepPlacement(world, 1, nodes)
        self.zones = parts_of(self._placement.plans, count)[0].zones
        self._first_zones = self.zones
        self._generation = 0
        self._state = _State(1, self.zones, 0)  # that all nodes can go back to
        self._opened: _State | None = self._state  # that they keep before the next command
        self._next_state = 2
        self._keep_again_s = math.inf  # by `time.monotonic`; the first command keeps a state
        self._log: list[NodeCommand] = []  # since that state
        self._lost: list[int] = []
        self._is_torn = False
        self.recoveries = 0
        self._timeout_s = config.workers.timeout_s
        self._answered: set[int] = set()  # nodes that answered the last PING
        self._pings = 0
        self._ticks_per_step = config.clock.ticks_per_step
        self._links = Links(_nothing)
        self.processes: list[subprocess.Popen[Any]] = []
        runs = prepare_runs(config.zones, num_worlds)
        journals = [None if r.journal is None else Journal(r.journal, anew=True) for r in runs]
        self._coordinator = NodeCoordinator(
            [run.run for run in runs],
            self._node_of(),
            limits_of(config.zones),
            self._links,
            journals,
        )
        self._links.urgent = self._hear
        hostings = self._coordinator.host()
        self._runs = [run.run.hex() for run in runs]
        job = {
            "recipe": recipe_of(world, base_dir),
            "num_worlds": num_worlds,
            "in_next_step": in_next_step,
            "zones": self.zones,
            "address": ADDRESS,
            "runs": self._runs,
            "hostings": _told(hostings),
        }
        if not compiled_before():
            LocalWorlds(unwatched(world), 1, warm=True)
        try:
            self._start(nodes, json.dumps(job).encode())
        except (LinkLostError, SilenceError) as error:
            self.close()
            raise WorkerError(f"{error} before it had begun; see standard error") from error
        except BaseException:
            self.close()
            raise

    def _start(self, nodes: int, job: bytes) -> None:
        listener = Listener(ADDRESS)
        words = [sys.executable, "-m", NODE]
        try:
            for number in range(nodes):
                process = start_dying_with_process(
                    [*words, *map(str, (*listener.place, number))], stdin=subprocess.PIPE, text=True
                )
                self.processes.append(process)
                assert process.stdin is not None
                with process.stdin as told:
                    told.write(f"{listener.secret.hex()}\n")
            calls = calls_of(listener, range(nodes), START_S, self._look_after)
        finally:
            listener.close()
        for number, connection in sorted(calls.items()):
            self._links.add(number, connection)
            self._links.send(number, FrameKind.JOB, 0, [job])
        places = self._take(FrameKind.READY, START_S)
        told_places = json.dumps([json.loads(bytes(f.data)) for f in places.values()]).encode()
        for number in places:
            self._links.send(number, FrameKind.PEERS, 0, [told_places])

    def _look_after(self) -> None:
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                raise WorkerError(
                    f"node {number} ended with {process.returncode} before it had begun; what it "
                    "printed stands on standard error"
                )

    def _take(self, kind: FrameKind, timeout_s: float | None = None) -> dict[int, NodeFrame]:
        """The next frame of all living nodes, by rising numbers; an error of one is raised here.

        Raises:
            LinkLostError: a node is lost.
        """
        found: dict[int, NodeFrame] = {}
        while missing := [number for number in self._living if number not in found]:
            for number, frame in self._links.take(missing, timeout_s or self._timeout_s).items():
                if frame.kind is FrameKind.FAILED:
                    name, text, trace = json.loads(bytes(frame.data))
                    failure = WorkerFailureError(number, self._name(number), name, text, trace)
                    raise own_error(failure) from failure
                if frame.number == self._generation:
                    found[number] = frame
        for number, frame in found.items():
            if frame.kind is not kind:
                raise WorkerError(f"node {number} sent {frame.kind.name}, not {kind.name}")
        return dict(sorted(found.items()))

    @property
    def _living(self) -> list[int]:
        return [number for number, zones in enumerate(self.zones) if zones]

    def _name(self, number: int) -> str:
        return f"zones {', '.join(map(str, self._first_zones[number]))}"

    # Commands, and what becomes of them when nodes are lost

    def run(self, command: NodeCommand) -> list[memoryview]:
        """Let all nodes do a command; what each has found, by rising numbers.

        Raises:
            WorkerDeathError: nodes are lost whose zones nobody has kept, or too many for one step.
        """
        if command.changes and time.monotonic() > self._keep_again_s:
            self._begin_state()
        if command.changes:
            self._log.append(command)
        try:
            results = self._insist(command)
        except BaseException:  # it is as if the command had never been given
            self._is_torn, self._opened = True, None
            if command.changes:
                self._log.pop()
            raise
        if command.changes and self._opened is not None:
            self._state, self._opened = self._opened, None
            self._log = self._log[-1:]
            self._keep_again_s = time.monotonic() + KEEP_S
        return results

    def _insist(self, command: NodeCommand) -> list[memoryview]:
        """Do a command again and again, until no node is lost meanwhile."""
        while True:
            try:
                if self._is_torn:
                    self._recover()
                    for one in self._log[: -1 if command.changes else None]:
                        self._perform(one)
                return self._perform(command)
            except LinkLostError as lost:
                self._lose(lost.peer)
            except SilenceError as silence:
                self._lose(self._silent(silence))

    def _begin_state(self) -> None:
        """Let all nodes keep what they have before the next command."""
        self._opened = _State(self._next_state, self.zones, self._coordinator.switched)
        self._next_state += 1

    def _perform(self, command: NodeCommand) -> list[memoryview]:
        """Do a command once. Raises LinkLostError: a node is lost."""
        kept = self._opened.number if self._opened and self._log and command is self._log[-1] else 0
        for number in self._living:
            self._links.send(number, FrameKind.COMMAND, kept, command.pieces)
        if not command.changes:
            return [frame.data for frame in self._take(FrameKind.RESULT).values()]
        results: list[memoryview] = []
        for _ in range(command.ticks):
            self._coordinator.begin(self._timeout_s)
            results = self._commit()
        return results if command.ticks else self._commit()

    def _hear(self, number: int, frame: NodeFrame) -> None:
        """Take an urgent frame."""
        if frame.kind is not FrameKind.PONG:
            self._coordinator.hear(number, frame)
        elif frame.number == self._pings:
            self._answered.add(number)

    def _silent(self, silence: SilenceError) -> int:
        """A node that answers nothing: it has stopped.

        Raises:
            WorkerError: all answer, and yet nothing comes of the command.
        """
        self._pings += 1
        self._answered.clear()
        until_s = time.monotonic() + PONG_S
        try:
            for number in self._living:
                self._links.send(number, FrameKind.PING, self._pings)
            while time.monotonic() < until_s and len(self._answered) < len(self._living):
                self._links.pump(1e3 * PONG_S)
        except LinkLostError as lost:
            return lost.peer
        mute = [number for number in self._living if number not in self._answered]
        if not mute:
            raise WorkerError(f"{silence}, though they live") from silence
        return mute[0]

    def _lose(self, number: int) -> None:
        """A node is gone: nothing of it counts any more."""
        self._is_torn = True
        self._links.drop(number)
        self._lost.append(number)
        self.processes[number].kill()
        log.warning("node %d (%s) is lost", number, self._name(number))

    def _recover(self) -> None:
        """Let the living nodes host the zones of the lost ones, as of the newest state they have.

        Raises:
            LinkLostError: another one is lost.
            WorkerDeathError: what a lost one had is kept nowhere.
        """
        state = self._state
        self._opened = None
        ring = [number for number, zones in enumerate(state.zones) if zones]
        heirs: dict[int, int] = {}
        for number in (n for n in ring if n in self._lost):
            heir = ring[(ring.index(number) + 1) % len(ring)]
            if heir in self._lost:
                both = f"{self._name(number)}; {self._name(heir)}"
                causes = [f"node {n} was lost" for n in self._lost]
                raise WorkerDeathError(number, both, state.number, "step", causes)
            heirs[number] = heir
        zones = [list(some) for some in state.zones]
        for number, heir in heirs.items():
            zones[heir] += zones[number]
            zones[number] = []
        self.zones = [sorted(some) for some in zones]
        self._generation += 1
        hostings = self._coordinator.recover(self._node_of(), state.switched)
        told = {
            "lost": self._lost,
            "heirs": list(heirs.items()),
            "zones": self.zones,
            "state": state.number,
            "runs": self._runs,
            "hostings": _told(hostings),
        }
        for number in self._living:
            data = json.dumps(told).encode()
            self._links.send(number, FrameKind.RECOVER, self._generation, [data])
        self._commit()
        self._is_torn = False
        self._keep_again_s = 0.0
        self.recoveries += bool(heirs)

    def _commit(self) -> list[memoryview]:
        """Wait for the nodes to be through with a tick; what else they have sent with it."""
        read = {n: read_report(frame.data) for n, frame in self._take(FrameKind.REPORT).items()}
        self._coordinator.commit({n: (messages, said) for n, (messages, said, _) in read.items()})
        return [more for _, _, more in read.values()]

    def _node_of(self) -> list[int]:
        found = [0] * self.world.partition.count
        for node, some in enumerate(self.zones):
            for zone in some:
                found[zone] = node
        return found

    def close(self) -> None:
        """End the nodes."""
        self._links.close()
        self._coordinator.close()
        for process in self.processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(5.0)
            process.kill()
            process.wait()
        self.processes = []


def _told(hostings: Sequence[Sequence[Hosting]]) -> list[list[list[int]]]:
    """What hosts have to know, as JSON does."""
    return [[[h.episode, h.tick, h.zone, h.incarnation] for h in some] for some in hostings]


def _nothing(number: int, frame: NodeFrame) -> None:
    """Before a tick there are no messages."""
