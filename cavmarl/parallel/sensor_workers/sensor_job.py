"""`SensorJob`: what a sensor worker does. It keeps nothing from one command to the next."""

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
    """What a sensor worker can be asked for."""

    SENSE = 0


class SensorJob(Job):
    """Senses for the agents of its share, as a zone would that owned them and saw all others."""

    def __init__(
        self,
        # undivided worlds of the same environment, without vehicles: the roads, and room for rows
        simulation: Simulation,
        shared: SceneArrays,  # what there is to see
        frames: Frames,  # where the samples go
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
            (place, sensor, shared.due_of(place), frames[sensor.name], shared.lines[number, place])
            for place, sensor in enumerate(mounted.rig.sensors)
            if not sensor.stamps_itself
        ]
        self._spare = np.zeros(1, dtype=VEHICLE)
        self._take_rows = specialized(take_rows)
        self._put_first = specialized(put_first)

    def warm(self) -> None:
        """Have the kernels of all sensors ready; no vehicle is there to be sensed."""
        self._look()
        for _, sensor, due, frames, lines in self._sensors:
            self._own(lines)
            sensor.lines = lines
            sensor.sense(self._scenes, due, frames)

    def perform(self, task: int, payload: Any) -> None:
        began = perf_counter()
        self._look()
        shared, number = self._shared, self._number
        for place, sensor, due, frames, lines in self._sensors:
            if not due.num.any():
                continue
            spent = thread_time()
            if self._own(lines):
                sensor.lines = lines
                sensor.sense(self._scenes, due, frames)
            shared.spent_s[number, place] = thread_time() - spent
            shared.delivered[number, place] = shared.ticks
        shared.busy_s[number] = perf_counter() - began

    def _look(self) -> None:
        """Take the tick that is to be sensed."""
        shared, worlds = self._shared, self._worlds
        self._take_rows(shared.rows, shared.num_rows, worlds.rows)
        worlds.num_rows[:] = shared.num_rows
        worlds.ticks[:] = shared.ticks
        worlds.keys[:] = shared.keys
        worlds.signal_phase[:] = shared.signal_phase

    def _own(self, lines: NDArray[np.int32]) -> int:
        """For how many agents it writes lines (W, A, 2) of a sensor; their rows come first."""
        shared, worlds = self._shared, self._worlds
        return self._put_first(worlds.rows, shared.num_agents, lines, self._spare, worlds.num_owned)
