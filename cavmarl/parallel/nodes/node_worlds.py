"""`NodeWorlds`: worlds whose zones are distributed over nodes."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import NO_GPU, LoadSnapshot, idle_snapshot
from cavmarl.balance.probe import MEASURED
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import WorldRun, prepare_runs
from cavmarl.handoff.repartitioning import Repartition, is_due
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.network.code_stamp import code_stamp
from cavmarl.parallel.network.link_quality import LinkQuality
from cavmarl.parallel.nodes.agent_stream import ResultStream
from cavmarl.parallel.nodes.node_actions import Actions, NodeCommand, ZoneRects
from cavmarl.parallel.nodes.node_cuts import read_zones
from cavmarl.parallel.nodes.node_frames import (
    pieces_of,
    saved_of,
    worlds_payload,
)
from cavmarl.parallel.nodes.node_loads import (
    LINKS,
    TO_BALANCE,
    TO_SHOW,
    TOTALS,
    MachineAsked,
    NodeLoad,
    since,
)
from cavmarl.parallel.nodes.node_network import NetworkFailedError, answer_of, read_request
from cavmarl.parallel.nodes.node_pool import Found, NodePool, Read, unread
from cavmarl.parallel.nodes.node_starters import Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_supply import NodeSupply
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.peer_faults import check_indices, read_json
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.placement.commanded_worlds import CommandedWorlds
from cavmarl.parallel.placement.mover import Mover
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part, parts_of
from cavmarl.parallel.worlds.step_arrays import Driven, StepArrays, layout_of
from cavmarl.parallel.worlds.tasks import CHANGES, Task
from cavmarl.shards.shard import Commands
from cavmarl.v2x.v2x_messages import NetworkSimulator, check_external
from cavmarl.zones.partition.zone_partition import ZonePartition

HASH = re.compile("[0-9a-f]{32}")  # the hash of a state


class WorldShare(NamedTuple):
    """The worlds that one node of `NodeGroups` hosts."""

    arrays: StepArrays  # step arrays of these worlds
    runs: Sequence[WorldRun]  # runs of these worlds
    supply: NodeSupply  # supplies nodes to all pools


class NodeWorlds(CommandedWorlds):
    """W worlds distributed over n nodes, which share the zones of each world.

    Attributes:
        pool: the nodes.
        repartitions: past changes of the zones.

    Raises:
        ConfigError: a setting is not supported, or there are more nodes than zones.
        WorkerError: a node cannot be started.
    """

    pool: NodePool

    def __init__(
        self,
        world: World,
        base_dir: Path,  # folder of relative paths
        num_worlds: int,  # W
        backend: BackendName,  # n nodes, from 1 to the zones of a world
        in_next_step: bool = False,  # whether new episodes start a step later; see `SteppedWorlds`
        *,
        route: Route = straight,  # maps a place to the place that nodes of this machine call
        system: NodeSystem = MACHINE,
        start: Start = start_nodes,  # starts the nodes
        share: WorldShare | None = None,  # part of the worlds of `NodeGroups`; None: all worlds
    ) -> None:
        config, count = world.config, world.partition.count
        nodes = 1 if share else backend.count or 1
        check_nodes(world, nodes)
        self.world, self.in_next_step = world, in_next_step
        self._set_arrays(share.arrays if share else empty_arrays(world, num_worlds))
        self.placement = StepPlacement(world, 1, nodes, is_here=False)
        zones = parts_of(self.plans, count)[0].zones
        self._network: NetworkSimulator | None = None
        self._readers: dict[Task, Read[Any]] = {
            Task.RESET: self._read_begun,
            Task.STEP: self._read_stepped,
            Task.SUGGEST: self._read_suggested,
            Task.WRITE_STATES: self._of_first(self._read_states),
        }
        runs = share.runs if share else prepare_runs(config.zones, num_worlds)
        self._supply = share.supply if share else NodeSupply(
            world, base_dir, num_worlds, backend, in_next_step,
            route=route, system=system, start=start,
        )  # fmt: skip
        self._owns_supply = share is None
        try:
            self.pool = NodePool(
                world, runs, zones, self._supply, answer=self._answer, system=system, route=route
            )
        except BaseException:
            self._close_supply()
            raise
        self._spent_s = np.zeros((1, count))
        self._ticks_per_step = config.clock.ticks_per_step
        self._ticks_done = self._ticks_reported = 0
        self._steps_begun = 0  # number of steps since the worlds were made
        self.repartitions: list[Repartition] = []
        self._last_loads: dict[int, list[Any]] = {}  # last report of each node
        every = config.workers.balance_steps
        if every and share is None:
            self.mover = Mover(self.placement, count, every, self._spent_s)
        if config.workers.monitor_cpu:
            self.node_snapshot(TO_BALANCE)  # nodes watch their machines from now on

    def close(self) -> None:
        super().close()
        self._close_supply()

    def _close_supply(self) -> None:
        if self._owns_supply:
            self._supply.close()

    def step(self, commands: Commands) -> None:
        """See `CommandedWorlds.step`; before that, repartition the zones if that is due."""
        self._repartition()
        super().step(commands)

    def _repartition(self) -> None:
        """Repartition the zones by their vehicles, every `zones.repartition_steps` steps."""
        self._steps_begun += 1
        if not is_due(self._steps_begun, self.world.config.zones.repartition_steps):
            return
        if proposal := self.ask(Task.PROPOSE):
            zones, figures = proposal
            self._command(Task.CUT, zones)
            self.repartitions.append(Repartition(self._steps_begun - 1, *figures))

    def _read_proposal(self, proposal: Any) -> tuple[ZoneRects, list[Any]] | None:
        if proposal is None:
            return None
        zones, *figures = proposal
        if read_zones(zones).count != self.world.partition.count or len(figures) != 4:
            raise MessageError(f"it proposes {proposal!r}")
        return zones, figures

    def connect_network(self, network: NetworkSimulator) -> None:
        """Let a network simulator of this process decide receptions.

        Raises:
            ConfigError: the channel is not external.
        """
        check_external(self.world.config.v2x)
        self._network = network

    def _answer(self, data: memoryview) -> bytes:
        """Return the answer of the network simulator. Raises the errors of `answer_of`."""
        latency = self.world.config.v2x.channel.latency_ticks
        return answer_of(self._network, read_request(data, len(self.arrays.mask), latency))

    def _seen(self) -> LoadSnapshot:
        """Add new costs of zones to `_spent_s` for a round of balancing; return how busy nodes are.

        Nodes that are not watched, or are lost, count as idle.
        """
        for of_zones, _ in self._costs():
            for zone, spent_s in of_zones:
                self._spent_s[0, zone] += spent_s
        idle = idle_snapshot(self.pool.num_nodes)
        if not self.world.config.workers.monitor_cpu:
            return idle
        seen = self.node_snapshot(TO_BALANCE)
        states = {one.worker: one for one in (*idle.workers, *seen.workers)}
        return replace(seen, workers=tuple(states[node] for node in sorted(states)))

    def _costs(self) -> list[tuple[list[tuple[int, float]], list[int]]]:
        """Return the costs of each node since the previous request.

        For each node: pairs of a zone and its processor time in s, and the vehicles of each world.
        """
        return self._run(Task.COSTS, None, self._read_costs)

    def _read_costs(
        self, number: int, data: memoryview
    ) -> tuple[list[tuple[int, float]], list[int]]:
        of_zones, running = read_json(data, list)
        found = [(zone, float(spent_s)) for zone, spent_s in of_zones]
        check_indices("zone", (zone for zone, _ in found), self._spent_s.shape[1])
        if len(running) != len(self.arrays.mask):
            raise MessageError(f"it has the vehicles of {len(running)} worlds")
        return found, list(map(int, running))

    def world_costs_s(self) -> NDArray[np.float64]:
        """Return the processor time (W,) of each world, in proportion to its vehicles."""
        found = np.zeros(len(self.arrays.mask))
        for of_zones, running in self._costs():
            vehicles = np.array(running, dtype=np.float64) + 1.0
            found += vehicles * (sum(spent_s for _, spent_s in of_zones) / vehicles.sum())
        return found

    def set_worlds(
        self, arrays: StepArrays, runs: Sequence[WorldRun], saved: Sequence[bytes]
    ) -> None:
        """Replace the worlds by saved worlds. Raises the errors of `NodePool.begin_anew`."""
        self._set_arrays(arrays)
        self.pool.begin_anew(runs)
        self.perform(Task.LOAD, saved)

    def _set_arrays(self, arrays: StepArrays) -> None:
        self.arrays = arrays
        self._results = ResultStream(arrays)
        self._everywhere = np.ones(len(arrays.mask), dtype=np.bool_)

    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        if task == Task.HOST:
            self.pool.move(payload[0])
        else:
            self.perform(task, payload)

    def perform(self, task: Task, payload: Any = None) -> None:
        """Run a task on all nodes, and write its outputs to `arrays`."""
        content = worlds_payload(payload) if task == Task.LOAD else payload
        results = self._run(task, content, self._readers.get(task, unread))
        arrays = self.arrays
        if task == Task.STEP:
            self._ticks_done += self._ticks_per_step
        elif task == Task.RESET and not arrays.chosen.all():
            arrays.observations[~arrays.mask] = 0.0
        elif task == Task.SUGGEST:
            arrays.suggested[...] = 0.0
            for where, found in results:
                arrays.suggested.reshape(-1, 2)[where] = found

    def _settle(self, parts: list[Part]) -> None:
        """Do nothing: the pool has noted the new zones."""

    def _run(self, task: Task, payload: Any, read: Read[Found]) -> list[Found]:
        """Run a task on all nodes; return what `read` returns for each result."""
        try:
            return self.pool.run(self._make_command(task, payload), read)
        except NetworkFailedError as failed:
            raise failed.error from None

    def _make_command(self, task: Task, payload: Any) -> NodeCommand:
        changes = task in CHANGES
        pieces = pieces_of(task, payload, self.arrays)
        if task != Task.STEP:
            return NodeCommand(pieces, changes, 0, cut=payload if task == Task.CUT else None)
        actions = Actions.of(self.arrays)
        return NodeCommand(pieces, changes, self._ticks_per_step, actions, receptions=[])

    def _ask(self, task: Task, world: int, payload: Any) -> Any:
        return self.ask(task, payload)

    def ask(self, task: Task, payload: Any = None) -> Any:
        """Return the answer of the first node, which receives the whole worlds for the task."""
        read = self._read_proposal if task == Task.PROPOSE else _ANSWERS[task]
        first = self._of_first(lambda data: read(json.loads(bytes(data))))
        return self._run(task, payload, first)[0]

    def _of_first(self, read: Callable[[memoryview], Any]) -> Read[Any]:
        """Return a reader of the answer of the first node; other nodes send no answer."""

        def read_first(number: int, data: memoryview) -> Any:
            if number == self.pool.first:
                return read(data)
            if len(data):
                raise MessageError(f"it answers with {len(data)} bytes, but is not the first node")
            return None

        return read_first

    def _read_begun(self, number: int, data: memoryview) -> None:
        self._write(self.arrays.chosen, False, number, data)

    def _read_stepped(self, number: int, data: memoryview) -> None:
        self._write(self._everywhere, True, number, data)

    def _write(
        self, chosen: NDArray[np.bool_], of_step: bool, number: int, data: memoryview
    ) -> None:
        pool = self.pool
        self._results.read(data, chosen, of_step, number == pool.reporter, number, pool.owner)

    def _read_suggested(self, number: int, data: memoryview) -> tuple[NDArray[Any], NDArray[Any]]:
        suggested = self.arrays.suggested
        num, rest = divmod(len(data), 8 + suggested.itemsize * 2)
        where = np.frombuffer(data, np.int64, num)
        check_indices("agent", where, suggested.size // 2)
        if rest:
            raise MessageError(f"{len(data)} bytes are not suggestions")
        return where, np.frombuffer(data, suggested.dtype, 2 * num, 8 * num).reshape(-1, 2)

    def _read_states(self, data: memoryview) -> None:
        states = self.arrays.states
        states[...] = np.frombuffer(data, states.dtype).reshape(states.shape)

    def node_loads(self) -> list[NodeLoad]:
        """Return the load of each node since the previous call, in ascending order of nodes.

        The load of a node that has replaced a lost node counts from the start of the new node.
        """
        found = []
        ticks, self._ticks_reported = self._ticks_done - self._ticks_reported, self._ticks_done
        for node, now in self._run(Task.LOADS, None, _read_totals):
            before = self._last_loads.get(node)
            is_same = before is not None and before[0] <= now[0]
            found.append(since(node, ticks, now, before if is_same else None))
            self._last_loads[node] = now
        return sorted(found)

    def node_snapshot(self, purpose: str = TO_SHOW) -> LoadSnapshot:
        """Return how busy other programs keep the machine of each node.

        The time starts with the previous call for the same purpose. The load of this run does not
        count.
        """
        here: dict[str, list[int]] = {socket.gethostname(): [os.getpid()]}
        for machine, pid in self.pool.machines.values():
            here.setdefault(machine, []).append(pid)
        found = self._run(Task.LOADS, MachineAsked(purpose, here), _read_watched)
        states = tuple(candidate for candidate, _ in found)
        source = next((source for _, source in found if source != NO_GPU), NO_GPU)
        return LoadSnapshot(states, source, MEASURED)

    def describe_network(self) -> list[dict[str, Any]]:
        """Return machine, process and connections of each node, for manifests.

        Each end of a connection has measured its own round trips, under the traffic of this run.
        """
        machines = self.pool.machines
        found = dict(self._run(Task.LOADS, MachineAsked(LINKS, {}), _read_links))
        return [
            {"node": node, "machine": machine, "process": pid, "code": code_stamp(),
             "links": found[node]}
            for node, (machine, pid) in sorted(machines.items())
        ]  # fmt: skip

    def save_worlds(self) -> list[bytes]:
        saved: list[bytes] = self.ask(Task.SAVE)
        return saved

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Resume from what `save_worlds` returned; `arrays` do not change.

        Raises:
            ConfigError: the state belongs to other worlds.
        """
        self.check_worlds(saved)
        self._command(Task.LOAD, saved)

    def check_worlds(self, saved: Sequence[bytes]) -> None:
        """Raise ConfigError if the worlds cannot resume from the saved worlds."""
        if refusal := self.ask(Task.CHECK, worlds_payload(saved)):
            raise ConfigError(refusal)

    @property
    def partition(self) -> ZonePartition:
        """The current zones, which repartitioning changes."""
        return read_zones(self.pool.partition)

    def _pids(self) -> dict[int, int]:
        """Return node → process on this machine; `node_snapshot` covers other machines."""
        return dict(enumerate(self.pool.pids)) if self._supply.is_here else {}

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """Changes of owner of each world."""
        return self.pool.coordinator.transfers

    def in_flight(self, world: int) -> Sequence[TransferInFlight]:
        """Return the vehicles of a world whose next zone has their state already."""
        return self.pool.coordinator.in_flight(world)

    @property
    def migrations(self) -> int:
        """Number of changes of owner since the worlds were made."""
        return self.pool.coordinator.switched


