"""Speedup by workers, cost of workers, and the limit that the machine sets.

The limit of the machine is the speedup of independent programs that run at the same time. Workers
cannot exceed it. It is less than the number of cores if cores share memory, caches or clocks, or if
other programs run.
"""

from __future__ import annotations

import math
import multiprocessing
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.bench.harness import Say, paired_ratio, silent
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, WorkerError
from cavmarl.core.machine import describe_hardware
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.processes.worker_pool import Pool
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds

WARM_STEPS = 20
PINGS = 2000  # empty commands per turn
IDLE_S = 1.0
START_S = 300.0  # time limit for a program to start


@dataclass(frozen=True)
class Row:
    """The same worlds over a number of workers."""

    workers: int  # number of workers; 0: all worlds in the caller's process
    made_s: float  # time until the worlds could be reset
    step_ms: tuple[float, ...]  # ms per step in each turn
    busiest_ms: float | None  # processor time per step of the busiest worker, ms


@dataclass(frozen=True)
class WorkerSpeed:
    """Result of `measure_workers`."""

    env: str  # name of the environment
    worlds: int  # number of worlds
    steps: int  # steps per turn
    rows: tuple[Row, ...]  # without workers, with one, and with the requested number
    barrier_us: tuple[
        float, ...
    ]  # time of empty commands to all workers: 5, 50, 95 and 99 % quantiles
    idle_s: float  # processor time of idle workers per second, s
    hardware: dict[str, Any]  # hardware of the machine

    @property
    def ratio(self) -> float:
        """Speedup over one worker; median of the turns, compared pairwise."""
        return paired_ratio(self.rows[1].step_ms, self.rows[2].step_ms)

    @property
    def processor_ratio(self) -> float:
        """Speedup with enough free cores, by the processor time of the busiest worker."""
        one, many = self.rows[1].busiest_ms, self.rows[2].busiest_ms
        return math.nan if one is None or many is None else one / many

    @property
    def cost_of_one(self) -> float:
        """Time of a step with one worker over the time without workers; median of the turns."""
        return paired_ratio(self.rows[1].step_ms, self.rows[0].step_ms)

    @property
    def is_crowded(self) -> bool:
        return self.rows[2].workers > (self.hardware["usable_cores"] or 1)


def measure_workers(
    spec: WorldSpec,
    *,
    worlds: int = 16,
    workers: int = 2,
    steps: int = 20,
    repeats: int = 7,
    say: Say = silent,
) -> WorkerSpeed:
    """Step the same worlds without workers, with one, and with several, in turn.

    The built-in driver drives the agents and is not timed. Observations are not copied, as in a
    training whose tensors share the memory.
    """
    if workers < 2 or steps < 1 or repeats < 1:
        raise ConfigError(
            f"{workers} workers, {steps} steps, {repeats} turns: must be at least 2, 1 and 1"
        )
    measured: list[Measured] = []
    try:
        for count in (0, 1, workers):
            say(f"creating worlds over {count} workers")
            measured.append(Measured(spec, count, num_envs=worlds, copy=False))
        pool = measured[-1].pool
        assert pool is not None
        pings: list[float] = []
        for n in range(repeats):
            say(f"turn {n + 1} of {repeats}")
            for one in measured:
                one.count_turn(steps)
            pings += (1e6 * _timed_s(pool.ping) for _ in range(PINGS))
        before = sum(pool.processor_s())
        time.sleep(IDLE_S)
        idle_s = (sum(pool.processor_s()) - before) / IDLE_S
    finally:
        for one in measured:
            one.vec.close()
    rows = tuple(one.row(repeats * steps) for one in measured)
    quantiles = tuple(np.quantile(pings, (0.05, 0.5, 0.95, 0.99)).tolist())
    return WorkerSpeed(spec.env, worlds, steps, rows, quantiles, idle_s, describe_hardware())


