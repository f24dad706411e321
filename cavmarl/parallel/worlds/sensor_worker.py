"""The program of sensor workers; `SensorWorkers` starts it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cavmarl.engine.simulation import Simulation
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in
from cavmarl.parallel.processes.worker_loop import serve
from cavmarl.parallel.sensor_workers.sensor_job import SensorJob
from cavmarl.parallel.sensor_workers.sensor_scene import SceneArrays, SceneShape
from cavmarl.parallel.worlds.step_arrays import StepArrays, layout_of
from cavmarl.parallel.worlds.world_message import world_of


def make_sensor_jobs(message: Mapping[str, Any]) -> list[SensorJob]:
    """Make the jobs of all sensor workers, and load all kernels."""
    world = world_of(message)
    config = world.config
    shape = SceneShape(*message["shape"])
    layout = layout_of(config, shape.capacity, message["num_worlds"], world.signal_sizes)
    arrays = StepArrays.of(arrays_in(Segment(message["frames"], 0).map(), layout))
    frames = arrays.part(*message["part"]).frames
    shared = SceneArrays.of(Segment(message["scene"], 0), shape)
    simulation = Simulation(config, world.network, shape.worlds, world.demand, world.partition)
    jobs = [SensorJob(simulation, shared, frames, number) for number in range(shape.workers)]
    jobs[0].warm()
    return jobs


if __name__ == "__main__":
    serve(make_sensor_jobs)
