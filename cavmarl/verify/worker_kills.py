"""Check that killed workers change no result, by comparison with undisturbed worlds."""

from __future__ import annotations

import os
import random
import signal
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Timer
from typing import Any, Unpack

from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.core.machine import describe_hardware
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.backends import find_backend
from cavmarl.parallel.placement.backend_name import PROCESSES, BackendName
from cavmarl.parallel.processes.worker_pool import Death, Pool
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.verify.differences import Arrays, DrivenRun, same_bytes

FIRST_STEPS = 10  # steps without kills, to measure the duration of a step
PINGS = 500
LATEST = 1.5  # latest time of a kill, in durations of a step, so some workers are killed while idle
STOPS = 0.25  # share of workers that are stopped instead of killed


@dataclass(frozen=True)
class Kill:
    """One signal to a worker, and the recovery from it."""

    signal: str  # name of the signal
    worker: int  # index of the worker
    step: int  # step after which the death was noticed
    idle: bool  # whether the worker was idle, so that its next command noticed the death
    cause: str  # cause of the death, according to the pool
    # from the signal (idle worker: from its next command) until the pool noticed the death
    noticed_ms: float
    # from when the pool noticed the death until the successor had received the command
    replaced_ms: float
    # from when the pool noticed the death until the successor had completed the command
    recovered_ms: float


@dataclass(frozen=True)
class KillReport:
    """The result of `verify_kills`."""

    env: str  # name of the environment
    worlds: int  # number of worlds stepped together
    workers: int  # number of workers
    steps: int  # number of compared steps
    different: int | None  # the first step after which anything differed; None: none
    kills: tuple[Kill, ...]
    step_ms: float  # median duration of the steps without a death
    ping_us: float  # median duration of an empty command to all workers, before the first death
    state_hashes: tuple[str, ...]  # hashes of the undisturbed worlds at the end
    hardware: dict[str, Any]  # hardware of this machine

    @property
    def holds(self) -> bool:
        return self.different is None

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


