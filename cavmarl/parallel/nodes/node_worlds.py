"""`NodeWorlds`: worlds whose zones are hosted by nodes, processes that share nothing."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import NO_GPU, LoadSnapshot, idle_snapshot
from cavmarl.balance.probe import MEASURED
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World
from cavmarl.handoff.repartitioning import Recut, is_due
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.commanded_worlds import uncopied
from cavmarl.parallel.mover import Mover
from cavmarl.parallel.nodes.agent_stream import ResultStream
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.node_actions import Actions, NodeCommand, ZoneRects
from cavmarl.parallel.nodes.node_cuts import read_zones
from cavmarl.parallel.nodes.node_frames import (
    pieces_of,
    saved_of,
    worlds_payload,
)
from cavmarl.parallel.nodes.node_loads import (
    TO_BALANCE,
    TO_SHOW,
    TOTALS,
    MachineAsked,
    NodeLoad,
    since,
)
from cavmarl.parallel.nodes.node_network import NetworkFailedError, answer_of, read_asked
from cavmarl.parallel.nodes.node_pool import Found, NodePool, Read
from cavmarl.parallel.nodes.node_starters import LocalNodes, Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.peer_faults import check_indices, read_json
from cavmarl.parallel.step_arrays import Driven
from cavmarl.parallel.worlds_job import Task
from cavmarl.shards.shard import Commands
from cavmarl.v2x.v2x_messages import NetworkSimulator, check_external
from cavmarl.zones.partition.zone_partition import ZonePartition


class NodeWorlds(NodePool):
    """W worlds over n nodes; a `SteppedWorlds`.

    Attributes:
        mover: has zones change their node by what they cost; None: they stay.
        recuts: when worlds have been cut anew.

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
        hosts: str = "",  # what starts the nodes; see `start_nodes`
        route: Route = straight,  # where nodes of this machine call in order to reach a place
        system: NodeSystem = MACHINE,  # that the nodes are on
        start: Start = start_nodes,  # starts them
    ) -> None:
        check_nodes(world, nodes)
        super().__init__(
            world, base_dir, num_worlds, nodes, in_next_step, hosts, route, system, start
        )
        count, every = world.partition.count, world.config.workers.balance_steps
        self._spent_s = np.zeros((1, count))
        self._ticks_done = self._ticks_told = 0
        self.recuts: list[Recut] = []
        self._everywhere = np.ones(num_worlds, dtype=np.bool_)
        self._results = ResultStream(self.arrays)
        self._steps = 0
        self._network: NetworkSimulator | None = None
        self._exchanged = 0  # answers of it that nodes have got in the present command
        self._told: dict[int, list[Any]] = {}  # what nodes have said of themselves last
        self.mover = Mover(self._placement, count, every, self._spent_s) if every else None
        if world.config.workers.monitor_cpu:
            self.node_snapshot(TO_BALANCE)  # from now on they watch

    def reset(self, seed: int | None, first_world: int) -> None:
        arrays = self.arrays
        command = self._command(Task.RESET, {"seed": seed, "first_world": first_world})
        self.run(command, partial(self._write, arrays.chosen, False))
        if not arrays.chosen.all():
            arrays.observations[~arrays.mask] = 0.0

    def step(self, commands: Commands) -> None:
        """Let the agents act, and reset the worlds whose episode is over, now or a step later."""
        arrays = self.arrays
        if commands.controls is not arrays.controls:
            arrays.controls[:] = commands.controls
            arrays.meta_actions[:] = commands.meta_actions
        self._cut_anew()
        if self.mover is not None:
            self.mover.before_step(self._move, self._seen)
        for told, array in (
            (commands.declared, arrays.declared),
            (commands.inserted, arrays.inserted),
        ):
            if array.size:
                array[:] = told if told.size else 0
        self.run(self._command(Task.STEP), partial(self._write, self._everywhere, True))
        self._ticks_done += self._ticks_per_step

    def _cut_anew(self) -> None:
        """Every so many steps cut the zones by their vehicles; see `zones.repartition_steps`."""
        self._steps += 1
        if not is_due(self._steps, self.world.config.zones.repartition_steps):
            return
        if proposal := self._asked(Task.PROPOSE, None, self._read_proposal):
            zones, figures = proposal
            self.run(self._command(Task.CUT, zones), _unread)
            self.recuts.append(Recut(self._steps - 1, *figures))

    def _read_proposal(self, said: Any) -> tuple[ZoneRects, list[Any]] | None:
        if said is None:
            return None
        zones, *figures = said
        if read_zones(zones).count != self.world.partition.count or len(figures) != 4:
            raise MessageError(f"it proposes {said!r}")
        return zones, figures

    def connect_network(self, network: NetworkSimulator) -> None:
        """From now on let a network simulator of this process decide receptions.

        Raises:
            ConfigError: the channel is one of our own.
        """
        check_external(self.world.config.v2x)
        self._network = network

    def run(self, command: NodeCommand, read: Read[Found]) -> list[Found]:
        try:
            return super().run(command, read)
        except NetworkFailedError as failed:
            raise failed.error from None

    def _perform(self, command: NodeCommand) -> dict[int, memoryview]:
        self._exchanged = 0
        return super()._perform(command)

    def _hear(self, number: int, frame: NodeFrame) -> Exception | None:
        if frame.kind is not FrameKind.EXCHANGE:
            return super()._hear(number, frame)
        if frame.number == self._generation:
            self._exchange(frame)
        return None

    def _exchange(self, frame: NodeFrame) -> None:
        """Tell all nodes what stations receive; of a step that is done again, what they did."""
        known = None if self._performed is None else self._performed.receptions
        if known is None:
            raise MessageError("messages are sent where no step is taken")
        if self._exchanged == len(known):
            latency = self.world.config.v2x.channel.latency_ticks
            asked = read_asked(frame.data, len(self.arrays.mask), latency)
            known.append(answer_of(self._network, asked))
        for node in self._living:
            answer = known[self._exchanged]
            self._links.send(node, FrameKind.RECEPTIONS, self._generation, [answer])
        self._exchanged += 1

    def _seen(self) -> LoadSnapshot:
        """Ask what zones have cost, before they are balanced by it; how busy all nodes are.

        Those that are not watched, or lost, are taken to be idle.
        """
        for spent in self.run(self._command(Task.HOST), self._read_spent):
            for zone, spent_s in spent:
                self._spent_s[0, zone] += spent_s
        idle = idle_snapshot(len(self._homes))
        if not self.world.config.workers.monitor_cpu:
            return idle
        seen = self.node_snapshot(TO_BALANCE)
        states = {one.worker: one for one in (*idle.workers, *seen.workers)}
        return replace(seen, workers=tuple(states[node] for node in sorted(states)))

    def _read_spent(self, number: int, data: memoryview) -> list[tuple[int, float]]:
        found = [(zone, float(spent_s)) for zone, spent_s in read_json(data, list)]
        check_indices("zone", (zone for zone, _ in found), self._spent_s.shape[1])
        return found

    def _move(self, task: Task, zones: list[Any], commits: bool) -> None:
        """Let zones have other homes from now on."""
        before, self._homes = self._homes, zones[0]
        self._is_torn, self._opened = True, None
        try:
            self._insist(None, _unread)
        except BaseException:
            self._homes = before
            raise

    def _command(self, task: Task, payload: Any = None) -> NodeCommand:
        loads = task == Task.LOAD and not payload["only_reads"]
        changes = loads or task in (Task.STEP, Task.RESET, Task.CUT)
        pieces = pieces_of(task, payload, self.arrays)
        if task != Task.STEP:
            return NodeCommand(pieces, changes, 0, cut=payload if task == Task.CUT else None)
        actions = Actions.of(self.arrays)
        return NodeCommand(pieces, changes, self._ticks_per_step, actions, receptions=[])

    def _write(
        self, chosen: NDArray[np.bool_], of_step: bool, number: int, data: memoryview
    ) -> None:
        tells = number == self._teller
        self._results.take(data, chosen, of_step, tells, number, self._owner)

    def suggest(self) -> None:
        """Write what the built-in driver would do in the agents' place."""
        suggested = self.arrays.suggested
        suggested[...] = 0.0
        for where, found in self.run(self._command(Task.SUGGEST), self._read_suggested):
            suggested.reshape(-1, 2)[where] = found

    def _read_suggested(self, number: int, data: memoryview) -> tuple[NDArray[Any], NDArray[Any]]:
        suggested = self.arrays.suggested
        num, rest = divmod(len(data), 8 + suggested.itemsize * 2)
        where = np.frombuffer(data, np.int64, num)
        check_indices("agent", where, suggested.size // 2)
        if rest:
            raise MessageError(f"{len(data)} bytes tell of no suggestions")
        return where, np.frombuffer(data, suggested.dtype, 2 * num, 8 * num).reshape(-1, 2)

    def node_loads(self) -> list[NodeLoad]:
        """What each node has done since this was asked last, by rising numbers.

        After a node was lost its successor's time is that since it began.
        """
        found = []
        ticks, self._ticks_told = self._ticks_done - self._ticks_told, self._ticks_done
        for node, now in self.run(self._command(Task.LOADS), _read_totals):
            before = self._told.get(node)
            is_same = before is not None and before[0] <= now[0]
            found.append(since(node, ticks, now, before if is_same else None))
            self._told[node] = now
        return sorted(found)

    def node_snapshot(self, purpose: str = TO_SHOW) -> LoadSnapshot:
        """How busy others keep the machine of each node, as it says, since it was asked last.

        Other purposes have times of their own. What this run itself computes there does not count.
        """
        here: dict[str, list[int]] = {socket.gethostname(): [os.getpid()]}
        for node in self._nodes.values():
            here.setdefault(node.machine, []).append(node.pid)
        asked = self._command(Task.LOADS, MachineAsked(purpose, here))
        found = self.run(asked, _read_watched)
        states = tuple(candidate for candidate, _ in found)
        source = next((source for _, source in found if source != NO_GPU), NO_GPU)
        return LoadSnapshot(states, source, MEASURED)

    def _asked(self, task: Task, payload: Any, read: Callable[[Any], Found]) -> Found:
        """What the first node answers; the others have nothing to say."""
        first = self._first_answer(lambda data: read(json.loads(bytes(data))))
        found: Found = self.run(self._command(task, payload), first)[0]
        return found

    def _first_answer(self, read: Callable[[memoryview], Found]) -> Read[Any]:
        return lambda number, data: read(data) if number == self._living[0] else None

    def write_states(self) -> None:
        states = self.arrays.states

        def read(data: memoryview) -> None:
            states[...] = np.frombuffer(data, states.dtype).reshape(states.shape)

        self.run(self._command(Task.WRITE_STATES), self._first_answer(read))

    def ticks(self) -> NDArray[np.int64]:
        return self.arrays.ticks.copy()

    def state_hash(self, world: int) -> str:
        return self._asked(Task.STATE_HASH, self._number(world), str)

    def traffic_stats(self, world: int) -> dict[str, float]:
        return self._asked(Task.TRAFFIC_STATS, self._number(world), dict)

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]:
        asked = [self._number(world), list(map(int, agents))]
        return self._asked(Task.DRIVEN, asked, lambda said: [Driven(*row) for row in said])

    def signal_phases(self, world: int) -> NDArray[np.int32]:
        asked = self._number(world)
        return self._asked(Task.SIGNAL_PHASES, asked, lambda said: np.array(said, dtype=np.int32))

    def _number(self, world: int) -> int:
        return range(len(self.arrays.mask))[world]

    def save_worlds(self) -> list[bytes]:
        return self._asked(Task.SAVE, None, saved_of)

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Go on from what `save_worlds` gave; `arrays` stay as they are.

        Raises:
            ConfigError: it is of other worlds.
        """
        payload = worlds_payload(saved, only_reads=True)
        if refusal := self._asked(Task.LOAD, payload, lambda said: said and str(said)):
            raise ConfigError(refusal)
        self.run(self._command(Task.LOAD, worlds_payload(saved)), _unread)

    @property
    def partition(self) -> ZonePartition:
        """The zones as they are now; a cut gives the worlds others."""
        return read_zones(self._cut.partition)

    @property
    def simulation(self) -> Simulation:
        """Refused: the worlds live elsewhere."""
        raise ConfigError("the worlds live in nodes: use workers=0 to look into them")

    @property
    def plans(self) -> tuple[Plan, ...]:
        return self._placement.plans

    @property
    def worker_pids(self) -> dict[int, int]:
        """Those of nodes of this machine; others measure their machines, see `node_snapshot`."""
        is_here = isinstance(self._starter, LocalNodes)
        return dict(enumerate(self.pids)) if is_here else {}

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """What became of each change of owner, by worlds."""
        return self._coordinator.transfers

    def in_flight(self, world: int) -> Sequence[TransferInFlight]:
        """Vehicles of one world whose next zone holds their state already."""
        return self._coordinator.in_flight(world)

    @property
    def migrations(self) -> int:
        """How many vehicles have changed their owner since the worlds were made."""
        return self._coordinator.switched

    def __reduce__(self) -> tuple[Any, ...]:
        raise uncopied()


def _unread(number: int, data: memoryview) -> None:
    """What a node has found is of no use."""


def _read_totals(number: int, data: memoryview) -> tuple[int, list[Any]]:
    """What a node has done; see `node_loads.totals`."""
    said = read_json(data, list)
    if len(said) != 1 + TOTALS or said[0] != number:
        raise MessageError(f"it tells {said!r} of its load")
    return number, list(map(float, said[1:5])) + list(map(int, said[5:]))


def _read_watched(number: int, data: memoryview) -> tuple[Candidate, str]:
    """How busy the machine of a node is, and the source of that."""
    _, shares, source = read_json(data, list)
    return Candidate(number, Utilisation(*shares)), str(source)


def check_nodes(world: World, nodes: int) -> None:
    """Refuse what worlds over nodes cannot have."""
    config, count = world.config, world.partition.count
    if not 1 <= nodes <= count:
        raise ConfigError(
            f"nodes = {nodes}: a world of {count} zone(s) is hosted by 1 to {count} nodes; use "
            "more zones or fewer nodes"
        )
    refused = {
        "workers.sensors": (
            config.workers.sensors,
            "each node senses for its own vehicles; use more nodes in place of sensor workers",
        ),
    }
    for key, (value, why) in refused.items():
        if value:
            raise ConfigError(f"{key} = {value!r}: worlds over nodes do not have it: {why}")
    if config.workers.monitor_cpu and not config.workers.balance_steps:
        raise ConfigError(
            "workers.monitor_cpu = True: nodes watch their machines for rounds of balance; set "
            "workers.balance_steps, or leave it out"
        )
