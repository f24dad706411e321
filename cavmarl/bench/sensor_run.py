"""One run of a world with sensor workers, step by step: a program, and what it gives.

It reads a job as JSON from standard input and writes a run as JSON to standard output. What is in
no part has not been timed: the parts are not made to sum up.
"""

from __future__ import annotations

import copy
import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cavmarl.bench.sensor_rig import describe_rig
from cavmarl.bench.stopwatch import Stopwatch
from cavmarl.core import errors
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.sensor_workers.sensor_pool import SensorWorkers, SensorWorkerTimes

WINDOW = 25  # steps

PARTS = (
    "physics", "SUMO", "ghosts", "transfers", "sensor compute", "sensor transport", "barrier",
    "observation", "environment",
)  # fmt: skip
# Calls of the runtime that belong to a part; the executor's and the traffic's others are physics.
# Those of SUMO's side are its own step, for which this process waits, and what comes of it here.
_PART_OF = {
    **dict.fromkeys(("step", "mirror", "forgive", "let_in", "order", "send_on", "show"), "SUMO"),
    "exchange": "ghosts",
    **dict.fromkeys(("begin", "end", "left", "entered", "save"), "transfers"),
    **dict.fromkeys(("sense", "clear_outputs", "settle_outputs", "credit"), "observation"),
}


@dataclass(frozen=True)
class SensorJob:
    """What to run."""

    env: str  # as in `make_vec`
    overrides: Mapping[str, Any]  # of its settings
    agents: int  # each with a rig
    background: int  # vehicles that are sensed
    sensor_workers: int  # how many
    warmup: int  # steps that do not count
    steps: int  # that do
    seed: int  # root of all random numbers


@dataclass(frozen=True)
class Window:
    """What some steps have taken, all processes together."""

    steps: int  # how many
    leader_cpu_s: float  # processor time of the process that keeps the state
    worker_cpu_s: tuple[float, ...]  # of each sensor worker
    leader_rss_mb: float  # resident memory at the end, shared memory among it
    worker_rss_mb: tuple[float, ...]  # of each sensor worker
    sent_bytes: int  # that workers were given to read
    got_bytes: int  # of frames that they have written
    messages: int  # orders and answers


@dataclass(frozen=True)
class SensorRun:
    """What was found."""

    # of each step, tick and sensors; checking actions and copying results among it
    step_ms: tuple[float, ...]
    wait_ms: tuple[float, ...]  # of that, waiting for sensor workers
    parts_ms: dict[str, tuple[float, ...]]  # of each step, by the names of `PARTS`
    windows: tuple[Window, ...]  # resources
    costs_ms: tuple[float, ...]  # processor time of one agent's frame of each sensor
    sensors: list[dict[str, Any]]  # type, resolution, rate and placement of each
    # of the state, all frames among it, after each step of the warm-up and the last one
    digests: tuple[str, ...]
    ticks_per_step: int  # ticks of a step
    deaths: int  # sensor workers that had to be replaced


def run_sensors(job: SensorJob) -> SensorRun:
    """Run a job in this process; agents are driven by the built-in driver, which is not timed."""
    vec = make_vec(
        job.env,
        agents=job.agents,
        background=job.background,
        sensor_workers=job.sensor_workers,
        overrides=job.overrides,
        copy=False,
    )
    try:
        vec.reset(seed=job.seed)
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
        assert worlds.farm is not None
        self._vec = vec
        self._farm: SensorWorkers = worlds.farm
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
        """Forget what there was."""
        self._step_ms: list[float] = []
        self._wait_ms: list[float] = []
        self._parts_ms: dict[str, list[float]] = {name: [] for name in PARTS}

    def window(self, steps: int) -> Window:
        """Some steps, and what they have taken."""
        pool = self._farm.pool
        assert pool is not None
        before, began = copy.copy(self._farm.times), pool.processor_s()
        leader_s = sum(self.step() for _ in range(steps))
        ended, moved = pool.processor_s(), self._farm.times.since(before)
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
        """One step; the processor time that it has taken here, s."""
        vec = self._vec
        actions = vec.suggest_actions()
        for watch in (self._runtime, self._rig, self._ticks):
            watch.clear()
        before, simulated_s = copy.copy(self._farm.times), vec.simulated_s
        began_cpu, began = time.process_time(), time.perf_counter()
        vec.step(actions)
        step_s = time.perf_counter() - began
        cpu_s = time.process_time() - began_cpu
        farm = self._farm.times.since(before)
        self._note(step_s, vec.simulated_s - simulated_s, farm)
        return cpu_s

    def _note(self, step_s: float, simulated_s: float, farm: SensorWorkerTimes) -> None:
        self._step_ms.append(1e3 * step_s)
        self._wait_ms.append(1e3 * farm.wait_s)
        parts = dict.fromkeys(PARTS, 0.0)
        for name, ns in self._runtime.phases().items():
            parts[_PART_OF.get(name, "physics")] += 1e-9 * ns
        rig_s = 1e-9 * sum(self._rig.phases().values())
        parts["sensor compute"] = farm.busy_s + farm.own_s
        parts["barrier"] = farm.wait_s - farm.busy_s
        parts["sensor transport"] = rig_s - farm.own_s - farm.wait_s
        ticks_s = 1e-9 * sum(self._ticks.phases().values())
        parts["environment"] = step_s - simulated_s + max(0.0, simulated_s - ticks_s)
        for name, part_s in parts.items():
            self._parts_ms[name].append(1e3 * part_s)

    def digest(self) -> None:
        """Note the state; not between steps that count, since it goes through all frames."""
        self._digests.append(self._vec.state_hash())

    def run(self, windows: tuple[Window, ...]) -> SensorRun:
        """All that was found."""
        config = self._vec.config
        return SensorRun(
            tuple(self._step_ms),
            tuple(self._wait_ms),
            {name: tuple(values) for name, values in self._parts_ms.items()},
            windows,
            tuple(float(1e3 * cost_s) for cost_s in self._farm.costs_s),
            describe_rig(config),
            tuple(self._digests),
            config.clock.ticks_per_step,
            len(self._farm.deaths),
        )


def _resident_mb(pid: int) -> float:
    """Memory of a process that is in use."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """The program."""
    job = SensorJob(**json.load(sys.stdin))
    try:
        told = asdict(run_sensors(job))
    except errors.CavmarlError as error:
        told = {"error": type(error).__name__, "message": str(error)}
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