def empty_arrays(world: World, num_worlds: int) -> StepArrays:
    """Return arrays for the inputs and outputs of a step."""
    layout = layout_of(world.config, world.capacity, num_worlds, world.signal_sizes).items()
    return StepArrays.of({name: np.zeros(shape, kind) for name, (kind, shape) in layout})


def _read_hash(found: Any) -> str:
    """Check that a value is the hash of a state. Raises MessageError: it is not."""
    if not isinstance(found, str) or not HASH.fullmatch(found):
        raise MessageError(f"it has {found!r} in place of a hash")
    return found


_ANSWERS: Mapping[Task, Callable[[Any], Any]] = {
    Task.STATE_HASH: _read_hash,
    Task.TRAFFIC_STATS: dict,
    Task.DRIVEN: lambda rows: [Driven(*row) for row in rows],
    Task.SIGNAL_PHASES: lambda rows: np.array(rows, dtype=np.int32),
    Task.SAVE: saved_of,
    Task.CHECK: str,
}
"""Reads the answer of the first node to a task."""


def _read_totals(number: int, data: memoryview) -> tuple[int, list[Any]]:
    """Read the report of a node about itself; see `node_loads.totals`."""
    report = read_json(data, list)
    if len(report) != 1 + TOTALS or report[0] != number:
        raise MessageError(f"it reports the invalid load {report!r}")
    return number, list(map(float, report[1:5])) + list(map(int, report[5:]))


