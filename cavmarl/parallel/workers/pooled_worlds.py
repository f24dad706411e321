"""`PooledWorlds`: worlds distributed over worker processes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import accumulate, chain, pairwise
from pathlib import Path
from typing import Any

from cavmarl.config.workers import WorkersConfig
from cavmarl.core.errors import ConfigError, WorkerError, WorkerFailureError
from cavmarl.engine.compilation import compiled_before
from cavmarl.engine.world_setup import World
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in, size_of
from cavmarl.parallel.placement.commanded_worlds import CommandedWorlds
from cavmarl.parallel.placement.mover import Mover, MovingMemory
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part, parts_of
from cavmarl.parallel.processes.process_barrier import usable_cores
from cavmarl.parallel.processes.worker_pool import Pool, Program
from cavmarl.parallel.state.checkpoint_log import make_segments
from cavmarl.parallel.state.world_bytes import SavedWorlds
from cavmarl.parallel.worlds.journaled_worlds import refuse_journal, runs_as_text, without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.sensor_worker_setup import warn_if_crowded
from cavmarl.parallel.worlds.step_arrays import StepArrays, layout_of
from cavmarl.parallel.worlds.tasks import TASK_NAMES, Task
from cavmarl.parallel.worlds.world_errors import original_error, refuse_external
from cavmarl.parallel.worlds.world_message import make_world_message

PROGRAM = "cavmarl.parallel.workers.job_factory"


class PooledWorlds(CommandedWorlds):
    """W worlds distributed over m worker processes.

    Raises:
        ConfigError: a setting that worlds in worker processes do not support.
        WorkerError: the processes cannot be started, or there is not enough memory.
    """

    pool: Pool

    def __init__(
        self,
        world: World,
        base_dir: Path,  # folder of relative paths
        num_worlds: int,  # W
        # m, from 1 to W times the number of zones of a world; above W, workers share worlds
        workers: int,
        in_next_step: bool = False,  # whether new episodes start a step later; see `SteppedWorlds`
        program: str | None = None,  # module that the processes run; None: `job_factory`
    ) -> None:
        self.world = world
        self.in_next_step = in_next_step
        config = world.config
        refuse_external(config.v2x)
        self.placement = StepPlacement(world, num_worlds, workers)
        parts = parts_of(self.placement.plans, world.partition.count)
        may_change = bool(config.workers.balance_steps) and workers > 1 and self.placement.in_row
        if may_change and config.zones.repartition_steps:
            refuse_journal(
                config.zones,
                "with workers.balance_steps and zones.repartition_steps: worlds move between "
                "workers, but each worker repartitions its own worlds",
                "set workers.balance_steps or zones.repartition_steps to 0",
            )
        _warn_of_few_cores(workers)
        if not compiled_before():
            LocalWorlds(without_journals(world), 1, warm=True)
        capacity = world.capacity
        layout = layout_of(config, capacity, num_worlds, world.signal_sizes)
        segment = Segment.make(size_of(layout))
        try:
            self.arrays = StepArrays.of(arrays_in(segment.map(), layout))
        except WorkerError:
            segment.close()
            raise
        memory = self._make_mover(num_worlds, workers)
        may_change = self.mover is not None and self.placement.in_row
        if may_change and config.workers.sensors:
            segment.close()
            raise _sensors_belong_to_a_worker(config.workers)
        warn_if_crowded(config.workers.sensors, len(parts))
        logs = [_log_segments(world, part, may_change) for part in parts]
        saved = [Segment.make(0) for _ in parts]
        message = make_world_message(
            world,
            base_dir,
            num_worlds=num_worlds,
            capacity=capacity,
            arrays=segment.fd,
            in_next_step=in_next_step,
            parts=parts,
            checkpoint_logs=[[one.fd for one in log] for log in logs],
            saved_worlds=[one.fd for one in saved],
            runs=runs_as_text(config.zones, num_worlds),
            mover=None if memory is None else memory.message,
        )
        leaders = [0, *accumulate(len(part.zones) for part in parts)]
        teams = tuple(tuple(range(*bounds)) for bounds in pairwise(leaders))
        moving = () if memory is None else memory.segments
        segments = (segment, *chain.from_iterable(logs), *moving, *saved)
        pins = config.workers.pin
        what = Program(
            program or PROGRAM, message, _names(parts), segments, TASK_NAMES, pins, teams
        )
        try:
            timeout_s, retries = config.workers.timeout_s, config.workers.max_retries
            self.pool = Pool(what, timeout_s, retries, bool(config.zones.simulators))
        except WorkerFailureError as failure:
            raise original_error(failure) from failure
        self._saved = [SavedWorlds(one) for one in saved]
        self._parts = parts
        self._leader_of = _leaders(parts)
        self.placement.watch(self._pids())

    def _make_mover(self, num_worlds: int, workers: int) -> MovingMemory | None:
        """Make the mover, and return the memory that its workers share; None: nothing moves."""
        every = self.world.config.workers.balance_steps
        if not every or workers == 1:
            return None
        num_zones, in_row = self.world.partition.count, self.placement.in_row
        memory = MovingMemory(num_worlds, *((1, workers) if in_row else (num_zones, 0)))
        self.mover = Mover(self.placement, num_zones, every, memory.spent_s)
        return memory

    def save_worlds(self) -> list[bytes]:
        self._command(Task.SAVE, commits=False)
        return [world for part in self._saved for world in part.read()]

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        for memory, part in zip(self._saved, self._parts, strict=True):
            memory.write(saved[part.first : part.last])
        self._command(Task.LOAD)

    def _settle(self, parts: list[Part]) -> None:
        self._parts = parts
        self._leader_of = _leaders(parts)
        self.pool.rename(_names(parts))

    def _pids(self) -> dict[int, int]:
        return dict(enumerate(self.pool.pids))

    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        self.pool.run(task, payload, commits)

    def _ask(self, task: Task, world: int, payload: Any) -> Any:
        return self.pool.ask(self._leader_of[world], task, payload)


def _warn_of_few_cores(workers: int) -> None:
    cores = len(usable_cores())
    if workers > cores:
        warnings.warn(
            f"workers = {workers}: there are {cores} cores; more workers than cores are not faster",
            RuntimeWarning,
            stacklevel=5,
        )


def _sensors_belong_to_a_worker(workers: WorkersConfig) -> ConfigError:
    return ConfigError(
        f"workers.balance_steps = {workers.balance_steps} with workers.sensors = "
        f"{workers.sensors}: sensor workers belong to the worlds of one worker, which balancing "
        "moves; set one of the two to 0"
    )


def _log_segments(world: World, part: Part, may_change: bool) -> list[Segment]:
    """Make the memory for the checkpoints of a worker."""
    if may_change:
        return []
    return make_segments(world.config, part.last - part.first, world.signal_sizes.signals)


def _names(parts: list[Part]) -> tuple[str, ...]:
    return tuple(name for part in parts for name in part.names)


def _leaders(parts: list[Part]) -> list[int]:
    firsts = [0, *accumulate(len(part.zones) for part in parts)]
    return [k for k, part in zip(firsts, parts, strict=False) for _ in range(part.first, part.last)]
