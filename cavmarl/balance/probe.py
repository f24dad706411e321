"""What others use of this machine, worker by worker."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence

import psutil

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.snapshot import NO_GPU, Snapshot
from cavmarl.errors import PlacementError

__all__ = ["MEASURED", "take_snapshot"]

MEASURED = "measured"
INTERVAL_S = 0.2
GPU_TOOL = "nvidia-smi"
GPU_QUERY = ("--query-gpu=utilization.gpu", "--format=csv,noheader,nounits")


def take_snapshot(workers: Mapping[int, int | None], interval_s: float = INTERVAL_S) -> Snapshot:
    """Watch the machine for `interval_s` and say how busy each worker's part of it is.

    A worker's CPU is the mean use of the cores that its process may run on, less its own: what it
    computes for its shards is no reason to take them away. RAM is the machine's, and GPU that of
    its busiest one by `nvidia-smi`; without that it is 0 and `gpu_source` is `none`.

    Args:
        workers: number → process id; None: not started yet, it will run where this process may.
        interval_s: for how long; this call takes as long.

    Raises:
        PlacementError: no worker, or an interval that is none.
    """
    if not interval_s > 0.0:
        raise PlacementError(f"interval_s = {interval_s}: must be above 0")
    watched = {number: _Watched(pid) for number, pid in workers.items()}
    began = time.perf_counter()
    percents = psutil.cpu_percent(interval=interval_s, percpu=True)
    elapsed_s = time.perf_counter() - began
    ram = psutil.virtual_memory().percent / 100.0
    gpu, source = _busiest_gpu()
    states = []
    for number, process in watched.items():
        foreign = process.foreign_use(percents, elapsed_s)
        if foreign is None:
            states.append(Candidate(number, Utilisation(1.0, ram, gpu), available=False))
        else:
            states.append(Candidate(number, Utilisation(foreign, ram, gpu)))
    return Snapshot(tuple(states), source, MEASURED)


class _Watched:
    """A worker's process, or the room for one, from before the interval to its end."""

    def __init__(self, pid: int | None) -> None:
        self._pid = pid
        self._began_s = self._own_s()
        self._cores = _cores(0 if pid is None or self._began_s is None else pid)

    def foreign_use(self, percents: Sequence[float], elapsed_s: float) -> float | None:
        """What others used of its cores; None: it is gone."""
        ended_s = self._own_s()
        if ended_s is None or self._began_s is None:
            return None
        busy = sum(percents[core] for core in self._cores) / 100.0
        own = (ended_s - self._began_s) / elapsed_s
        return min(max((busy - own) / len(self._cores), 0.0), 1.0)

    def _own_s(self) -> float | None:
        """Processor time up to now; None: there is no such process."""
        if self._pid is None:
            return 0.0
        try:
            times = psutil.Process(self._pid).cpu_times()
        except psutil.NoSuchProcess:
            return None
        return float(times.user + times.system)


def _cores(pid: int) -> list[int]:
    """Where a process may run; 0 is this one."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(pid))
    return list(range(os.cpu_count() or 1))


def _busiest_gpu() -> tuple[float, str]:
    """The share of the busiest GPU's time that is in use, and who says so."""
    tool = shutil.which(GPU_TOOL)
    if tool is None:
        return 0.0, NO_GPU
    done = subprocess.run([tool, *GPU_QUERY], capture_output=True, text=True, check=False)
    shares = [float(line) / 100.0 for line in done.stdout.split() if line.isdigit()]
    if done.returncode or not shares:
        return 0.0, NO_GPU
    return max(shares), GPU_TOOL
