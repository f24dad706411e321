"""`NodeWorlds`: worlds whose zones are hosted by nodes, processes that share nothing."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Sequence
from dataclasses import replace
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
from cavmarl.parallel.backend_name import BackendName
from cavmarl.parallel.commanded_worlds import uncopied
from cavmarl.parallel.mover import Mover
from cavmarl.parallel.nodes.agent_stream import ResultStream
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.node_actions import Actions, NodeCommand
from cavmarl.parallel.nodes.node_cuts import read_zones
from cavmarl.parallel.nodes.node_frames import (
    pieces_of,
    saved_of,
    worlds_payload,
)
from cavmarl.parallel.nodes.node_loads import (
    TO_BALANCE,
    TO_SHOW,
    MachineAsked,
    NodeLoad,
    since,
)
from cavmarl.parallel.nodes.node_network import NetworkFailedError, answer_of, read_asked
from cavmarl.parallel.nodes.node_pool import NodePool
from cavmarl.parallel.nodes.node_starters import LocalNodes, Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
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
        backend: BackendName,  # what starts n nodes, from 1 to the zones of a world
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
        route: Route = straight,  # where nodes of this machine call in order to reach a place
        system: NodeSystem = MACHINE,  # that the nodes are on
        start: Start = start_nodes,  # starts them
    ) -> None:
        check_nodes(world, backend.count or 1)
        super().__init__(world, base_dir, num_worlds, backend, in_next_step, route, system, start)
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
        results = self.run(self._command(Task.RESET, {"seed": seed, "first_world": first_world}))
        self._write(results, arrays.chosen, of_step=False)
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
        results = self.run(self._command(Task.STEP))
        self._ticks_done += self._ticks_per_step
        self._write(results, self._everywhere, of_step=True)

    def _cut_anew(self) -> None:
        """Every so many steps cut the zones by their vehicles; see `zones.repartition_steps`."""
        self._steps += 1
        if not is_due(self._steps, self.world.config.zones.repartition_steps):
            return
        if proposal := self._asked(Task.PROPOSE, None):
            zones, *figures = proposal
            self.run(self._command(Task.CUT, zones))
            self.recuts.append(Recut(self._steps - 1, *figures))

    def connect_network(self, network: NetworkSimulator) -> None:
        """From now on let a network simulator of this process decide receptions.

        Raises:
            ConfigError: the channel is one of our own.
        """
        check_external(self.world.config.v2x)
        self._network = network

    def run(self, command: NodeCommand) -> list[memoryview]:
        try:
            return super().run(command)
        except NetworkFailedError as failed:
            raise failed.error from None

    def _perform(self, command: NodeCommand) -> list[memoryview]:
        self._exchanged = 0
        return super()._perform(command)

    def _hear(self, number: int, frame: NodeFrame) -> None:
        if frame.kind is not FrameKind.EXCHANGE:
            super()._hear(number, frame)
        elif frame.number == self._generation:
            self._exchange(frame)

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
        for data in self.run(self._command(Task.HOST)):
            for zone, spent_s in json.loads(bytes(data)):
                self._spent_s[0, zone] += spent_s
        idle = idle_snapshot(len(self._homes))
        if not self.world.config.workers.monitor_cpu:
            return idle
        seen = self.node_snapshot(TO_BALANCE)
        states = {one.worker: one for one in (*idle.workers, *seen.workers)}
        return replace(seen, workers=tuple(states[node] for node in sorted(states)))

    def _move(self, task: Task, zones: list[Any], commits: bool) -> None:
        """Let zones have other homes from now on."""
        before, self._homes = self._homes, zones[0]
        self._is_torn, self._opened = True, None
        try:
            self._insist(None)
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
        self, results: Sequence[memoryview], chosen: NDArray[np.bool_], of_step: bool
    ) -> None:
        for n, (number, data) in enumerate(zip(self._tellers, results, strict=True)):
            self._results.take(data, chosen, of_step, n == 0, number, self._owner)

    def suggest(self) -> None:
        """Write what the built-in driver would do in the agents' place."""
        suggested = self.arrays.suggested
        suggested[...] = 0.0
        for data in self.run(self._command(Task.SUGGEST)):
            num = len(data) // (8 + suggested.itemsize * 2)
            where = np.frombuffer(data, np.int64, num)
            found = np.frombuffer(data, suggested.dtype, 2 * num, 8 * num)
            suggested.reshape(-1, 2)[where] = found.reshape(-1, 2)

    def node_loads(self) -> list[NodeLoad]:
        """What each node has done since this was asked last, by rising numbers.

        After a node was lost its successor's time is that since it began.
        """
        found = []
        ticks, self._ticks_told = self._ticks_done - self._ticks_told, self._ticks_done
        for data in self.run(self._command(Task.LOADS)):
            node, *now = json.loads(bytes(data))
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
        found = [json.loads(bytes(data)) for data in self.run(asked)]
        states = tuple(Candidate(node, Utilisation(*shares)) for node, shares, _ in found)
        source = next((source for *_, source in found if source != NO_GPU), NO_GPU)
        return LoadSnapshot(states, source, MEASURED)

    def _asked(self, task: Task, payload: Any) -> Any:
        return json.loads(bytes(self.run(self._command(task, payload))[0]))

    def write_states(self) -> None:
        data = self.run(self._command(Task.WRITE_STATES))[0]
        found = np.frombuffer(data, self.arrays.states.dtype)
        self.arrays.states[...] = found.reshape(self.arrays.states.shape)

    def ticks(self) -> NDArray[np.int64]:
        return self.arrays.ticks.copy()

    def state_hash(self, world: int) -> str:
        return str(self._asked(Task.STATE_HASH, self._number(world)))

    def traffic_stats(self, world: int) -> dict[str, float]:
        found: dict[str, float] = self._asked(Task.TRAFFIC_STATS, self._number(world))
        return found

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]:
        found = self._asked(Task.DRIVEN, [self._number(world), list(map(int, agents))])
        return [Driven(*row) for row in found]

    def signal_phases(self, world: int) -> NDArray[np.int32]:
        return np.array(self._asked(Task.SIGNAL_PHASES, self._number(world)), dtype=np.int32)

    def _number(self, world: int) -> int:
        return range(len(self.arrays.mask))[world]

    def save_worlds(self) -> list[bytes]:
        return saved_of(self._asked(Task.SAVE, None))

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Go on from what `save_worlds` gave; `arrays` stay as they are.

        Raises:
            ConfigError: it is of other worlds.
        """
        if refusal := self._asked(Task.LOAD, worlds_payload(saved, only_reads=True)):
            raise ConfigError(refusal)
        self.run(self._command(Task.LOAD, worlds_payload(saved)))

    @property
    def partition(self) -> ZonePartition:
        """The zones as they are now; a cut gives the worlds others."""
        return read_zones(self._cut.partition)

    @property
    def simulation(self) -> Simulation:
        """Refused: the worlds live elsewhere."""
        raise ConfigError("the worlds live in nodes: use backend='local' to look into them")

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
