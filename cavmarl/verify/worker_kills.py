"""Checks that killed workers change no result: worlds whose workers are killed, beside others."""

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

FIRST_STEPS = 10  # before any is killed, to know how long a step takes
PINGS = 500
LATEST = 1.5  # of a step's time: some are killed when they are already waiting for the next one
STOPS = 0.25  # share of those that are not killed but stopped


@dataclass(frozen=True)
class Kill:
    """One signal and what became of it."""

    signal: str  # its name
    worker: int  # that got it
    step: int  # after which it was noticed
    idle: bool  # the worker had nothing to do; it was missed when it was to work again
    cause: str  # of the death, as the pool saw it
    # from the signal, or from the next command to one that was idle, until the pool knew
    noticed_ms: float
    replaced_ms: float  # from then until the successor had its order
    recovered_ms: float  # from when the pool knew until the successor had done what was asked for


@dataclass(frozen=True)
class KillReport:
    """What was found."""

    env: str  # of which environment
    worlds: int  # that were stepped together
    workers: int  # over which they were shared out
    steps: int  # that were compared
    different: int | None  # the first step after which anything differed; None: none
    kills: tuple[Kill, ...]  # all of them
    step_ms: float  # median of the steps without a death
    ping_us: float  # median of an empty command to all workers, before the first death
    state_hashes: tuple[str, ...]  # of the undisturbed worlds at the end
    hardware: dict[str, Any]  # that it ran on

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
        env: as in `make_vec`, like the other keywords; the seed is that of the kills, too.
        kills: how many signals; three in four are SIGKILL, the others SIGSTOP.
        backend: where the worlds run, `processes:N`; default: `processes:2`.
        workers: short form: N for `processes:N`.
        worlds: stepped together; default: two a worker.
        steps: how many; default: three a kill.
        policy: as in `load_policy`.
        zones: shadows zones.count.
        progress: called with steps done and steps in all.
        keys: of the worlds.

    Raises:
        ConfigError: numbers that cannot be.
        WorkerError: workers died that were not killed.
    """
    spec = WorldSpec.of(env, **keys)
    seed = spec.seed
    steps = 3 * kills + FIRST_STEPS if steps is None else steps
    where = find_backend(backend, workers)
    if backend is None and workers is None:
        where = BackendName(PROCESSES, 2)
    if where.kind != PROCESSES or where.count is None:
        raise ConfigError(
            f"backend = '{where}': workers are killed of 'processes:N'; nodes by "
            "cavmarl verify nodes --nodes N --kill K"
        )
    if kills < 1:
        raise ConfigError(f"{kills} kills: must be at least 1")
    if steps < kills + FIRST_STEPS:
        raise ConfigError(f"{steps} steps: {kills} kills need at least {kills + FIRST_STEPS}")
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
    """What an empty command to all workers takes, at the median."""
    found = []
    for _ in range(PINGS):
        began = time.perf_counter()
        pool.ping()
        found.append(time.perf_counter() - began)
    return 1e6 * statistics.median(found)


class _Killer:
    """Sends the signals to workers of a pool and finds out what became of them."""

    def __init__(self, pool: Pool, random: random.Random) -> None:
        self.random = random
        self.found: list[Kill] = []
        self.pool = pool
        self._sent: dict[int, tuple[signal.Signals, float]] = {}  # worker → what and when
        self._seen = 0
        self._calm_s: list[float] = []

    def step_ms(self) -> float:
        """Median of the steps without a death, ms."""
        return 1000.0 * statistics.median(self._calm_s)

    def watch(self, run: Callable[[], Arrays], step: int, strikes: bool) -> Arrays:
        timer = None
        if strikes:
            delay_s = self.random.uniform(0.0, LATEST * statistics.median(self._calm_s))
            timer = Timer(delay_s, self._strike, (self._choose(),))
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

    def _strike(self, target: tuple[int, signal.Signals]) -> None:
        worker, how = target
        self._sent[worker] = how, time.monotonic()
        os.kill(self.pool.pids[worker], how)

    def _match(self, step: int) -> None:
        """Say of each new death what it was; one of itself is an error."""
        deaths = self.pool.deaths
        for death in deaths[self._seen :]:
            if death.worker not in self._sent:
                raise EvaluationError(
                    f"worker {death.worker} died of itself in step {step}: {death.cause}"
                )
            how, sent_s = self._sent.pop(death.worker)
            self.found.append(_kill(death, how, sent_s, step))
            for worker in self.pool.team_of(death.worker):
                if worker in self._sent and self._sent[worker][1] < death.replaced_s:
                    del self._sent[worker]  # it was replaced with the other one
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
