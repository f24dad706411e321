"""Sensor workers of some worlds: what they are told, and the jobs that they make of it."""

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

PROGRAM = "cavmarl.parallel.worlds.sensor_worker"


def local_worlds(
    world: World, base_dir: Path, num_worlds: int, in_next_step: bool = False
) -> LocalWorlds:
    """Worlds of this process, with as many sensor workers as `workers.sensors` says.

    Raises:
        WorkerError: there is no memory that processes could share.
    """
    config = world.config
    if not config.workers.sensors:
        return LocalWorlds(world, num_worlds, in_next_step=in_next_step)
    warn_if_crowded(config.workers.sensors, 1)
    layout = layout_of(config, world.capacity, num_worlds)
    segment = Segment.make(size_of(layout))
    arrays = StepArrays.of(arrays_in(segment.map(), layout))
    worlds = LocalWorlds(world, num_worlds, arrays, in_next_step=in_next_step)
    worlds.attach_sensor_workers(
        sensor_workers_of(world, base_dir, segment, (0, num_worlds), num_worlds)
    )
    return worlds


def warn_if_crowded(sensor_workers: int, times: int) -> None:
    """Warn of more sensor workers than cores; `times` processes have so many each."""
    cores = len(usable_cores())
    if sensor_workers * times > cores:
        warnings.warn(
            f"{sensor_workers * times} sensor workers: there are {cores} cores; more workers than "
            "cores do not make it faster",
            RuntimeWarning,
            stacklevel=5,
        )


def sensor_workers_of(
    world: World, base_dir: Path, arrays: Segment, part: tuple[int, int], num_worlds: int
) -> SensorWorkers:
    """The sensor workers of some worlds, to be started when they are needed."""
    config = world.config
    first, last = part
    shape = SceneShape(
        worlds=last - first,
        capacity=world.capacity,
        agents=config.population.num_ids,
        signals=len(world.network.signals),
        sensors=len(config.rig),
        workers=config.workers.sensors,
    )
    # The same environment with all zones in one, and no sensor workers.
    undivided = replace(config, zones=ZonesConfig(), workers=WorkersConfig())
    message = make_world_message(
        world._replace(config=undivided), base_dir, part=part, num_worlds=num_worlds
    )
    lines = tuple(type_of(name, sensor).num_lines(sensor) for name, sensor in config.rig.items())
    return SensorWorkers(SensorWorkerPlan(PROGRAM, message, arrays, shape, lines, config.workers))
