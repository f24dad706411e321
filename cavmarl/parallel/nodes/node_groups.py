"""`NodeGroups`: worlds distributed over nodes; each node hosts whole worlds."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import chain, pairwise
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import prepare_runs
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.nodes.node_loads import NodeLoad
from cavmarl.parallel.nodes.node_starters import Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_supply import NodeSupply
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.node_worlds import NodeWorlds, WorldShare, check_nodes, empty_arrays
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.placement.commanded_worlds import CommandedWorlds
from cavmarl.parallel.placement.mover import Mover
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part, parts_of
from cavmarl.parallel.worlds.tasks import CHANGES, Task, commands_of, shifted_reset
from cavmarl.v2x.v2x_messages import Exchange, NetworkSimulator, check_external

Found = TypeVar("Found")


class NodeGroups(CommandedWorlds):
    """W worlds distributed over n nodes; each node hosts all zones of its worlds.

    Each node has a coordinator and a thread of its own, so all nodes carry out a command at once.
    This process keeps the state of the worlds of each node: if a node is lost, another one resumes
    from it. With `workers.balance_steps`, worlds move to other nodes between steps.

    Attributes:
        pool: supplies the nodes.
        groups: the worlds of each node.

    Raises:
        ConfigError: a setting is not supported, or there are more nodes than worlds.
        MissingExtraError: Ray is not installed.
        WorkerError: a node cannot be started.
    """

    pool: NodeSupply

    def __init__(
        self,
        world: World,
        base_dir: Path,  # folder of relative paths
        num_worlds: int,  # W
        backend: BackendName,  # n nodes, from 1 to W
        in_next_step: bool = False,  # whether new episodes start a step later; see `SteppedWorlds`
        *,
        route: Route = straight,  # maps a place to the place that nodes of this machine call
        system: NodeSystem = MACHINE,
        start: Start = start_nodes,  # starts the nodes
    ) -> None:
        check_groups(world)
        self.world, self.in_next_step = world, in_next_step
        self.arrays = empty_arrays(world, num_worlds)
        self.pool = NodeSupply(
            world, base_dir, num_worlds, backend, in_next_step,
            by_worlds=True, route=route, system=system, start=start,
        )  # fmt: skip
        self.groups: list[NodeWorlds] = []
        self._known: set[Task] = set()  # tasks whose kernels this process has loaded
        self._threads = ThreadPoolExecutor(self.pool.count, "cavmarl node")
        try:
            self.placement = StepPlacement(world, num_worlds, self.pool.count, is_here=False)
            parts = parts_of(self.plans, world.partition.count)
            self._bounds = [part.first for part in parts] + [num_worlds]
            self._runs = prepare_runs(world.config.zones, num_worlds)
            for first, last in pairwise(self._bounds):
                share = WorldShare(self.arrays.part(first, last), self._runs[first:last], self.pool)
                group = NodeWorlds(
                    world, base_dir, last - first, backend, in_next_step,
                    route=route, system=system, share=share,
                )  # fmt: skip
                self.groups.append(group)
            self._spent_s = np.zeros((num_worlds, 1))
            if (every := world.config.workers.balance_steps) and len(self.groups) > 1:
                self.mover = Mover(self.placement, world.partition.count, every, self._spent_s)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        for group in self.groups:
            group.close()
        super().close()
        self._threads.shutdown()

    def connect_network(self, network: NetworkSimulator) -> None:
        """Let a network simulator of this process decide receptions.

        Raises:
            ConfigError: the channel is not external.
        """
        check_external(self.world.config.v2x)
        lock = Lock()
        for group, first in zip(self.groups, self._bounds, strict=False):
            group.connect_network(_SharedNetwork(network, first, lock))

    def save_worlds(self) -> list[bytes]:
        return list(
            chain.from_iterable(self._run_jobs(NodeWorlds.save_worlds, self.groups, _ignore))
        )

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Resume from what `save_worlds` returned; `arrays` do not change.

        Raises:
            ConfigError: the state belongs to other worlds.
        """
        parts = [saved[first:last] for first, last in pairwise(self._bounds)]
        for group, part in zip(self.groups, parts, strict=True):
            group.check_worlds(part)
        self._command(Task.LOAD, parts)

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """Changes of owner of each world."""
        return tuple(chain.from_iterable(group.transfers for group in self.groups))

    def node_loads(self) -> list[NodeLoad]:
        """Return the load of each node since the previous call, in ascending order of nodes."""
        found = self._run_jobs(NodeWorlds.node_loads, self.groups, _ignore)
        return [load._replace(node=k) for k, loads in enumerate(found) for load in loads]

    def describe_network(self) -> list[dict[str, Any]]:
        """Return machine, process and connections of each node, for manifests."""
        found = self._run_jobs(NodeWorlds.describe_network, self.groups, _ignore)
        return [{**row, "node": k} for k, rows in enumerate(found) for row in rows]

    def in_flight(self, world: int) -> Sequence[TransferInFlight]:
        """Return the vehicles of a world whose next zone has their state already."""
        k = self._group_of(world)
        return self.groups[k].in_flight(world - self._bounds[k])

    def _pids(self) -> dict[int, int]:
        """Return node → process, for nodes of this machine."""
        if not self.pool.is_here:
            return {}
        return {k: pid for k, group in enumerate(self.groups) for pid in group.pool.pids}

    def _seen(self) -> LoadSnapshot:
        """Add new costs of worlds to `_spent_s`, for a round of balancing; nodes count as idle."""
        costs = self._run_jobs(NodeWorlds.world_costs_s, self.groups, _ignore)
        self._spent_s[:, 0] += np.concatenate(costs)
        return idle_snapshot(len(self.groups))

    def _settle(self, parts: list[Part]) -> None:
        """Do nothing: `_move` has noted the new parts."""

    def _move(self, bounds: Sequence[int]) -> None:
        """Move worlds to other nodes; if that fails, move them back.

        Args:
            bounds: first world of each node, and the number of worlds.
        """
        before = self._bounds
        changed = [k for k in range(len(self.groups)) if before[k : k + 2] != bounds[k : k + 2]]
        saved: list[bytes] = [b""] * bounds[-1]
        groups = [self.groups[k] for k in changed]
        for k, worlds in zip(
            changed, self._run_jobs(NodeWorlds.save_worlds, groups, _ignore), strict=True
        ):
            saved[slice(*before[k : k + 2])] = worlds

        def set_bounds(bounds: Sequence[int]) -> None:
            def set_worlds(k: int) -> None:
                part = slice(*bounds[k : k + 2])
                arrays = self.arrays.part(part.start, part.stop)
                self.groups[k].set_worlds(arrays, self._runs[part], saved[part])

            self._run_jobs(set_worlds, changed, _ignore)
            self._bounds = list(bounds)

        try:
            set_bounds(bounds)
        except BaseException:
            set_bounds(before)
            raise

    def _group_of(self, world: int) -> int:
        return bisect_right(self._bounds, world) - 1

    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        """Run a task on all nodes; if the task fails on a node, no worlds change."""
        if task == Task.PACK:  # UNPACK carries out the whole move
            return
        if task == Task.UNPACK:
            self._move(payload)
            return
        payloads = [payload] * len(self.groups)
        if task == Task.RESET:
            payloads = [shifted_reset(payload, first) for first in self._bounds[:-1]]
        elif task == Task.LOAD:
            payloads = payload

        def perform(job: tuple[NodeWorlds, Any]) -> None:
            group, own_payload = job
            if task == Task.STEP:
                group.step(commands_of(group.arrays))
            else:
                group.perform(task, own_payload)

        jobs = list(zip(self.groups, payloads, strict=True))
        # Threads must not load the same kernels at once.
        is_known = task in self._known
        self._run_jobs(perform, jobs, _undo if task in CHANGES else _ignore, not is_known)
        self._known.add(task)

    def _run_jobs(
        self,
        perform: Callable[[Any], Found],
        jobs: Sequence[Any],
        undo: Callable[[Any], None],
        in_turn: bool = False,
    ) -> list[Found]:
        """Run jobs in parallel, or one after the other; if a job fails, undo the other jobs."""
        running: list[Future[Found]] = []
        try:
            for job in jobs:
                running.append(self._threads.submit(perform, job))
                if in_turn:
                    running[-1].result()
            return [one.result() for one in running]
        except BaseException:
            for job, one in zip(jobs, running, strict=False):
                if one.exception() is None:
                    undo(job)
            raise

    def _ask(self, task: Task, world: int, payload: Any) -> Any:
        k = self._group_of(world)
        number = world - self._bounds[k]  # a node counts its worlds from 0
        return self.groups[k].ask(task, [number, payload[1]] if task == Task.DRIVEN else number)


def check_groups(world: World) -> None:
    """Raise ConfigError for settings that whole worlds on nodes do not support."""
    config = world.config
    if config.workers.monitor_cpu:
        raise ConfigError(
            "workers.monitor_cpu = True: whole worlds on nodes are balanced by their costs only; "
            "leave out workers.monitor_cpu, or use backend='processes:N' or more nodes than worlds"
        )
    check_nodes(world, 1)
    if config.workers.balance_steps and config.zones.journal:
        raise ConfigError(
            f"zones.journal = {config.zones.journal!r} with workers.balance_steps: a journal "
            "restarts when its world moves to another node; leave one of the two out"
        )


def _undo(job: tuple[NodeWorlds, Any]) -> None:
    job[0].pool.undo()


def _ignore(job: Any) -> None:
    """Undo nothing: the job has changed nothing."""


class _SharedNetwork:
    """The network simulator of all worlds, as a `NetworkSimulator` for some of them."""

    def __init__(self, network: NetworkSimulator, first: int, lock: Lock) -> None:
        self._network, self._first, self._lock = network, first, lock

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """See `NetworkSimulator.exchange`; only one group asks at a time."""
        with self._lock:
            return self._network.exchange(sent._replace(world=sent.world + self._first))
