"""GNSS: latitude, longitude and height of an antenna."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import GnssConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.antenna_positions import measure_places
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.geodesy import geodesy_of
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


class Gnss(MountedSensor[GnssConfig]):
    """The place of the antenna, with its errors, taken to the earth by the map's projection.

    Attributes:
        geodesy: from the map to the earth and back.
    """

    dtype = np.float64

    def __init__(self, name: str, config: GnssConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self.geodesy = geodesy_of(platform.network, config)
        agents = (platform.num_worlds, platform.num_agents)
        self._places = np.zeros((*agents, 3))
        self._measured = np.zeros(agents, dtype=np.bool_)
        self._noise = noise_of(name, config)
        self._room = np.zeros((2, 3, 3))
        self._measure = specialized(measure_places)

    @staticmethod
    def bounds(config: GnssConfig) -> Bounds:
        """Of the angles; of the height, none."""
        high = np.array([90.0, 180.0, np.inf])
        return -high, high

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        places, measured = self._places, self._measured
        measured[:] = False
        for scene in scenes:
            self._measure(scene.worlds, self.mount, due, self._noise, self._room, places, measured)
        worlds, agents = np.nonzero(measured)
        found = self.geodesy.to_earth(places[worlds, agents])
        frames.data[worlds, agents, due.slot[worlds]] = found
