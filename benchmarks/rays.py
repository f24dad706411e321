"""Times of mounted sensors on one core: each sensor alone, and the whole rig `ten_sensors`.

The sensors are due in every tick and sense the same seeded worlds in turn; times are processor
times of this process.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from functools import partial
from statistics import median
from typing import Annotated, Any

import numpy as np

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, one_core, silent, take_turns
from cavmarl.cli.output import about
from cavmarl.config.registry import load_config
from cavmarl.engine.rig_component import RigComponent
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.built_in_runs import DrivenWorld, world_maker
from cavmarl.sensors.kernels.rig_frames import Due
from cavmarl.sensors.registry import mount

ENV = "grid4x4"
CARS_PER_KM2 = 400
AGENTS = 100
WARM_S = 10
TICKS = 20  # ticks per turn

DT_S = 0.05
TEN_SENSORS = "ten_sensors"
PLANE_LIDAR = "plane_lidar"
TICK = "all ten sensors, a tick"
LIDAR = {"type": "lidar", "rays": 64, "z_m": 0.8, "range_m": 100.0}


def measure(
    repeats: Annotated[int, about("Turns of each sensor.")] = 5, say: Say = silent
) -> BenchmarkReport:
    """Time each sensor of the rig `ten_sensors`, and all together, at 400 cars/km² on one core.

    The rows are means over 100 vehicles of one world. The tick of ten sensors is measured in a
    world of the same density in which only one car has sensors.
    """
    check_range(repeats=(repeats, 1, 100))
    with one_core():
        say("creating the worlds")
        rig = _ten_sensors()
        many = _driven(AGENTS, {**rig, PLANE_LIDAR: {**LIDAR, "rate_hz": 1.0 / DT_S}})
        one = _driven(1, rig)
        sensors = _Sensors(many)
        sides = {name: partial(sensors.time_us, name) for name in many.config.rig}
        turns = take_turns({**sides, TICK: partial(_tick_ms, one)}, repeats, say)
    tick_ms = median(turns.pop(TICK))
    rows = [sensors.row(name, times_us) for name, times_us in turns.items()]
    us = {row["type"]: row["median_us"] for row in rows}
    lidar_ns = next(row["number_ns"] for row in rows if row["name"] == PLANE_LIDAR)
    cameras_ms = 1e-3 * (us["depth_camera"] + us["semantic_camera"])
    density = float(many.running()[0]) / _area_km2(many)
    return BenchmarkReport(
        f"{density:.0f} cars/km², {repeats} turns, one core",
        {
            "sensor": "name",
            "sample": "shape",
            "µs per sample": "median_us:.1f",
            "min": "low_us:.1f",
            "max": "high_us:.1f",
            "ns per number": "number_ns:.1f",
        },
        rows,
        notes=[
            f"the plane lidar takes {lidar_ns:.1f} ns per ray, a depth and a semantic picture "
            f"{cameras_ms:.3f} ms,\nall ten sensors of one vehicle {tick_ms:.2f} ms per tick"
        ],
        facts={
            "cars_per_km2": density,
            "repeats": repeats,
            "lidar_ns": lidar_ns,
            "cameras_ms": cameras_ms,
            "tick_ms": tick_ms,
        },
    )


def _ten_sensors() -> dict[str, dict[str, Any]]:
    """Return the rig, with every sensor due in every tick."""
    config, _ = load_config(ENV, overrides={"rig": TEN_SENSORS})
    return {
        name: {**asdict(sensor), "rate_hz": 1.0 / DT_S, "phase_ticks": 0}
        for name, sensor in config.rig.items()
    }


def _area_km2(simulation: Simulation) -> float:
    min_x, min_y, max_x, max_y = simulation.network.extent_m
    return (max_x - min_x) * (max_y - min_y) / 1e6


def _driven(agents: int, rig: dict[str, dict[str, Any]]) -> Simulation:
    """Create a world of agents whose sensors are due in every tick, and drive it for some time."""
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


def _mounted(simulation: Simulation) -> RigComponent:
    return next(part for part in simulation.attached if isinstance(part, RigComponent))


class _Sensors:
    """The sensors on all agents of one world, used one at a time."""

    def __init__(self, simulation: Simulation) -> None:
        mounted = _mounted(simulation)
        self._scenes = mounted.scenes()
        self._frames = simulation.frames
        self._num = int(simulation.outputs.present.sum())
        sensors = mount(simulation.config.rig, mounted.platform)
        self._sensors = {sensor.name: sensor for sensor in sensors}
        everyone = np.ones(simulation.config.population.num_ids, dtype=np.bool_)
        one = np.ones(1, dtype=np.int64)
        self._due = Due(one, 0 * one, 0 * one, everyone)

    def time_us(self, name: str) -> float:
        """Return the time of one sample of one vehicle, µs."""
        sensor, frames = self._sensors[name], self._frames[name]
        sensor.sense(self._scenes, self._due, frames)
        began = time.process_time_ns()
        for _ in range(TICKS):
            sensor.sense(self._scenes, self._due, frames)
        return (time.process_time_ns() - began) / (1e3 * TICKS * self._num)

    def row(self, name: str, times_us: tuple[float, ...]) -> dict[str, Any]:
        config = self._sensors[name].config
        return {
            "name": name,
            "type": config.type,
            "shape": config.shape,
            "low_us": min(times_us),
            "median_us": median(times_us),
            "high_us": max(times_us),
            "number_ns": 1e3 * median(times_us) / int(np.prod(config.shape)),
        }


def _tick_ms(simulation: Simulation) -> float:
    """Return the time of all sensors of a world in one tick, ms."""
    mounted = _mounted(simulation)
    began = time.process_time_ns()
    for _ in range(TICKS):
        mounted.end()
    return (time.process_time_ns() - began) / (1e6 * TICKS)


if __name__ == "__main__":
    run(measure)
