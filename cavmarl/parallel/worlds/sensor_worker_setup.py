"""Worlds of this process with sensor workers, and the message that starts these workers."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

from cavmarl.config.workers import WorkersConfig
from cavmarl.config.zones import ZonesConfig
from cavmarl.engine.world_setup import World
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in, size_of
from cavmarl.parallel.processes.process_barrier import usable_cores
from cavmarl.parallel.sensor_workers.sensor_pool import SensorWorkerPlan, SensorWorkers
from cavmarl.parallel.sensor_workers.sensor_scene import SceneShape
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.step_arrays import StepArrays, layout_of
from cavmarl.parallel.worlds.world_message import make_world_message
from cavmarl.sensors.registry import type_of
from cavmarl.shards.shard import override_columns

PROGRAM = "cavmarl.parallel.worlds.sensor_worker"


def local_worlds(
    world: World, base_dir: Path, num_worlds: int, in_next_step: bool = False
) -> LocalWorlds:
    """Make worlds of this process, with `workers.sensors` sensor workers.

    Raises:
        WorkerError: there is not enough shared memory.
    """
    config = world.config
    if not config.workers.sensors:
        return LocalWorlds(world, num_worlds, in_next_step=in_next_step)
    warn_if_crowded(config.workers.sensors, 1)
    layout = layout_of(config, world.capacity, num_worlds, world.signal_sizes)
    segment = Segment.make(size_of(layout))
    arrays = StepArrays.of(arrays_in(segment.map(), layout))
    worlds = LocalWorlds(world, num_worlds, arrays, in_next_step=in_next_step)
    worlds.attach_sensor_workers(
        sensor_workers_of(world, base_dir, segment, (0, num_worlds), num_worlds)
    )
    return worlds


def warn_if_crowded(sensor_workers: int, times: int) -> None:
    """Warn if the sensor workers of `times` processes are more than the cores."""
    cores = len(usable_cores())
    if sensor_workers * times > cores:
        warnings.warn(
            f"{sensor_workers * times} sensor workers: there are {cores} cores; more workers than "
            "cores are not faster",
            RuntimeWarning,
            stacklevel=5,
        )


def sensor_workers_of(
    world: World, base_dir: Path, arrays: Segment, part: tuple[int, int], num_worlds: int
) -> SensorWorkers:
    """Return the sensor workers of worlds `part`; their first call starts the processes."""
    config = world.config
    first, last = part
    shape = SceneShape(
        worlds=last - first,
        capacity=world.capacity,
        agents=config.population.num_ids,
        signals=len(world.network.signals) + override_columns(config, world.network),
        sensors=len(config.rig),
        workers=config.workers.sensors,
    )
    # The same environment without zones and without sensor workers.
    undivided = replace(config, zones=ZonesConfig(), workers=WorkersConfig())
    message = make_world_message(
        world._replace(config=undivided), base_dir, part=part, num_worlds=num_worlds
    )
    lines = tuple(type_of(name, sensor).num_lines(sensor) for name, sensor in config.rig.items())
    return SensorWorkers(SensorWorkerPlan(PROGRAM, message, arrays, shape, lines, config.workers))
