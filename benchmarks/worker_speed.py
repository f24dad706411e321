"""How much faster worlds are over several workers, what workers cost, and what the machine allows.

The machine's ceiling is how much faster programs are side by side that share nothing. No number of
workers can do better. It is less than the number of cores where cores share memory, caches or
clocks, and where other programs run.
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
PINGS = 2000  # a turn
IDLE_S = 1.0
START_S = 300.0  # that a program may take until its worlds can be stepped


@dataclass(frozen=True)
class Row:
    """The same worlds over some number of workers."""

    workers: int  # how many; 0: all in the caller's process
    made_s: float  # until they could be reset
    step_ms: tuple[float, ...]  # of each turn, ms a step
    busiest_ms: float | None  # processor time that the busiest worker took for a step, ms


@dataclass(frozen=True)
class WorkerSpeed:
    """What was measured."""

    env: str  # of which environment
    worlds: int  # that were stepped together
    steps: int  # of a turn
    rows: tuple[Row, ...]  # no worker, one, and those that were asked for
    barrier_us: tuple[float, ...]  # of empty commands to all workers: quantiles 5, 50, 95 and 99 %
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
    """Milliseconds a step; what the built-in driver decides for agents is not timed."""
    spent_s = sum(_timed_s(partial(vec.step, vec.suggest_actions())) for _ in range(steps))
    return 1000.0 * spent_s / steps


class Measured:
    """Worlds over some number of workers, reset and warm, and what their turns have taken."""

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
        """One that counts, and as many steps for the processor's time: to ask for it takes some."""
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
    """Programs of their own that step worlds, one at a time and all at once."""

    programs: int  # how many
    alone_ms: tuple[float, ...]  # of each turn, ms a step of all worlds, one program after another
    together_ms: tuple[float, ...]  # of each turn, ms a step of the slowest program while all run

    @property
    def ratio(self) -> float:
        """How many times faster all at once are; median of the turns."""
        return paired_ratio(self.alone_ms, self.together_ms)

    def facts(self) -> dict[str, Any]:
        """Return plain values, for a report."""
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
    """Let programs step as many worlds as workers would, without any command."""
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
            before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # for the program
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
    """Milliseconds a step of each program, all at once."""
    for wire in wires:
        wire.send(steps)
    return [_hear(wire) for wire in wires]


def _hear(wire: Connection) -> float:
    try:
        if wire.poll(START_S):
            return float(wire.recv())
    except EOFError as error:
        raise WorkerError(
            "a program that steps worlds by itself has ended; what it printed stands on standard "
            "error"
        ) from error
    raise WorkerError(f"a program that steps worlds by itself said nothing for {START_S:g} s")


def _serve(wire: Connection, spec: WorldSpec, worlds: int, first: int) -> None:
    """One program: as many steps as it is told, until the connection is closed."""
    vec = make_vec(spec.env, num_envs=worlds, copy=False, **spec.keywords)
    vec.reset(seed=spec.seed, options={"first_world": first})
    steps = WARM_STEPS
    while True:
        try:
            wire.send(drive_ms(vec, steps))
            steps = wire.recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
