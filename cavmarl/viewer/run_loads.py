"""`RunLoads`: sends pages the load and the zones of the nodes that run a world."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from typing import Any

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.load_score import load_score
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.probe import Watch
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.viewer.subscribers import Audience

EVERY_S = 2.0


class RunLoads:
    """Measures loads in a separate thread while there are watchers; a context manager.

    Nodes on other machines measure themselves and are queried by `look`.

    Args:
        worlds: worlds whose workers or nodes are measured; without workers, this process.
        audience: receives the loads.

    Attributes:
        others: further rows to send, of processes that run no zones of these worlds.
    """

    def __init__(self, worlds: SteppedWorlds, audience: Audience) -> None:
        self._worlds = worlds
        self._audience = audience
        self.others: list[dict[str, Any]] = []
        self._apart = worlds if isinstance(worlds, NodeWorlds) and not worlds.worker_pids else None
        self._looked_s = 0.0  # time of the last query of remote nodes; 0: never
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer loads", daemon=True)

    def __enter__(self) -> RunLoads:
        if self._apart is None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def _run(self) -> None:
        while not self._over.is_set():
            pids = dict(self._worlds.worker_pids) or {0: os.getpid()}
            watch = Watch(pids) if self._audience.wishes.watchers else None
            self._over.wait(EVERY_S)
            if watch is not None:
                zones = self._worlds.world.partition.count
                self._send(load_rows(pids, watch.snapshot(), self._worlds.plans, zones))

    def look(self) -> None:
        """Query nodes of other machines if due; called by the thread of the worlds."""
        nodes, now_s = self._apart, time.monotonic()
        if nodes is None or not self._audience.wishes.watchers or now_s - self._looked_s < EVERY_S:
            return
        is_first, self._looked_s = not self._looked_s, now_s
        snapshot = nodes.node_snapshot()
        if is_first:  # the nodes have only begun to measure
            return
        pids = dict(enumerate(nodes.pool.pids))
        self._send(load_rows(pids, snapshot, nodes.plans, nodes.world.partition.count))

    def _send(self, rows: list[dict[str, Any]]) -> None:
        self._audience.send_all({"kind": "loads", "rows": rows + self.others})


def load_rows(
    pids: Mapping[int, int], snapshot: LoadSnapshot, plans: tuple[Plan, ...], zones: int = 1
) -> list[dict[str, Any]]:
    """Return the page's row of each worker: its zones in the first world, and its LoadScore.

    Args:
        pids: process ids of the workers.
        snapshot: loads of the same workers.
        plans: zones by worker; if empty, the first worker hosts all zones.
        zones: number of zones of a world.
    """
    homes: dict[int, list[int]] = {} if plans else {min(pids): list(range(zones))}
    for plan in plans[:1]:
        for shard, home in zip(plan.problem.shards, plan.homes, strict=True):
            if shard.world == plan.problem.shards[0].world:
                homes.setdefault(home, []).append(shard.zone)
    return [
        {
            "name": f"{one.worker} (process {pids[one.worker]})",
            "zones": ", ".join(map(str, sorted(homes.get(one.worker, [])))) or "-",
            "score": round(load_score(one.use), 4) if one.available else None,
            "note": "" if one.available else "gone",
        }
        for one in snapshot.workers
    ]
