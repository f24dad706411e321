"""`RemoteWorlds`: worlds shared out over the machines of a Ray cluster."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.workers import WorkersConfig
from cavmarl.core.errors import ConfigError, WorkerFailureError
from cavmarl.engine.compilation import compiled_before
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World
from cavmarl.parallel.checkpoint.world_states import WorldMove, buffers, moves_of
from cavmarl.parallel.commanded_worlds import CommandedWorlds
from cavmarl.parallel.hosts.host_commands import Arrays, HostProgram
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.hosts.host_process import code_stamp
from cavmarl.parallel.hosts.hosted_worlds_job import host_worlds, inputs_of, results_of
from cavmarl.parallel.hosts.ray_actors import RayActors
from cavmarl.parallel.journaled_worlds import refuse_watched, unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.mover import Mover
from cavmarl.parallel.recipe import recipe_of
from cavmarl.parallel.step_arrays import StepArrays, layout_of
from cavmarl.parallel.step_placement import StepPlacement
from cavmarl.parallel.tasks import TASK_NAMES, Task
from cavmarl.parallel.work_shares import Part, parts_of
from cavmarl.parallel.world_errors import own_error, refuse_external

Array = NDArray[np.uint8]


class RemoteWorlds(CommandedWorlds):
    """W worlds over m hosts, whole worlds each.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: a setting that worlds elsewhere cannot have, more hosts than worlds, or than
            CPUs.
        WorkerError: no cluster, or no host comes.
    """

    pool: HostPool

    def __init__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from, on every machine
        num_worlds: int,  # W
        workers: int | None,  # m, from 1 to W; None: as many as the cluster has free CPUs
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
    ) -> None:
        self.world = world
        self.in_next_step = in_next_step
        config = world.config
        refuse_external(config.v2x)
        refuse_watched(
            config.zones, "of worlds on hosts", "run them on this machine; use processes:N"
        )
        refuse_on_hosts(config.workers)
        if not compiled_before():
            LocalWorlds(unwatched(world), 1, warm=True)
        layout = layout_of(config, world.capacity, num_worlds).items()
        self.arrays = StepArrays.of({name: np.zeros(shape, kind) for name, (kind, shape) in layout})
        measures = bool(config.workers.balance_steps)
        recipe = recipe_of(world, base_dir, in_next_step=in_next_step, measures=measures)

        def told(count: int) -> str:
            return json.dumps({**recipe, "size": -(-num_worlds // count)})

        actors = RayActors(host_worlds, told, workers, num_worlds)
        self.placement = StepPlacement(world, num_worlds, actors.workers)
        parts = parts_of(self.placement.plans, world.partition.count)
        self._spent_s = np.zeros((num_worlds, 1))
        if config.workers.balance_steps and actors.workers > 1:
            every, zones = config.workers.balance_steps, world.partition.count
            self.mover = Mover(self.placement, zones, every, self._spent_s)
        program = HostProgram(
            _names(parts),
            tuple(part.last - part.first for part in parts),
            TASK_NAMES,
            Task.STEP,
            code_stamp(),
        )
        try:
            self.pool = HostPool(
                actors, program, config.workers.timeout_s, config.workers.max_retries
            )
        except WorkerFailureError as failure:
            raise own_error(failure) from failure
        self._leaving: dict[int, Array] = {}  # worlds that are on their way
        self._look()

    @property
    def simulation(self) -> Simulation:
        """Refused: the worlds live elsewhere."""
        raise ConfigError(
            "the worlds live on other machines: use backend='local' to look into them"
        )

    def _pids(self) -> Mapping[int, int]:
        return dict.fromkeys(range(len(self._mine)), 0)  # not measured: they run elsewhere

    def _settle(self, parts: list[Part]) -> None:
        self.pool.rename(_names(parts))

    def _look(self) -> None:
        """Note where worlds are by what is committed, whatever was interrupted before."""
        self._sizes = self.pool.sizes
        self._bounds = [0, *accumulate(self._sizes)]
        self._mine = [self.arrays.part(*bounds) for bounds in pairwise(self._bounds)]

    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        if self.pool.sizes != self._sizes:
            self._look()
        if task == Task.PACK:
            self._pack(payload)
        elif task == Task.UNPACK:
            self._unpack(payload)
        else:
            self._carry_out(task, payload, commits)

    def _carry_out(self, task: Task, payload: Any, commits: bool) -> None:
        measures = task == Task.STEP and self.world.config.workers.balance_steps > 0
        spent_s = [np.zeros(size) for size in self._sizes] if measures else []

        def outputs(k: int, ended: Any) -> Arrays:
            return [*results_of(task, self._mine[k], ended), *spent_s[k : k + 1]]

        payloads = [payload] * len(self._mine)
        if task == Task.RESET:  # a host counts its worlds from 0
            firsts = [payload["first_world"] + first for first in self._bounds[:-1]]
            payloads = [{**payload, "first_world": first} for first in firsts]
        inputs = [inputs_of(task, arrays) for arrays in self._mine]
        self.pool.run(task, payloads, inputs, outputs, commits)
        if measures:
            self._spent_s[:, 0] += np.concatenate(spent_s)

    def _pack(self, bounds: Sequence[int]) -> None:
        moves = moves_of(self._bounds, bounds)
        found = [buffers(0, 0) for _ in moves]

        def outputs(k: int, answer: Any) -> Arrays:
            found[k] = buffers(*answer)
            return found[k]

        nothing: list[Arrays] = [()] * len(moves)
        self.pool.run(Task.PACK, moves, nothing, outputs, commits=False)
        self._leaving = {}
        for move, (first, last), (sizes, content) in zip(
            moves, pairwise(self._bounds), found, strict=True
        ):
            kept = range(first + move.first, first + move.last)
            leaving = [world for world in range(first, last) if world not in kept]
            contents = np.split(content, np.cumsum(sizes)[:-1]) if leaving else []
            self._leaving.update(zip(leaving, contents, strict=True))

    def _unpack(self, bounds: Sequence[int]) -> None:
        """Let hosts go on with the worlds that are theirs from now on."""
        moves: list[WorldMove] = []
        inputs: list[Arrays] = []
        for k, move in enumerate(moves_of(self._bounds, bounds)):
            own = range(*self._bounds[k : k + 2])
            kept = own[move.first : move.last]
            wanted = range(*bounds[k : k + 2])
            contents = [self._leaving[world] for world in wanted if world not in kept]
            sizes = np.array([one.size for one in contents], dtype=np.int64)
            moves.append(move._replace(bytes=int(sizes.sum())))
            inputs.append([sizes, *contents])
        after = [last - first for first, last in pairwise(bounds)]
        self.pool.run(Task.UNPACK, moves, inputs, lambda k, answer: (), sizes=after)
        self._leaving = {}
        self._look()

    def _ask(self, task: Task, world: int, payload: Any) -> Any:
        if self.pool.sizes != self._sizes:
            self._look()
        k = bisect_right(self._bounds, world) - 1
        number = world - self._bounds[k]  # a host counts its worlds from 0
        return self.pool.ask(k, task, [number, payload[1]] if task == Task.DRIVEN else number)


def refuse_on_hosts(workers: WorkersConfig) -> None:
    """Refuse what worlds on several machines cannot have."""
    if workers.monitor_cpu:
        raise ConfigError(
            "workers.monitor_cpu = True, backend = 'ray': sees one machine; leave it out "
            "(Ray tells what is reserved on each node), or use backend='processes:N'"
        )
    if workers.sensors:
        raise ConfigError(
            f"workers.sensors = {workers.sensors}, backend = 'ray': sensor workers are on the "
            "machine of the worlds; leave it 0, or use backend='processes:N'"
        )


def _names(parts: Sequence[Part]) -> tuple[str, ...]:
    return tuple(part.names[0] for part in parts)
