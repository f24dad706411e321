"""Pools of toy jobs, and checks that their processes have ended."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import Any

from cavmarl.parallel.processes.worker_pool import Pool, Program
from tests.support.toy_job import TASKS, TOTAL

MODULE = "tests.support.toy_job"
ROOT = Path(__file__).resolve().parents[2]
MORE = 1000  # number of elements that each task appends
Make = Callable[..., Pool]


def program(
    workers: int = 2, teams: tuple[tuple[int, ...], ...] = (), **message: object
) -> Program:
    names = tuple(f"part {k}" for k in range(workers))
    return Program(MODULE, {"workers": workers, **message}, names, (), TASKS, teams=teams)


@contextmanager
def toy_pools() -> Iterator[Make]:
    """Yield a function that makes pools of toy jobs; close the pools after the test."""
    pools: list[Pool] = []

    def call(
        workers: int = 2,
        timeout_s: float = 60.0,
        repeats: int = 3,
        teams: tuple[tuple[int, ...], ...] = (),
    ) -> Pool:
        pools.append(Pool(program(workers, teams), timeout_s, repeats))
        return pools[-1]

    yield call
    for pool in pools:
        pool.close()


def totals(pool: Pool) -> list[list[float]]:
    return pool.run(TOTAL, commits=False)


def committed_image(pool: Pool) -> memoryview:
    """Return the memory with the last committed state of the workers, for tests that damage it."""
    return pool._processes._resources.segments[2 + pool._committed].map()


def alive(pids: list[int]) -> list[int]:
    """Return the processes that exist, including zombie children of this process."""
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def signal_later(pid: int, in_s: float, how: signal.Signals = signal.SIGKILL) -> Timer:
    """Send a signal after `in_s`; ignore a process that has ended by then."""

    def send() -> None:
        with suppress(ProcessLookupError):
            os.kill(pid, how)

    timer = Timer(in_s, send)
    timer.start()
    return timer


def gone(pids: list[int], limit_s: float = 60.0) -> bool:
    end = time.monotonic() + limit_s
    while alive(pids) and time.monotonic() < end:
        time.sleep(0.01)
    return not alive(pids)


def in_time(work: Callable[[], Any], limit_s: float = 20.0) -> Any:
    """Return the result of `work`; raise TimeoutError if it takes longer than the limit."""

    def give_up(*_: object) -> None:
        raise TimeoutError(f"not done after {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return work()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def gone_soon(pids: list[int]) -> bool:
    """Return whether all processes end within a minute; zombies count as ended."""
    for pid in pids:
        try:
            pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        ended = bool(select.select([pidfd], [], [], 60.0)[0])
        os.close(pidfd)
        if not ended:
            return False
    return True


LONER = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {root!r})
from tests.support.pools import program
from tests.support.toy_job import ADD, TOIL
from cavmarl.parallel.processes.worker_pool import Pool
pool = Pool(program(2), 60.0, 3)
pool.run(ADD)
print(*pool.pids, pool.server_pid, flush=True)
{then}
"""
