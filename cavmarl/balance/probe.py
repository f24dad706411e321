"""Measures what other programs use of this machine, for each worker."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Mapping

import psutil

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import NO_GPU, LoadSnapshot
from cavmarl.core.errors import ConfigError

MEASURED = "measured"
INTERVAL_S = 0.2
SHORTEST_S = 0.01  # one tick of the system's clocks
GPU_TOOL = "nvidia-smi"
GPU_QUERY = ("--query-gpu=utilization.gpu", "--format=csv,noheader,nounits")


def take_snapshot(
    # number → process id; None: the worker has no process yet, and will run on this process's cores
    workers: Mapping[int, int | None],
    interval_s: float = INTERVAL_S,  # duration of the measurement and of this call
) -> LoadSnapshot:
    """Measure for `interval_s` how busy other programs keep each worker's part of the machine."""
    if not interval_s > 0.0:
        raise ConfigError(f"interval_s = {interval_s}: must be above 0")
    watch = Watch(workers)
    time.sleep(interval_s)
    return watch.snapshot()


class Watch:
    """A measurement of the machine from its construction until it is read.

    A worker's CPU use is the mean use of the cores on which its process may run, minus the use by
    this process and all workers: a run's own computation is no reason to move shards away. RAM use
    is measured for the machine, GPU use for the busiest GPU according to `nvidia-smi`; without
    `nvidia-smi` it is 0, and `gpu_source` is `none`.
    """

    def __init__(self, workers: Mapping[int, int | None]) -> None:
        self._watched = {number: _Watched(pid) for number, pid in workers.items()}
        own = os.getpid()
        self._callers = () if own in workers.values() else (_Watched(own),)
        self._began_s = time.perf_counter()
        self._before = _busy_s()

    def snapshot(self) -> LoadSnapshot:
        """Return the use by other programs since the start. Raises ConfigError: no workers."""
        elapsed_s = max(time.perf_counter() - self._began_s, SHORTEST_S)
        foreign = [
            (after - before) / elapsed_s
            for before, after in zip(self._before, _busy_s(), strict=True)
        ]
        for process in (*self._watched.values(), *self._callers):
            share = (process.used_s() or 0.0) / elapsed_s / len(process.cores)
            for core in process.cores:
                foreign[core] -= share
        ram = psutil.virtual_memory().percent / 100.0
        gpu, source = busiest_gpu()
        states = []
        for number, process in self._watched.items():
            available = process.used_s() is not None
            cpu = sum(foreign[core] for core in process.cores) / len(process.cores)
            use = Utilisation(min(max(cpu, 0.0), 1.0) if available else 1.0, ram, gpu)
            states.append(Candidate(number, use, available=available))
        return LoadSnapshot(tuple(states), source, MEASURED)


class _Watched:
    """The processor time of a process since the construction of this object.

    Attributes:
        cores: cores on which the process may run.
    """

    def __init__(self, pid: int | None) -> None:
        self._pid = pid
        self._began_s = self._own_s()
        self.cores = _cores(0 if pid is None or self._began_s is None else pid)

    def used_s(self) -> float | None:
        """Return the processor time since the start; None: the process has ended."""
        ended_s = self._own_s()
        return None if ended_s is None or self._began_s is None else ended_s - self._began_s

    def _own_s(self) -> float | None:
        """Return the total processor time; None: there is no such process."""
        if self._pid is None:
            return 0.0
        try:
            times = psutil.Process(self._pid).cpu_times()
        except psutil.NoSuchProcess:
            return None
        return float(times.user + times.system)


def _busy_s() -> list[float]:
    return [
        sum(core) - core.idle - getattr(core, "iowait", 0.0) - getattr(core, "guest", 0.0)
        for core in psutil.cpu_times(percpu=True)
    ]


def _cores(pid: int) -> list[int]:
    """Return the cores on which a process may run; 0 is this process."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(pid))
    return list(range(os.cpu_count() or 1))


def busiest_gpu() -> tuple[float, str]:
    """Return the used share of the busiest GPU's time, and the source."""
    tool = shutil.which(GPU_TOOL)
    if tool is None:
        return 0.0, NO_GPU
    done = subprocess.run([tool, *GPU_QUERY], capture_output=True, text=True, check=False)
    shares = [float(line) / 100.0 for line in done.stdout.split() if line.isdigit()]
    if done.returncode or not shares:
        return 0.0, NO_GPU
    return max(shares), GPU_TOOL