def _timed_s(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def drive_ms(vec: CavVectorEnv, steps: int) -> float:
    """Return ms per step; decisions of the built-in driver are not timed."""
    spent_s = sum(_timed_s(partial(vec.step, vec.suggest_actions())) for _ in range(steps))
    return 1000.0 * spent_s / steps


class Measured:
    """Worlds on a number of workers, after a warm-up, with the times of their turns."""

    def __init__(self, spec: WorldSpec, workers: int, **more: Any) -> None:
        began = time.perf_counter()
        self.vec = make_vec(spec.env, workers=workers, **spec.keywords, **more)
        self._made_s = time.perf_counter() - began
        worlds = self.vec.worlds
        self.pool: Pool | None = worlds.pool if isinstance(worlds, PooledWorlds) else None
        self._workers = workers
        self._step_ms: list[float] = []
        self._busy_s = np.zeros(workers)
        self.vec.reset(seed=spec.seed)
        drive_ms(self.vec, WARM_STEPS)

    def count_turn(self, steps: int) -> None:
        """Run a timed turn, and then equally many steps to measure processor time."""
        self._step_ms.append(drive_ms(self.vec, steps))
        for _ in range(steps):
            actions = self.vec.suggest_actions()
            before = self._processor_s()
            self.vec.step(actions)
            self._busy_s += self._processor_s() - before

    def row(self, steps: int) -> Row:
        busiest = 1000.0 * float(self._busy_s.max()) / steps if self._workers else None
        return Row(self._workers, self._made_s, tuple(self._step_ms), busiest)

    def _processor_s(self) -> NDArray[np.float64]:
        return np.array([] if self.pool is None else self.pool.processor_s())


@dataclass(frozen=True)
class CoreCeiling:
    """Independent programs that step worlds, one at a time and all at once."""

    programs: int  # number of programs
    alone_ms: tuple[float, ...]  # ms per step of all worlds in each turn, one program after another
    together_ms: tuple[
        float, ...
    ]  # ms per step of the slowest program in each turn, while all programs run

    @property
    def ratio(self) -> float:
        """Speedup of running all programs at once; median of the turns."""
        return paired_ratio(self.alone_ms, self.together_ms)

    def facts(self) -> dict[str, Any]:
        """Return plain values for a report."""
        return {**asdict(self), "ratio": self.ratio}


def measure_ceiling(
    env: str | Path | WorldSpec,
    *,
    worlds: int = 16,
    programs: int = 2,
    steps: int = 20,
    repeats: int = 7,
    alike: bool = False,
    **keys: Unpack[WorldKeys],
) -> CoreCeiling:
    """Let independent programs step as many worlds as workers would, without communication."""
    if not 1 <= programs <= worlds:
        raise ConfigError(f"{programs} programs, {worlds} worlds: must be at least one world each")
    spec = WorldSpec.of(env, **keys)
    bounds = [worlds * n // programs for n in range(programs + 1)]
    context = multiprocessing.get_context("spawn")
    wires: list[Connection] = []
    processes = []
    try:
        for first, last in pairwise(bounds):
            ours, theirs = context.Pipe()
            given = (theirs, spec, last - first, 0 if alike else first)
            processes.append(context.Process(target=_serve, args=given, daemon=True))
            before = signal.pthread_sigmask(
                signal.SIG_BLOCK, [signal.SIGINT]
            )  # inherited by the program
            try:
                processes[-1].start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
            wires.append(ours)
        for wire in wires:
            _hear(wire)
        alone, together = [], []
        for _ in range(repeats):
            alone.append(sum(_turn([wire], steps)[0] for wire in wires))
            together.append(max(_turn(wires, steps)))
    finally:
        for wire in wires:
            wire.close()
        for process in processes:
            process.join()
    return CoreCeiling(programs, tuple(alone), tuple(together))


def _turn(wires: list[Connection], steps: int) -> list[float]:
    """Run a turn of all programs at once; return ms per step of each program."""
    for wire in wires:
        wire.send(steps)
    return [_hear(wire) for wire in wires]


def _hear(wire: Connection) -> float:
    try:
        if wire.poll(START_S):
            return float(wire.recv())
    except EOFError as error:
        raise WorkerError(
            "an independent program has ended; see its output on standard error"
        ) from error
    raise WorkerError(f"an independent program did not answer within {START_S:g} s")


def _serve(wire: Connection, spec: WorldSpec, worlds: int, first: int) -> None:
    """Run a program: step on each command until the connection is closed."""
    vec = make_vec(spec.env, num_envs=worlds, copy=False, **spec.keywords)
    vec.reset(seed=spec.seed, options={"first_world": first})
    steps = WARM_STEPS
    while True:
        try:
            wire.send(drive_ms(vec, steps))
            steps = wire.recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
