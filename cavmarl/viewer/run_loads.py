"""`RunLoads`: tells pages how busy the nodes are that run a world, and which zones each has."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.load_score import load_score
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.probe import Watch
from cavmarl.parallel.step_arrays import SteppedWorlds
from cavmarl.viewer.audience import Audience

EVERY_S = 2.0


class RunLoads:
    """Measures in a thread of its own, while there are watchers; a context manager.

    Args:
        worlds: whose workers or nodes are watched; without any it does nothing.
        audience: is told.
    """

    def __init__(self, worlds: SteppedWorlds, audience: Audience) -> None:
        self._worlds = worlds
        self._audience = audience
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer loads", daemon=True)

    def __enter__(self) -> RunLoads:
        if self._worlds.worker_pids:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def _run(self) -> None:
        while not self._over.is_set():
            pids = dict(self._worlds.worker_pids)
            watch = Watch(pids) if self._audience.wishes.watchers and pids else None
            self._over.wait(EVERY_S)
            if watch is not None:
                rows = load_rows(pids, watch.snapshot(), self._worlds.plans)
                self._audience.tell_all({"kind": "loads", "rows": rows})


def load_rows(
    pids: Mapping[int, int], snapshot: LoadSnapshot, plans: tuple[Plan, ...]
) -> list[dict[str, Any]]:
    """What a page shows of each worker: its zones in the first world, and its LoadScore.

    Args:
        pids: of the workers' processes.
        snapshot: of the same workers.
        plans: which worker hosts what.
    """
    homes: dict[int, list[int]] = {}
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
