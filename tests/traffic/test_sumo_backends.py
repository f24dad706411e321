"""Worlds with SUMO that use all its features at once give the same results over TraCI and nodes."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import parallel_env
from cavmarl.core.records.codes import DRIVER_SCRIPTED, DRIVER_SUMO
from tests.support.rerouting import write_demand
from tests.support.sumo_worlds import MODES
from tests.traffic.test_sumo_persons import PEOPLE, make_map

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

EVENTS = [
    {"at_s": 4, "action": "close", "edges": ["B0B1"]},
    {"at_s": 6, "action": "damage", "edges": ["B1C1"], "speed_mps": 4.0},
    {"at_s": 9, "action": "open", "edges": ["B0B1"]},
]


def hashes(folder: Path, source: str, steps: int = 60, **more: Any) -> list[str]:
    """Run a world with persons, closures, a scenario, a fleet and an inserted vehicle."""
    own = more.pop("overrides", {})
    wanted = {
        "traffic.source": source,
        "traffic.demand": [str(file) for file in write_demand(folder, PEOPLE)],
        "population.types": ["car", "truck", "bus"],
        "population.insertions": 2,
        "sensors.signal.timing": False,
        "clock.sim_dt_s": 0.1,
        "clock.ctrl_dt_s": 0.2,
        "horizon_s": 60.0,
        "map.events": EVENTS,
        "map.changed_lanes": 8,
        "scenario.name": "pedestrian_crossing",
    }
    drivers: set[int] = set()
    found = []
    with closing(
        parallel_env(make_map(folder), agents=3, background=3, overrides=wanted | own, **more)
    ) as env:
        env.reset(seed=2)
        roads = np.flatnonzero(~env.network.lanes["internal"])
        for step in range(steps):
            if step == 3:
                env.insert_vehicle(env.network.lane_ids[int(roads[9])], 20.0)
            env.step(env.suggest_actions())
            if step % 10 == 9:
                found.append(env.state_hash())
                if "nodes" not in more:
                    drivers |= set(env.simulation.vehicles(0)["driver"].tolist())
    seen = {DRIVER_SCRIPTED, DRIVER_SUMO} if source == "sumo-traffic" else {DRIVER_SCRIPTED}
    assert "nodes" in more or seen <= drivers
    return found


@pytest.mark.parametrize("source", MODES)
def test_traci_and_nodes_change_no_result(tmp_path: Path, source: str) -> None:
    plain = hashes(tmp_path, source)
    assert len(set(plain)) == len(plain)
    traci = {"sumo.interface": "traci"}
    assert hashes(tmp_path, source, overrides=traci) == plain
    assert hashes(tmp_path, source, zones=3, nodes=2) == plain
    assert hashes(tmp_path, source, zones=3, nodes=2, overrides=traci) == plain
