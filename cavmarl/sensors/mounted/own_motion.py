"""Sensors of the vehicle itself: odometry, IMU, GNSS, the current lane, and events."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cavmarl.config.rig import (
    CollisionConfig,
    GnssConfig,
    ImuConfig,
    LaneBoundaryConfig,
    OdometryConfig,
)
from cavmarl.sensors.kernels.rig_frames import Due
from cavmarl.sensors.kernels.vehicle_readings import (
    measure_inertia,
    measure_lane_boundary,
    measure_odometry,
    measure_places,
    report_events,
)
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.geodesy import geodesy_of
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    stream_of,
)


class Odometry(MountedSensor[OdometryConfig]):
    """Wheel odometry: speed, yaw rate and travelled distance of the vehicle's centre."""

    dtype = np.float32
    kernel = measure_odometry

    def __init__(self, name: str, config: OdometryConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._scratch = np.zeros(3)

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        return scene.worlds, scene.before, due, self.noise, self._scratch, frames.data


class Imu(MountedSensor[ImuConfig]):
    """Accelerometers and gyroscopes at the sensor's position, along its axes."""

    dtype = np.float32
    kernel = measure_inertia

    def __init__(self, name: str, config: ImuConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._tick_s = platform.sim_dt_s
        self._scratch = np.zeros(6)

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        moved = (scene.worlds, scene.before, self.mount, self._tick_s)
        return (*moved, due, self.noise, self._scratch, frames.data)


class LaneBoundary(MountedSensor[LaneBoundaryConfig]):
    """Lane markings as a camera detects them.

    Measures the distances to both boundaries, and the width, direction and curvature of the current
    lane.
    """

    dtype = np.float32
    kernel = measure_lane_boundary

    def __init__(self, name: str, config: LaneBoundaryConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._axes = np.zeros((2, 3, 3))
        self._scratch = np.zeros(5)

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        seen = (scene.roads, scene.plans, scene.worlds, self.mount, self.config.lookahead_m)
        return (*seen, due, self.noise, self._axes, self._scratch, frames.data)


class Gnss(MountedSensor[GnssConfig]):
    """The position of the antenna, with errors, converted to WGS 84 by the map's projection.

    Attributes:
        geodesy: conversion between map and earth.
    """

    dtype = np.float64
    kernel = measure_places

    def __init__(self, name: str, config: GnssConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self.geodesy = geodesy_of(platform.network, config)
        agents = (platform.num_worlds, platform.num_agents)
        self._places = np.zeros((*agents, 3))
        self._measured = np.zeros(agents, dtype=np.bool_)
        self._scratch = np.zeros((2, 3, 3))

    @staticmethod
    def bounds(config: GnssConfig) -> Bounds:
        high = np.array([90.0, 180.0, np.inf])
        return -high, high

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        measured = (self._places, self._measured)
        return (scene.worlds, self.mount, due, self.noise, self._scratch, *measured)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Measure positions on the map, then convert all of them to the earth at once."""
        self._measured[:] = False
        super().sense(scenes, due, frames)
        worlds, agents = np.nonzero(self._measured)
        found = self.geodesy.to_earth(self._places[worlds, agents])
        frames.data[worlds, agents, due.slot[worlds]] = found


class Collision(MountedSensor[CollisionConfig]):
    """Event sensor: EVENT_* bits of the current tick, and the vehicle that was hit."""

    dtype = np.int64
    kernel = report_events
    stamps_itself = True

    def __init__(self, name: str, config: CollisionConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._clock = (platform.ticks_per_step, platform.sim_dt_s)
        self._stream = stream_of(name)

    @staticmethod
    def bounds(config: CollisionConfig) -> Bounds:
        limits = np.iinfo(np.int64)
        return np.array([0, -1]), np.array([limits.max, limits.max])

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        lost = (self._stream, self.config.dropout, frames.stamp_s, frames.lost, frames.fresh)
        return (scene.worlds, scene.before, *self._clock, due, *lost, frames.data)
