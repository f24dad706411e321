"""How much faster worlds are over several workers, and what it costs to have workers at all."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.provenance.machine import describe_hardware
from cavmarl.parallel.pooled_worlds import PooledWorlds
from cavmarl.parallel.processes.worker_pool import Pool

__all__ = ["WARM_STEPS", "Measured", "Row", "WorkerSpeed", "measure_workers"]

WARM_STEPS = 20
PINGS = 2000  # a turn
IDLE_S = 1.0


@dataclass(frozen=True)
class Row:
    """The same worlds over some number of workers.

    Attributes:
        workers: how many; 0: all in the caller's process.
        made_s: until they could be reset.
        step_ms: of each turn, ms a step.
        busiest_ms: processor time that the busiest worker took for a step, ms.
    """

    workers: int
    made_s: float
    step_ms: tuple[float, ...]
    busiest_ms: float | None


@dataclass(frozen=True)
class WorkerSpeed:
    """What was measured.

    Attributes:
        env: of which environment.
        worlds: that were stepped together.
        steps: of a turn.
        rows: no worker, one, and those that were asked for.
        barrier_us: of each empty order to all workers, µs: quantiles 5, 50, 95 and 99 %.
        idle_s: processor time that the workers took in a second in which nobody asked, s.
        hardware: that it ran on.
    """

    env: str
    worlds: int
    steps: int
    rows: tuple[Row, ...]
    barrier_us: tuple[float, float, float, float]
    idle_s: float
    hardware: dict[str, Any]

    @property
    def ratio(self) -> float:
        """How many times faster than one worker; median of the turns, each beside the other."""
        one, many = self.rows[1].step_ms, self.rows[2].step_ms
        return statistics.median(a / b for a, b in zip(one, many, strict=True))

    @property
    def processor_ratio(self) -> float:
        """The same by processor time of the busiest worker: what free cores would lead to."""
        one, many = self.rows[1].busiest_ms, self.rows[2].busiest_ms
        return math.nan if one is None or many is None else one / many

    @property
    def cost_of_one(self) -> float:
        """What a step takes with one worker, over that without; median of the turns."""
        none, one = self.rows[0].step_ms, self.rows[1].step_ms
        return statistics.median(b / a for a, b in zip(none, one, strict=True))

    @property
    def is_crowded(self) -> bool:
        """More workers than cores."""
        return self.rows[2].workers > (self.hardware["usable_cores"] or 1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        ratios = {
            "ratio": self.ratio,
            "processor_ratio": self.processor_ratio,
            "cost_of_one": self.cost_of_one,
        }
        return {**asdict(self), **ratios, "is_crowded": self.is_crowded}


def measure_workers(
    env: str | Path,
    *,
    worlds: int = 16,
    workers: int = 2,
    steps: int = 20,
    repeats: int = 7,
    seed: int = 0,
    agents: int | None = None,
    background: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> WorkerSpeed:
    """Step the same worlds without workers, with one, and with several, by turns.

    The agents do what the built-in driver would; that is not timed. Observations are read where
    they lie, as a trainer with tensors of the same memory does.

    Args:
        env: as in `make_vec`.
        worlds: stepped together.
        workers: how many are compared with one.
        steps: of a turn.
        repeats: turns of each.
        seed: root of all random numbers.
        agents: shadows population.agents.
        background: shadows population.background.
        overrides: values for any other key.
        say: told what is being done.

    Raises:
        ConfigError: numbers that cannot be.
        WorkerError: workers cannot be started.
    """
    if workers < 2 or steps < 1 or repeats < 1:
        raise ConfigError(
            f"{workers} workers, {steps} steps, {repeats} turns: must be at least 2, 1 and 1"
        )
    measured: list[Measured] = []
    try:
        for count in (0, 1, workers):
            say(f"making worlds over {count} workers")
            began = time.perf_counter()
            vec = make_vec(
                env,
                num_envs=worlds,
                workers=count,
                agents=agents,
                background=background,
                overrides=overrides,
                copy=False,
            )
            measured.append(Measured(vec, count, time.perf_counter() - began))
            vec.reset(seed=seed)
            measured[-1].turn(WARM_STEPS)
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


class Measured:
    """Worlds over some number of workers, and what their turns have taken."""

    def __init__(self, vec: CavVectorEnv, workers: int, made_s: float) -> None:
        self.vec = vec
        self.pool = vec.worlds.pool if isinstance(vec.worlds, PooledWorlds) else None
        self._workers = workers
        self._made_s = made_s
        self._step_ms: list[float] = []
        self._busy_s = np.zeros(workers)

    def turn(self, steps: int) -> float:
        """Milliseconds a step; what the agents decide is not timed."""
        spent = 0.0
        for _ in range(steps):
            actions = self.vec.suggest_actions()
            began = time.perf_counter()
            self.vec.step(actions)
            spent += time.perf_counter() - began
        return 1000.0 * spent / steps

    def count_turn(self, steps: int) -> None:
        """One that counts, and as many steps for the processor's time: to ask for it takes some."""
        self._step_ms.append(self.turn(steps))
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
    """Microseconds of empty orders, one after the other."""
    found: list[float] = []
    for _ in range(PINGS):
        began = time.perf_counter()
        pool.ping()
        found.append(1e6 * (time.perf_counter() - began))
    return found


def _idle_s(pool: Pool) -> float:
    """Processor time of the workers a second while nobody asks for anything."""
    before = sum(pool.processor_s())
    time.sleep(IDLE_S)
    return (sum(pool.processor_s()) - before) / IDLE_S