def _read_watched(number: int, data: memoryview) -> tuple[Candidate, str]:
    """Read how busy the machine of a node is, and the source of the figure."""
    _, shares, source = read_json(data, list)
    return Candidate(number, Utilisation(*shares)), str(source)


def _read_links(number: int, data: memoryview) -> tuple[int, list[dict[str, Any]]]:
    """Read the report of a node about its connections."""
    rows = read_json(data, list)
    if rows.pop(0) != number:
        raise MessageError("it reports the connections of another node")
    links = []
    for row in rows:
        if not isinstance(row, list) or len(row) != 1 + len(LinkQuality._fields):
            raise MessageError(f"it reports the invalid connection {row!r}")
        to, is_encrypted, *values = row
        numbers = [None if value is None else float(value) for value in values]
        quality = LinkQuality(bool(is_encrypted), *numbers)._asdict()
        links.append({"to": "caller" if to == COORDINATOR else int(to), **quality})
    return number, links


def check_nodes(world: World, nodes: int) -> None:
    """Raise ConfigError for settings that worlds on nodes do not support."""
    config, count = world.config, world.partition.count
    if not 1 <= nodes <= count:
        raise ConfigError(
            f"nodes = {nodes}: a world of {count} zone(s) needs 1 to {count} nodes; use more zones "
            "or fewer nodes"
        )
    refused = {
        "workers.sensors": (
            config.workers.sensors,
            "each node senses for its own vehicles; use more nodes instead of sensor workers",
        ),
    }
    for key, (value, why) in refused.items():
        if value:
            raise ConfigError(f"{key} = {value!r}: not supported over nodes: {why}")
    if config.workers.monitor_cpu and not config.workers.balance_steps:
        raise ConfigError(
            "workers.monitor_cpu = True: nodes watch their machines for balancing only; set "
            "workers.balance_steps, or leave out workers.monitor_cpu"
        )
