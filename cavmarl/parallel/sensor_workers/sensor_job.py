"""`SensorJob`: the job of a sensor worker, which keeps no state between commands."""

from __future__ import annotations

from enum import IntEnum
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.simulation import Simulation
from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.sensor_workers.sensor_scene import SceneArrays
from cavmarl.sensors.kernels.sensor_share import put_first, take_rows
from cavmarl.sensors.mounted.frames import Frames


class SensorTask(IntEnum):
    """Tasks of a sensor worker."""

    SENSE = 0


class SensorJob(Job):
    """Senses for its share of the agents, like a zone that owns them and sees all vehicles."""

    def __init__(
        self,
        # undivided worlds of the same environment without vehicles: roads, and room for rows
        simulation: Simulation,
        shared: SceneArrays,  # the scene
        frames: Frames,  # samples are written here
        number: int,
    ) -> None:
        mounted = simulation.mounted
        assert mounted is not None
        (scene,) = mounted.scenes()
        self._shared = shared
        self._number = number
        self._worlds = scene.worlds
        self._scenes = [scene._replace(before=shared.before)]
        self._sensors = [
            (
                place,
                sensor,
                shared.due_of(place, sensor.carriers),
                frames[sensor.name],
                shared.lines[number, place],
            )
            for place, sensor in enumerate(mounted.rig.sensors)
            if not sensor.stamps_itself
        ]
        self._spare = np.zeros(1, dtype=VEHICLE)
        self._take_rows = specialized(take_rows)
        self._put_first = specialized(put_first)

    def warm(self) -> None:
        """Load the kernels of all sensors by sensing an empty scene."""
        self._read_scene()
        for _, sensor, due, frames, lines in self._sensors:
            self._select_agents(lines)
            sensor.lines = lines
            sensor.sense(self._scenes, due, frames)

    def perform(self, task: int, payload: Any) -> None:
        began = perf_counter()
        self._read_scene()
        shared, number = self._shared, self._number
        for place, sensor, due, frames, lines in self._sensors:
            if not due.num.any():
                continue
            spent = thread_time()
            if self._select_agents(lines):
                sensor.lines = lines
                sensor.sense(self._scenes, due, frames)
            shared.spent_s[number, place] = thread_time() - spent
            shared.delivered[number, place] = shared.ticks
        shared.busy_s[number] = perf_counter() - began

    def _read_scene(self) -> None:
        """Copy the scene of the tick to be sensed."""
        shared, worlds = self._shared, self._worlds
        self._take_rows(shared.rows, shared.num_rows, worlds.rows)
        worlds.num_rows[:] = shared.num_rows
        worlds.ticks[:] = shared.ticks
        worlds.keys[:] = shared.keys
        worlds.signal_phase[:] = shared.signal_phase

    def _select_agents(self, lines: NDArray[np.int32]) -> int:
        """Put agents with non-empty `lines` (W, A, 2) first; return the number of these agents."""
        shared, worlds = self._shared, self._worlds
        return self._put_first(worlds.rows, shared.num_agents, lines, self._spare, worlds.num_owned)