def verify_kills(
    env: str | Path | WorldSpec,
    kills: int,
    *,
    backend: str | None = None,
    workers: int | None = None,
    worlds: int | None = None,
    steps: int | None = None,
    policy: str | Path = "idm",
    zones: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> KillReport:
    """Kill and stop workers at random times and compare everything with undisturbed worlds.

    Args:
        env: see `make_vec`, also for the other keywords; `seed` also seeds the kills.
        kills: number of signals; three in four are SIGKILL, the others SIGSTOP.
        backend: where the worlds run, `processes:N`; default: `processes:2`.
        workers: short form: N for `processes:N`.
        worlds: number of worlds stepped together; default: two per worker.
        steps: number of steps; default: three per kill, after the first steps without kills.
        policy: as in `load_policy`.
        zones: replaces zones.count.
        progress: called with the number of completed steps and of all steps.
        keys: settings of the worlds.

    Raises:
        ConfigError: a number is invalid.
        EvaluationError: a worker died without a signal.
    """
    spec = WorldSpec.of(env, **keys)
    seed = spec.seed
    steps = 3 * kills + FIRST_STEPS if steps is None else steps
    where = find_backend(backend, workers)
    if backend is None and workers is None:
        where = BackendName(PROCESSES, 2)
    if where.kind != PROCESSES or where.count is None:
        raise ConfigError(
            f"backend = '{where}': use 'processes:N' to kill workers; to kill nodes, run "
            "cavmarl verify nodes --nodes N --kill K"
        )
    if kills < 1:
        raise ConfigError(f"kills = {kills}: must be at least 1")
    if steps < kills + FIRST_STEPS:
        raise ConfigError(
            f"steps = {steps}: must be at least {kills + FIRST_STEPS} for {kills} kills"
        )
    worlds = 2 * where.count if worlds is None else worlds
    wanted = {"num_envs": worlds, "zones": zones, **spec.keywords}
    whole = make_vec(spec.env, **wanted)
    parted = make_vec(spec.env, backend=str(where), **wanted)
    try:
        killer = _Killer(_pool(parted), random.Random(seed))
        runs = [DrivenRun(vec, policy, seed) for vec in (whole, parted)]
        ping_us = _ping_us(killer.pool)
        struck = set(killer.random.sample(range(FIRST_STEPS, steps), kills))
        different = None
        for step in range(steps):
            first = runs[0].step()
            second = killer.watch(runs[1].step, step, step in struck)
            if not same_bytes(first, second) or whole.state_hash(
                step % worlds
            ) != parted.state_hash(step % worlds):
                different = step
                break
            if progress is not None:
                progress(step + 1, steps)
        killer.finish(steps)
        hashes = tuple(whole.state_hash(w) for w in range(worlds))
        if different is None and hashes != tuple(parted.state_hash(w) for w in range(worlds)):
            different = steps
    finally:
        parted.close()
    return KillReport(
        spec.env, worlds, where.count, steps, different, tuple(killer.found), killer.step_ms(),
        ping_us, hashes, describe_hardware(),
    )  # fmt: skip


def _pool(vec: CavVectorEnv) -> Pool:
    assert isinstance(vec.worlds, PooledWorlds)
    return vec.worlds.pool


def _ping_us(pool: Pool) -> float:
    """Return the median duration of an empty command to all workers, in µs."""
    found = []
    for _ in range(PINGS):
        began = time.perf_counter()
        pool.ping()
        found.append(time.perf_counter() - began)
    return 1e6 * statistics.median(found)


class _Killer:
    """Sends signals to workers of a pool, and matches the deaths with the signals."""

    def __init__(self, pool: Pool, random: random.Random) -> None:
        self.random = random
        self.found: list[Kill] = []
        self.pool = pool
        self._sent: dict[int, tuple[signal.Signals, float]] = {}  # worker → signal and its time
        self._seen = 0
        self._calm_s: list[float] = []

    def step_ms(self) -> float:
        """Return the median duration of the steps without a death, in ms."""
        return 1000.0 * statistics.median(self._calm_s)

    def watch(self, run: Callable[[], Arrays], step: int, sends_signal: bool) -> Arrays:
        timer = None
        if sends_signal:
            delay_s = self.random.uniform(0.0, LATEST * statistics.median(self._calm_s))
            timer = Timer(delay_s, self._signal, (self._choose(),))
            timer.start()
        began = time.monotonic()
        result = run()
        if timer is None and not self._sent:
            self._calm_s.append(time.monotonic() - began)
        elif timer is not None:
            timer.join()
        self._match(step)
        return result

    def finish(self, step: int) -> None:
        self.pool.ping()
        self._match(step)

    def _choose(self) -> tuple[int, signal.Signals]:
        alive = [k for k in range(len(self.pool.pids)) if k not in self._sent]
        how = signal.SIGSTOP if self.random.random() < STOPS else signal.SIGKILL
        return self.random.choice(alive or [0]), how

    def _signal(self, target: tuple[int, signal.Signals]) -> None:
        worker, how = target
        self._sent[worker] = how, time.monotonic()
        os.kill(self.pool.pids[worker], how)

    def _match(self, step: int) -> None:
        """Match each new death with its signal. Raises EvaluationError: a death had no signal."""
        deaths = self.pool.deaths
        for death in deaths[self._seen :]:
            if death.worker not in self._sent:
                raise EvaluationError(
                    f"worker {death.worker} died without a signal in step {step}: {death.cause}"
                )
            how, sent_s = self._sent.pop(death.worker)
            self.found.append(_kill(death, how, sent_s, step))
            for worker in self.pool.team_of(death.worker):
                if worker in self._sent and self._sent[worker][1] < death.replaced_s:
                    del self._sent[worker]  # this worker was replaced together with the dead worker
        self._seen = len(deaths)


def _kill(death: Death, how: signal.Signals, sent_s: float, step: int) -> Kill:
    return Kill(
        how.name,
        death.worker,
        step,
        sent_s < death.ordered_s,
        death.cause,
        1000.0 * (death.noticed_s - max(sent_s, death.ordered_s)),
        1000.0 * (death.replaced_s - death.noticed_s),
        1000.0 * (death.done_s - death.noticed_s),
    )
