"""`NodeGroups`: worlds that nodes share out, whole worlds each."""

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
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import prepare_runs
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.nodes.node_starters import Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_supply import NodeSupply
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.nodes.node_worlds import NodeWorlds, WorldShare, check_nodes, empty_arrays
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.placement.commanded_worlds import CommandedWorlds
from cavmarl.parallel.placement.mover import Mover
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part, parts_of
from cavmarl.parallel.worlds.tasks import Task, commands_of
from cavmarl.v2x.v2x_messages import Exchange, NetworkSimulator, check_external

Found = TypeVar("Found")

CHANGES = (Task.STEP, Task.RESET, Task.LOAD)  # tasks that change worlds


class NodeGroups(CommandedWorlds):
    """W worlds over n nodes, each of which hosts all zones of its worlds.

    Each node has a coordinator and a thread of its own, and all do a command at the same time. The
    state of the worlds of each node is kept in this process: if a node is lost, another one goes on
    from there. With `workers.balance_steps` worlds change their node between steps.

    Attributes:
        pool: where the nodes come from.
        groups: the worlds of each node.

    Raises:
        ConfigError: a setting that such worlds cannot have, or more nodes than worlds.
        MissingExtraError: Ray is not installed.
        WorkerError: a node cannot be started.
    """

    pool: NodeSupply

    def __init__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from
        num_worlds: int,  # W
        backend: BackendName,  # what starts n nodes, from 1 to W
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
        *,
        route: Route = straight,  # where nodes of this machine call in order to reach a place
        system: NodeSystem = MACHINE,  # that the nodes are on
        start: Start = start_nodes,  # starts them
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
        """From now on let a network simulator of this process decide receptions.

        Raises:
            ConfigError: the channel is one of our own.
        """
        check_external(self.world.config.v2x)
        lock = Lock()
        for group, first in zip(self.groups, self._bounds, strict=False):
            group.connect_network(_SharedNetwork(network, first, lock))

    def save_worlds(self) -> list[bytes]:
        return list(
            chain.from_iterable(self._side_by_side(NodeWorlds.save_worlds, self.groups, _ignore))
        )

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Go on from what `save_worlds` gave; `arrays` stay as they are.

        Raises:
            ConfigError: it is of other worlds.
        """
        parts = [saved[first:last] for first, last in pairwise(self._bounds)]
        for group, part in zip(self.groups, parts, strict=True):
            group.check_worlds(part)
        self._command(Task.LOAD, parts)

    @property
    def simulation(self) -> Simulation:
        """Refused: the worlds live elsewhere."""
        raise ConfigError("the worlds live in nodes: use backend='local' to look into them")

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """What became of each change of owner, by worlds."""
        return tuple(chain.from_iterable(group.transfers for group in self.groups))

    def in_flight(self, world: int) -> Sequence[TransferInFlight]:
        """Vehicles of one world whose next zone holds their state already."""
        k = self._group_of(world)
        return self.groups[k].in_flight(world - self._bounds[k])

    def _pids(self) -> dict[int, int]:
        """Those of nodes of this machine."""
        if not self.pool.is_here:
            return {}
        return {k: pid for k, group in enumerate(self.groups) for pid in group.pool.pids}

    def _seen(self) -> LoadSnapshot:
        """Ask what worlds have cost, before they are balanced by it."""
        costs = self._side_by_side(NodeWorlds.world_costs_s, self.groups, _ignore)
        self._spent_s[:, 0] += np.concatenate(costs)
        return idle_snapshot(len(self.groups))

    def _settle(self, parts: list[Part]) -> None:
        """They have noted it when worlds moved."""

    def _move(self, bounds: Sequence[int]) -> None:
        """Let worlds change their node; on an error all are where they were.

        Args:
            bounds: the first world of each node, and the end of the last one's.
        """
        before = self._bounds
        changed = [k for k in range(len(self.groups)) if before[k : k + 2] != bounds[k : k + 2]]
        saved: list[bytes] = [b""] * bounds[-1]
        groups = [self.groups[k] for k in changed]
        for k, worlds in zip(
            changed, self._side_by_side(NodeWorlds.save_worlds, groups, _ignore), strict=True
        ):
            saved[slice(*before[k : k + 2])] = worlds

        def have(bounds: Sequence[int]) -> None:
            def become(k: int) -> None:
                part = slice(*bounds[k : k + 2])
                arrays = self.arrays.part(part.start, part.stop)
                self.groups[k].become(arrays, self._runs[part], saved[part])

            self._side_by_side(become, changed, _ignore)
            self._bounds = list(bounds)

        try:
            have(bounds)
        except BaseException:
            have(before)
            raise

    def _group_of(self, world: int) -> int:
        return bisect_right(self._bounds, world) - 1

    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        """Let all nodes do a task; if it fails anywhere, no worlds have changed."""
        if task == Task.PACK:  # worlds move in one go
            return
        if task == Task.UNPACK:
            self._move(payload)
            return
        payloads = [payload] * len(self.groups)
        if task == Task.RESET:
            payloads = [
                {**payload, "first_world": payload["first_world"] + first}
                for first in self._bounds[:-1]
            ]
        elif task == Task.LOAD:
            payloads = payload

        def perform(job: tuple[NodeWorlds, Any]) -> None:
            group, told = job
            if task == Task.STEP:
                group.step(commands_of(group.arrays))
            else:
                group.perform(task, told)

        jobs = list(zip(self.groups, payloads, strict=True))
        # Threads must not load the same kernels at once.
        is_known = task in self._known
        self._side_by_side(perform, jobs, _undo if task in CHANGES else _ignore, not is_known)
        self._known.add(task)

    def _side_by_side(
        self,
        perform: Callable[[Any], Found],
        jobs: Sequence[Any],
        undo: Callable[[Any], None],
        in_turn: bool = False,
    ) -> list[Found]:
        """Do something for all groups at the same time, or one after the other.

        If it fails for one, what was done for others is taken back.
        """
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
    """Refuse what worlds that nodes share out cannot have."""
    config = world.config
    if config.workers.monitor_cpu:
        raise ConfigError(
            "workers.monitor_cpu = True: whole worlds on nodes are balanced by what they cost; "
            "leave it out, or use backend='processes:N' or more nodes than worlds"
        )
    check_nodes(world, 1)
    if config.workers.balance_steps and config.zones.journal:
        raise ConfigError(
            f"zones.journal = {config.zones.journal!r} with workers.balance_steps: a journal is "
            "begun anew when its world moves to another node; leave one out"
        )


def _undo(job: tuple[NodeWorlds, Any]) -> None:
    job[0].pool.undo()


def _ignore(job: Any) -> None:
    """Nothing has changed."""


class _SharedNetwork:
    """The network simulator of all worlds as some of them see it; a `NetworkSimulator`."""

    def __init__(self, network: NetworkSimulator, first: int, lock: Lock) -> None:
        self._network, self._first, self._lock = network, first, lock

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """See `NetworkSimulator.exchange`; one group asks at a time."""
        with self._lock:
            return self._network.exchange(sent._replace(world=sent.world + self._first))
