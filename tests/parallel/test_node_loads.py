"""Nodes report the loads of their processes and machines; zones move by these loads."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cavmarl.balance.load_score import Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.parallel.nodes.node_loads import TO_SHOW
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.viewer.run_loads import RunLoads
from cavmarl.viewer.subscribers import Audience, Wishes
from tests.parallel.test_nodes import WANTED, over_nodes
from tests.support.vec_runs import Make, drive, same

IDLE = Utilisation(0.0, 0.0)


def test_nodes_report_their_loads(make: Make) -> None:
    vec = make("grid4x4", zones=4, nodes=2, num_envs=1, **WANTED)
    drive(vec, steps=5)
    over_nodes(vec).node_loads()
    for _ in range(3):
        vec.step(vec.suggest_actions())
    loads = over_nodes(vec).node_loads()
    running = vec.traffic_stats(0)["running"]
    assert [load.node for load in loads] == [0, 1]
    assert sum(load.vehicles for load in loads) == running
    for load in loads:
        assert load.ticks == 3 * vec.config.clock.ticks_per_step
        assert 0.0 < load.cpu_s < 10.0
        assert load.waited_s > 0.0
        assert load.sent_frames >= 2 * load.ticks
        assert load.sent_bytes > 40 * load.sent_frames
        assert load.memory_bytes > 1 << 26
        assert load.ghosts > 0
    assert all(load.ticks == 0 for load in over_nodes(vec).node_loads())


def test_the_viewer_shows_the_loads_of_nodes_on_other_machines(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    vec = make("grid4x4", zones=4, nodes=2, **WANTED)
    drive(vec, steps=2)
    nodes = over_nodes(vec)
    assert sorted(nodes.worker_pids) == [0, 1]
    assert os.getpid() not in nodes.worker_pids.values()
    monkeypatch.setattr(NodeWorlds, "worker_pids", {})  # nodes on other machines have no known pids
    monkeypatch.setattr("cavmarl.viewer.run_loads.EVERY_S", 0.05)
    audience = Audience()
    told: list[Any] = []
    monkeypatch.setattr(audience, "send_all", told.append)
    loads = RunLoads(nodes, audience)
    loads.look()
    assert not told  # no page is open, so nothing is sent
    audience.wishes = Wishes(watchers=1)
    loads.look()
    time.sleep(0.3)
    before = vec.state_hash(0)
    loads.others = [{"name": "another", "zones": "-", "score": 0.5, "note": ""}]
    loads.look()
    (found,) = told
    assert [row["zones"] for row in found["rows"]] == ["0, 1", "2, 3", "-"]
    assert all(0.0 < row["score"] <= 1.0 for row in found["rows"])
    assert vec.state_hash(0) == before


def test_zones_leave_nodes_on_busy_machines(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node on a busy machine gets no more zones, but keeps its last zone."""
    watched = {"workers.balance_steps": 2, "workers.monitor_cpu": True}
    whole = drive(make("grid4x4", **WANTED))
    said: list[LoadSnapshot] = []
    ask, spent = NodeWorlds.node_snapshot, StepPlacement.round

    def report_first_as_busy(self: NodeWorlds, purpose: str = TO_SHOW) -> LoadSnapshot:
        found = ask(self, purpose)
        assert [one.worker for one in found.workers] == [0, 1]
        assert all(0.0 <= one.use.cpu <= 1.0 < 100.0 * one.use.ram for one in found.workers)
        said.append(found)
        first, second = found.workers
        workers = (replace(first, use=Utilisation(0.95, 0.1)), replace(second, use=IDLE))
        return replace(found, workers=workers)

    def round_with_costs(self: StepPlacement, spent_s: Any, steps: int, seen: LoadSnapshot) -> bool:
        return spent(self, self._before_s + np.array([[1.0, 1.0, 1e-3, 1e-3]]), steps, seen)

    monkeypatch.setattr(NodeWorlds, "node_snapshot", report_first_as_busy)
    monkeypatch.setattr(StepPlacement, "round", round_with_costs)
    vec = make("grid4x4", zones=4, nodes=2, overrides=watched, **WANTED)
    worlds = over_nodes(vec)
    assert worlds.pool.zones == [[0, 1], [2, 3]]
    assert same(drive(vec), whole)
    assert len(said) > 3
    assert [len(zones) for zones in worlds.pool.zones] == [1, 3]
    assert worlds.plans[0].homes.count(0) == 1
    assert [rejected.worker for rejected in worlds.plans[0].rejections] == [0]
