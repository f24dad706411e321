"""How long mounted sensors take, each for itself and the ten of `ten_sensors`, on one core.

The sensors are due in every tick and sense the same seeded worlds by turns; times are those of the
processor that this process had.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

import numpy as np

from cavmarl.bench.sharded_worlds import DrivenWorld, world_maker
from cavmarl.bench.step_speed import one_core
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.engine.rig_component import MountedSensors
from cavmarl.engine.simulation import Simulation
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.catalogue import mount

__all__ = ["SensorRow", "SensorSpeed", "measure_sensor_speed"]

ENV = "grid4x4"
CARS_PER_KM2 = 400
AGENTS = 100
WARM_S = 10
TICKS = 20  # of one turn
MAX_REPEATS = 100

DT_S = 0.05
TEN_SENSORS = "ten_sensors"
PLANE_LIDAR = "plane_lidar"
LIDAR = {"type": "lidar", "rays": 64, "z_m": 0.8, "range_m": 100.0}


@dataclass(frozen=True)
class SensorRow:
    """What one sensor takes for one vehicle and tick.

    Attributes:
        name: of the sensor.
        type: of the sensor.
        shape: of one sample.
        numbers: in one sample: rays, pixels, cells or channels.
        low_us: microseconds of the processor a sample, the fastest turn.
        median_us: over the turns.
        high_us: the slowest turn.
    """

    name: str
    type: str
    shape: tuple[int, ...]
    numbers: int
    low_us: float
    median_us: float
    high_us: float


@dataclass(frozen=True)
class SensorSpeed:
    """Result of the measurement.

    Attributes:
        cars_per_km2: vehicles over the area of the map.
        repeats: turns.
        rows: one a sensor.
        lidar_ns: a ray of a plane lidar with 64 rays and a range of 100 m.
        cameras_ms: a depth and a semantic picture.
        tick_ms: all ten sensors of the only vehicle in its world that has any, stamps included.
    """

    cars_per_km2: float
    repeats: int
    rows: tuple[SensorRow, ...]
    lidar_ns: float
    cameras_ms: float
    tick_ms: float

    def to_dict(self) -> dict[str, Any]:
        """As plain types, for JSON."""
        return asdict(self)


def measure_sensor_speed(
    repeats: int = 5, progress: Callable[[str], None] = lambda text: None
) -> SensorSpeed:
    """Measure by turns on one core, kernels warm.

    The rows are means over 100 vehicles of one world with 400 cars a square kilometre; what a tick
    of ten sensors takes is measured in a world in which only one of as many cars has any.

    Args:
        repeats: turns.
        progress: told what is going on.

    Raises:
        ConfigError: a number out of range.
    """
    if not 1 <= repeats <= MAX_REPEATS:
        raise ConfigError(f"repeats = {repeats}: must be from 1 to {MAX_REPEATS}")
    with one_core():
        progress("making the worlds")
        rig = _ten_sensors()
        many = _driven(AGENTS, {**rig, PLANE_LIDAR: {**LIDAR, "rate_hz": 1.0 / DT_S}})
        one = _driven(1, rig)
        sensors = _Sensors(many)
        turns: dict[str, list[float]] = {name: [] for name in many.config.rig}
        ticks = []
        for turn in range(repeats):
            progress(f"turn {turn + 1} of {repeats}")
            for name, times_us in turns.items():
                times_us.append(sensors.time_us(name))
            ticks.append(_tick_ms(one))
    rows = tuple(sensors.row(name, times_us) for name, times_us in turns.items())
    us = {row.type: row.median_us for row in rows}
    lidar = next(row for row in rows if row.name == PLANE_LIDAR)
    return SensorSpeed(
        cars_per_km2=float(many.running()[0]) / _area_km2(many),
        repeats=repeats,
        rows=rows,
        lidar_ns=1e3 * lidar.median_us / lidar.numbers,
        cameras_ms=1e-3 * (us["depth_camera"] + us["semantic_camera"]),
        tick_ms=median(ticks),
    )


def _ten_sensors() -> dict[str, dict[str, Any]]:
    """The rig, with all of it due in every tick."""
    config, _ = load_config(ENV, overrides={"rig": TEN_SENSORS})
    return {
        name: {**asdict(sensor), "rate_hz": 1.0 / DT_S, "phase_ticks": 0}
        for name, sensor in config.rig.items()
    }


def _area_km2(simulation: Simulation) -> float:
    min_x, min_y, max_x, max_y = simulation.network.extent_m
    return (max_x - min_x) * (max_y - min_y) / 1e6


def _driven(agents: int, rig: dict[str, dict[str, Any]]) -> Simulation:
    """A world with so many agents, all sensors due in every tick, some seconds after its reset."""
    probe = world_maker(ENV, seconds=2 * WARM_S, agents=1, background=0)(1)
    cars = round(CARS_PER_KM2 * _area_km2(probe))
    simulation = world_maker(
        ENV,
        seconds=2 * WARM_S,
        agents=agents,
        background=cars - agents,
        overrides={
            "rig": rig,
            "population.budget": None,
            "clock.sim_dt_s": DT_S,
            "clock.ctrl_dt_s": DT_S,
        },
    )(1)
    drive = DrivenWorld(simulation)
    for _ in range(round(WARM_S / DT_S)):
        drive.step(drive.commands())
    return simulation


def _mounted(simulation: Simulation) -> MountedSensors:
    return next(part for part in simulation.attached if isinstance(part, MountedSensors))


class _Sensors:
    """The sensors on all agents of one world, one at a time."""

    def __init__(self, simulation: Simulation) -> None:
        mounted = _mounted(simulation)
        self._scenes = mounted.scenes()
        self._frames = simulation.frames
        self._num = int(simulation.outputs.present.sum())
        sensors = mount(simulation.config.rig, mounted.platform)
        self._sensors = {sensor.name: sensor for sensor in sensors}
        self._due = Due(np.ones(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64))

    def time_us(self, name: str) -> float:
        """Microseconds that one sample of one vehicle takes."""
        sensor, frames = self._sensors[name], self._frames[name]
        sensor.sense(self._scenes, self._due, frames)
        began = time.process_time_ns()
        for _ in range(TICKS):
            sensor.sense(self._scenes, self._due, frames)
        return (time.process_time_ns() - began) / (1e3 * TICKS * self._num)

    def row(self, name: str, times_us: list[float]) -> SensorRow:
        """What was measured."""
        config = self._sensors[name].config
        return SensorRow(
            name=name,
            type=config.type,
            shape=config.shape,
            numbers=int(np.prod(config.shape)),
            low_us=min(times_us),
            median_us=median(times_us),
            high_us=max(times_us),
        )


def _tick_ms(simulation: Simulation) -> float:
    """Milliseconds that all sensors of a world take in one tick."""
    mounted = _mounted(simulation)
    began = time.process_time_ns()
    for _ in range(TICKS):
        mounted.end()
    return (time.process_time_ns() - began) / (1e6 * TICKS)
