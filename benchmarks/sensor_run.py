"""One run of a world with sensor workers, step by step, and its measurements.

Time outside of all parts is not measured, so the sum of the parts may be less than the step.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.stopwatch import Stopwatch
from cavmarl.config.env import EnvConfig
from cavmarl.config.io import read_yaml
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.sensor_workers.sensor_pool import SensorWorkers, SensorWorkerTimes
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.sensors.registry import type_of

Rig = dict[str, dict[str, Any]]

WINDOW = 25  # number of steps

PARTS = (
    "physics", "SUMO", "ghosts", "transfers", "sensor compute", "sensor transport", "barrier",
    "observation", "environment",
)  # fmt: skip
# Calls of the runtime by part. All other calls of executor and traffic are physics. `SUMO` is the
# time of waiting for SUMO's step and of processing its results.
_PART_OF = {
    **dict.fromkeys(("step", "mirror", "forgive", "let_in", "order", "send_on", "show"), "SUMO"),
    "exchange": "ghosts",
    **dict.fromkeys(("begin", "end", "left", "entered", "save"), "transfers"),
    **dict.fromkeys(("sense", "clear_outputs", "settle_outputs", "credit"), "observation"),
}


_PLACE = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def load_rig(path: Path) -> Rig:
    """Read the sensors in a file, with the structure of `rig` in env.yaml."""
    found = read_yaml(path)
    if not isinstance(found, Mapping) or not all(
        isinstance(sensor, Mapping) for sensor in found.values()
    ):
        raise ConfigError(f"{path}: must contain sensors by name, as under rig in env.yaml")
    return {name: dict(sensor) for name, sensor in found.items()}


def describe_rig(config: EnvConfig) -> list[dict[str, Any]]:
    """Return type, resolution, lines, rate and placement of each sensor of an environment."""
    return [
        {
            "name": name,
            "type": getattr(sensor, "type", type(sensor).__name__),
            "resolution": list(sensor.shape),
            "lines": type_of(name, sensor).num_lines(sensor),
            "rate_hz": getattr(sensor, "rate_hz", None),
            "placement": {key: getattr(sensor, key) for key in _PLACE},
        }
        for name, sensor in config.rig.items()
    ]


@dataclass(frozen=True)
class SensorJob:
    """A run to measure."""

    spec: WorldSpec  # the agents have the rig
    sensor_workers: int  # number of sensor workers
    warmup: int  # unmeasured steps
    steps: int  # measured steps


@dataclass(frozen=True)
class Window:
    """Resources used by a number of steps, over all processes."""

    steps: int  # number of steps
    leader_cpu_s: float  # processor time of the process with the state
    worker_cpu_s: tuple[float, ...]  # processor time of each sensor worker
    leader_rss_mb: float  # resident memory at the end, including shared memory
    worker_rss_mb: tuple[float, ...]  # resident memory of each sensor worker
    sent_bytes: int  # input of the workers
    got_bytes: int  # frames written by the workers
    messages: int  # orders and answers


@dataclass(frozen=True)
class SensorRun:
    """Result of a run."""

    step_ms: tuple[float, ...]  # time of each `step`
    wait_ms: tuple[float, ...]  # part of this time that waits for sensor workers
    parts_ms: dict[str, tuple[float, ...]]  # per step, by the names of `PARTS`
    windows: tuple[Window, ...]  # used resources, by windows of steps
    costs_ms: tuple[float, ...]  # processor time of one agent's frame of each sensor
    sensors: list[dict[str, Any]]  # type, resolution, rate and placement of each
    digests: tuple[str, ...]  # hashes of state and frames, after warm-up steps and the last
    ticks_per_step: int
    deaths: int  # number of replaced sensor workers


def run_sensors(job: SensorJob) -> SensorRun:
    """Run a job in this process; the built-in driver drives the agents and is not timed."""
    spec = job.spec
    vec = make_vec(spec.env, sensor_workers=job.sensor_workers, copy=False, **spec.keywords)
    try:
        vec.reset(seed=spec.seed)
        timed = _Timed(vec)
        for _ in range(job.warmup):
            timed.step()
            timed.digest()
        timed.clear()
        windows = []
        for first in range(0, job.steps, WINDOW):
            windows.append(timed.window(min(WINDOW, job.steps - first)))
        timed.digest()
        return timed.run(tuple(windows))
    finally:
        vec.close()


class _Timed:
    """A world with stopwatches on its parts."""

    def __init__(self, vec: CavVectorEnv) -> None:
        worlds = vec.worlds
        assert isinstance(worlds, LocalWorlds)
        assert worlds.sensor_workers is not None
        self._vec = vec
        self._sensor_workers: SensorWorkers = worlds.sensor_workers
        self._runtime, self._rig, self._ticks = (Stopwatch(time.perf_counter_ns) for _ in range(3))
        simulation = vec.simulation
        simulation.instrument(self._runtime.around)
        mounted = simulation.mounted
        assert mounted is not None
        self._digests: list[str] = []
        mounted.rig = self._rig.around(mounted.rig)
        simulation.run_tick = self._ticks.around(simulation).run_tick  # type: ignore[method-assign]
        self.clear()

    def clear(self) -> None:
        self._step_ms: list[float] = []
        self._wait_ms: list[float] = []
        self._parts_ms: dict[str, list[float]] = {name: [] for name in PARTS}

    def window(self, steps: int) -> Window:
        pool = self._sensor_workers.pool
        assert pool is not None
        before, began = copy.copy(self._sensor_workers.times), pool.processor_s()
        leader_s = sum(self.step() for _ in range(steps))
        ended, moved = pool.processor_s(), self._sensor_workers.times.since(before)
        return Window(
            steps,
            leader_s,
            tuple(b - a for a, b in zip(began, ended, strict=True)),
            _resident_mb(os.getpid()),
            tuple(map(_resident_mb, pool.pids)),
            moved.sent_bytes,
            moved.got_bytes,
            moved.messages,
        )

    def step(self) -> float:
        """Run one step and return its processor time in this process, s."""
        vec = self._vec
        actions = vec.suggest_actions()
        for watch in (self._runtime, self._rig, self._ticks):
            watch.clear()
        before, simulated_s = copy.copy(self._sensor_workers.times), vec.simulated_s
        began_cpu, began = time.process_time(), time.perf_counter()
        vec.step(actions)
        step_s = time.perf_counter() - began
        cpu_s = time.process_time() - began_cpu
        times = self._sensor_workers.times.since(before)
        self._note(step_s, vec.simulated_s - simulated_s, times)
        return cpu_s

    def _note(self, step_s: float, simulated_s: float, times: SensorWorkerTimes) -> None:
        self._step_ms.append(1e3 * step_s)
        self._wait_ms.append(1e3 * times.wait_s)
        parts = dict.fromkeys(PARTS, 0.0)
        for name, ns in self._runtime.phases().items():
            parts[_PART_OF.get(name, "physics")] += 1e-9 * ns
        rig_s = 1e-9 * sum(self._rig.phases().values())
        parts["sensor compute"] = times.busy_s + times.own_s
        parts["barrier"] = times.wait_s - times.busy_s
        parts["sensor transport"] = rig_s - times.own_s - times.wait_s
        ticks_s = 1e-9 * sum(self._ticks.phases().values())
        parts["environment"] = step_s - simulated_s + max(0.0, simulated_s - ticks_s)
        for name, part_s in parts.items():
            self._parts_ms[name].append(1e3 * part_s)

    def digest(self) -> None:
        """Record the state's hash; not for measured steps, because it reads all frames."""
        self._digests.append(self._vec.state_hash())

    def run(self, windows: tuple[Window, ...]) -> SensorRun:
        config = self._vec.config
        return SensorRun(
            tuple(self._step_ms),
            tuple(self._wait_ms),
            {name: tuple(values) for name, values in self._parts_ms.items()},
            windows,
            tuple(float(1e3 * cost_s) for cost_s in self._sensor_workers.costs_s),
            describe_rig(config),
            tuple(self._digests),
            config.clock.ticks_per_step,
            len(self._sensor_workers.deaths),
        )


def _resident_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
