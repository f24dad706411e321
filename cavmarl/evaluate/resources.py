"""The resources that each process of a run uses, window by window, and their summary."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.tables import RESOURCE
from cavmarl.parallel.nodes.node_groups import NodeGroups
from cavmarl.parallel.nodes.node_loads import NodeLoad
from cavmarl.parallel.nodes.node_worlds import NodeWorlds

WINDOW_S = 10.0  # length of a window in simulated time
CALLER = -1  # number of the process that steps the worlds


class ResourceWatch:
    """Records what the processes of remote worlds use; nothing for worlds of this process.

    Nodes report about themselves. Worker processes are observed from here, so their waiting time
    and their traffic through shared memory are unknown.

    Args:
        vec: the worlds.
    """

    def __init__(self, vec: CavVectorEnv) -> None:
        self._worlds = worlds = vec.worlds
        self._nodes = worlds if isinstance(worlds, (NodeWorlds, NodeGroups)) else None
        self._is_remote = bool(worlds.plans)
        self._step_s, self._ticks_per_step = vec.step_s, vec.config.clock.ticks_per_step
        self._steps_per_window = max(1, round(WINDOW_S / vec.step_s))
        self._steps = self._steps_before = 0
        self._used_s: dict[int, float] = {}
        self._migrations = 0
        self._wall_s = 0.0
        self._rows: list[tuple[float, ...]] = []
        if self._is_remote:
            self._read()
            self._rows.clear()  # the time before the first step counts for no window

    def step(self) -> None:
        """Count a step; at the end of a window, add a row for each process."""
        self._steps += 1
        if self._is_remote and self._steps % self._steps_per_window == 0:
            self._read()

    def rows(self) -> NDArray[np.void]:
        """Return RESOURCE (n,) of all windows; the last window may be shorter."""
        if self._is_remote and self._steps > self._steps_before:
            self._read()
        return np.array([(0, *row) for row in self._rows], RESOURCE)

    def network(self) -> list[dict[str, Any]]:
        """Return machine, process and connections of each node; empty without nodes."""
        return [] if self._nodes is None else self._nodes.describe_network()

    def _read(self) -> None:
        """Add a row for each process, for the window that ends now."""
        begin_s = self._steps_before * self._step_s
        ticks = (self._steps - self._steps_before) * self._ticks_per_step
        now_s = time.perf_counter()
        window = (begin_s, ticks, now_s - self._wall_s)
        self._steps_before, self._wall_s = self._steps, now_s
        if self._nodes is None:
            self._rows.append((CALLER, *window, *self._observed(os.getpid())))
            for worker, pid in sorted(self._worlds.worker_pids.items()):
                self._rows.append((worker, *window, *self._observed(pid)))
            return
        before, self._migrations = self._migrations, _migrations(self._nodes)
        moved = self._migrations - before
        self._rows.append((CALLER, *window, *self._observed(os.getpid(), moved)))
        loads = self._nodes.node_loads()
        self._rows += [(load.node, *window, *_reported(load, loads)) for load in loads]

    def _observed(self, pid: int, migrations: float = np.nan) -> tuple[float, ...]:
        """Return the fields of RESOURCE from `cpu_s` on; NaN: not observed."""
        unknown = (*(np.nan,) * (len(RESOURCE.names or ()) - 8), migrations)
        try:
            process = psutil.Process(pid)
            times, memory_bytes = process.cpu_times(), process.memory_info().rss
        except psutil.NoSuchProcess:  # the process is being replaced
            return (np.nan, np.nan, *unknown)
        used_s = times.user + times.system
        before_s, self._used_s[pid] = self._used_s.get(pid, 0.0), used_s
        return (used_s - before_s, memory_bytes, *unknown)


def _migrations(worlds: NodeWorlds | NodeGroups) -> int:
    return sum(log.counts["switched"] + log.counts["forced"] for log in worlds.transfers)


def _reported(load: NodeLoad, loads: Sequence[NodeLoad]) -> tuple[float, ...]:
    # The other nodes wait for the node that waits least.
    is_slowest = len(loads) > 1 and load.waited_s == min(other.waited_s for other in loads)
    return (
        load.cpu_s,
        load.memory_bytes,
        load.waited_s,
        load.sent_bytes,
        load.sent_frames,
        load.vehicles,
        load.ghosts,
        is_slowest,
        np.nan,
    )


def summary_of(rows: NDArray[np.void]) -> list[dict[str, Any]]:
    """Return one row per process of a policy, from its RESOURCE rows.

    Keys: `process` (a number, or `caller`), `windows`, `cpu_share` and `wait_share` (of the wall
    time), `memory_mb` (the maximum), `bytes_per_tick`, `frames_per_tick`, `vehicles` and `ghosts`
    (means), `straggler_share` (share of windows in which the other nodes waited for this one),
    `migrations` (changes of owner in all worlds, counted by the caller). None: not measured.
    """
    found = []
    for process in np.unique(rows["process"]).tolist():
        own = rows[rows["process"] == process]
        wall_s, ticks = own["wall_s"].sum(), own["ticks"].sum()
        values = {
            "cpu_share": np.nansum(own["cpu_s"]) / wall_s,
            "memory_mb": np.fmax.reduce(own["memory_bytes"]) / 1e6,  # without windows of NaN
            "wait_share": own["waited_s"].sum() / wall_s,
            "bytes_per_tick": own["sent_bytes"].sum() / ticks,
            "frames_per_tick": own["sent_frames"].sum() / ticks,
            "vehicles": own["vehicles"].mean(),
            "ghosts": own["ghosts"].mean(),
            "straggler_share": own["slowest"].mean(),
            "migrations": own["migrations"].sum(),
        }
        found.append(
            {
                "process": "caller" if process == CALLER else process,
                "windows": len(own),
                **{name: None if np.isnan(v) else float(v) for name, v in values.items()},
            }
        )
    return found


def summaries_of(tables: Mapping[str, NDArray[np.void]]) -> dict[str, list[dict[str, Any]]]:
    """Return `summary_of` by policy; empty if all worlds were in the caller's process."""
    return {name: summary_of(rows) for name, rows in tables.items() if len(rows)}
