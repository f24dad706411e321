"""The collision and event sensor: it reports when something happens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import CollisionConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.event_reports import report_events
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    stream_of,
)


class Collision(MountedSensor[CollisionConfig]):
    """EVENT_* bits of what has just happened to the vehicle, and what it hit."""

    dtype = np.int64
    stamps_itself = True

    def __init__(self, name: str, config: CollisionConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._platform = platform
        self._stream = stream_of(name)
        self._report = specialized(report_events)

    @staticmethod
    def bounds(config: CollisionConfig) -> Bounds:
        """All that the type can hold."""
        limits = np.iinfo(np.int64)
        return np.array([0, -1]), np.array([limits.max, limits.max])

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Report what has happened in this tick."""
        for scene in scenes:
            self._report(
                scene.worlds,
                scene.before,
                self._platform.ticks_per_step,
                self._platform.sim_dt_s,
                due,
                self._stream,
                self.config.dropout,
                frames.stamp_s,
                frames.lost,
                frames.fresh,
                frames.data,
            )
