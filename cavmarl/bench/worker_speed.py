"""How much faster worlds are over several workers, and what it costs to have workers at all."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.bench.harness import Result, Say, paired_ratio, silent
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.provenance.machine import describe_hardware
from cavmarl.parallel.pooled_worlds import PooledWorlds
from cavmarl.parallel.processes.worker_pool import Pool

WARM_STEPS = 20
PINGS = 2000  # a turn
IDLE_S = 1.0


@dataclass(frozen=True)
class Row:
    """The same worlds over some number of workers."""

    workers: int  # how many; 0: all in the caller's process
    made_s: float  # until they could be reset
    step_ms: tuple[float, ...]  # of each turn, ms a step
    busiest_ms: float | None  # processor time that the busiest worker took for a step, ms


@dataclass(frozen=True)
class WorkerSpeed(Result):
    """What was measured."""

    DERIVED: ClassVar = ("ratio", "processor_ratio", "cost_of_one", "is_crowded")

    env: str  # of which environment
    worlds: int  # that were stepped together
    steps: int  # of a turn
    rows: tuple[Row, ...]  # no worker, one, and those that were asked for
    # of each empty command to all workers, µs: quantiles 5, 50, 95 and 99 %
    barrier_us: tuple[float, float, float, float]
    idle_s: float  # processor time that idle workers took in a second, s
    hardware: dict[str, Any]  # that it ran on

    @property
    def ratio(self) -> float:
        """How many times faster than one worker; median of the turns, each beside the other."""
        return paired_ratio(self.rows[1].step_ms, self.rows[2].step_ms)

    @property
    def processor_ratio(self) -> float:
        """The same by processor time of the busiest worker: what free cores would lead to."""
        one, many = self.rows[1].busiest_ms, self.rows[2].busiest_ms
        return math.nan if one is None or many is None else one / many

    @property
    def cost_of_one(self) -> float:
        """What a step takes with one worker, over that without; median of the turns."""
        return paired_ratio(self.rows[1].step_ms, self.rows[0].step_ms)

    @property
    def is_crowded(self) -> bool:
        """More workers than cores."""
        return self.rows[2].workers > (self.hardware["usable_cores"] or 1)


def measure_workers(
    env: str | Path,
    *,
    worlds: int = 16,
    workers: int = 2,
    steps: int = 20,
    repeats: int = 7,
    seed: int = 0,
    wanted: Mapping[str, Any] | None = None,
    say: Say = silent,
) -> WorkerSpeed:
    """Step the same worlds without workers, with one, and with several, by turns.

    The agents do what the built-in driver would; that is not timed. Observations are read where
    they lie, as a trainer with tensors of the same memory does.
    """
    if workers < 2 or steps < 1 or repeats < 1:
        raise ConfigError(
            f"{workers} workers, {steps} steps, {repeats} turns: must be at least 2, 1 and 1"
        )
    measured: list[Measured] = []
    try:
        for count in (0, 1, workers):
            say(f"making worlds over {count} workers")
            made = {"num_envs": worlds, "copy": False, **(wanted or {})}
            measured.append(Measured(env, count, seed, made))
        pool = measured[-1].pool
        assert pool is not None
        pings: list[float] = []
        for n in range(repeats):
            say(f"turn {n + 1} of {repeats}")
            for one in measured:
                one.count_turn(steps)
            pings += _pings(pool)
        idle_s = _idle_s(pool)
    finally:
        for one in measured:
            one.vec.close()
    rows = tuple(one.row(repeats * steps) for one in measured)
    low, middle, high, highest = (float(np.quantile(pings, q)) for q in (0.05, 0.5, 0.95, 0.99))
    quantiles = (low, middle, high, highest)
    return WorkerSpeed(str(env), worlds, steps, rows, quantiles, idle_s, describe_hardware())


def drive_ms(vec: CavVectorEnv, steps: int) -> float:
    """Milliseconds a step; what the built-in driver decides for agents is not timed."""
    spent = 0.0
    for _ in range(steps):
        actions = vec.suggest_actions()
        began = time.perf_counter()
        vec.step(actions)
        spent += time.perf_counter() - began
    return 1000.0 * spent / steps


class Measured:
    """Worlds over some number of workers, reset and warm, and what their turns have taken."""

    def __init__(self, env: str | Path, workers: int, seed: int, wanted: Mapping[str, Any]) -> None:
        began = time.perf_counter()
        self.vec = make_vec(env, workers=workers, **wanted)
        self._made_s = time.perf_counter() - began
        worlds = self.vec.worlds
        self.pool = worlds.pool if isinstance(worlds, PooledWorlds) else None
        self._workers = workers
        self._step_ms: list[float] = []
        self._busy_s = np.zeros(workers)
        self.vec.reset(seed=seed)
        drive_ms(self.vec, WARM_STEPS)

    def count_turn(self, steps: int) -> None:
        """One that counts, and as many steps for the processor's time: to ask for it takes some."""
        self._step_ms.append(drive_ms(self.vec, steps))
        for _ in range(steps):
            actions = self.vec.suggest_actions()
            before = self._processor_s()
            self.vec.step(actions)
            self._busy_s += self._processor_s() - before

    def row(self, steps: int) -> Row:
        """What has been found in so many steps."""
        busiest = 1000.0 * float(self._busy_s.max()) / steps if self._workers else None
        return Row(self._workers, self._made_s, tuple(self._step_ms), busiest)

    def _processor_s(self) -> NDArray[np.float64]:
        return np.array([] if self.pool is None else self.pool.processor_s())


def _pings(pool: Pool) -> list[float]:
    """Microseconds of empty commands, one after the other."""
    found: list[float] = []
    for _ in range(PINGS):
        began = time.perf_counter()
        pool.ping()
        found.append(1e6 * (time.perf_counter() - began))
    return found


def _idle_s(pool: Pool) -> float:
    """Processor time of idle workers a second."""
    before = sum(pool.processor_s())
    time.sleep(IDLE_S)
    return (sum(pool.processor_s()) - before) / IDLE_S
