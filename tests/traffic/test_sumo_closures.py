"""Roads that close, open and slow down while SUMO runs the demand."""

from __future__ import annotations

import logging
import os
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavVectorEnv, ConfigError, make_vec
from cavmarl.verify.equivalence import verify_zones
from tests.support.rerouting import CARS, make_map, write_demand
from tests.support.sumo_worlds import MODES, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

# Vehicles have given routes; otherwise SUMO would choose a route around the closed road.
ROUTED = (
    CARS.format(device="")
    + '<route id="near" edges="in short narrow out"/>'
    + '<flow id="f" type="car" route="near" begin="0" end="200" period="5"/>'
    + '<vehicle id="g" type="car" depart="100"><route edges="short narrow out"/></vehicle>'
)
CLOSE_AND_OPEN = [
    {"at_s": 60, "action": "close", "edges": ["short"], "shuts_in": True},
    {"at_s": 140, "action": "open", "edges": ["short"]},
    {"at_s": 150, "action": "damage", "edges": ["in"], "speed_mps": 3.0},
]


def settings(source: str, files: list[Path], **more: Any) -> dict[str, Any]:
    return {
        "population.mode": "respawn",
        "traffic.source": source,
        "traffic.demand": [str(file) for file in files],
        "sensors.signal.timing": False,
        "map.changed_lanes": 8,
        "horizon_s": 300.0,
        **more,
    }


def two_ways(folder: Path, source: str, **more: Any) -> CavVectorEnv:
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "map.events": CLOSE_AND_OPEN}
    overrides = settings(source, write_demand(folder, ROUTED), **clock, **more)
    return make_vec(make_map(folder), num_envs=1, agents=0, background=0, overrides=overrides)


def on_roads(vec: CavVectorEnv) -> dict[str, np.ndarray]:
    """Return the speeds of the vehicles on each road."""
    rows = vec.simulation.vehicles(0)
    edges = vec.network.lanes["edge"][rows["lane"]]
    names = vec.network.edge_ids
    return {name: rows["speed"][edges == row] for row, name in enumerate(names)}


def drive(vec: CavVectorEnv, seconds: int) -> dict[str, np.ndarray]:
    for _ in range(seconds):
        vec.step(vec.suggest_actions())
    return on_roads(vec)


@pytest.mark.parametrize("source", MODES)
def test_vehicles_take_another_route_until_a_road_opens(
    tmp_path: Path, source: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A vehicle before the closed road turns off; SUMO drops a vehicle that departs on the road."""
    with closing(two_ways(tmp_path, source)) as vec, caplog.at_level(logging.WARNING):
        vec.reset(seed=3)
        before = drive(vec, 60)
        assert len(before["short"]) >= 5
        assert len(before["long1"]) == 0
        shut = drive(vec, 60)
        assert len(shut["short"]) == 0
        assert len(shut["long1"]) + len(shut["long2"]) >= 9
        assert len(shut["in"]) <= len(before["in"]) + 1
        slow = drive(vec, 60)
        assert len(slow["in"]) >= 5
        assert slow["in"].max() <= 3.1
        drive(vec, 40)
        assert len(on_roads(vec)["short"]) >= 1
        assert vec.traffic_stats()["removed"] == 0
    assert "SUMO drops g (1 in this episode) before departure" in caplog.text


@pytest.mark.parametrize("source", MODES)
def test_without_rerouting_vehicles_wait_before_a_closed_road(tmp_path: Path, source: str) -> None:
    with closing(two_ways(tmp_path, source, **{"population.reroute": "never"})) as vec:
        vec.reset(seed=3)
        drive(vec, 60)
        found = drive(vec, 60)
        assert len(found["short"]) == len(found["long1"]) == 0
        assert len(found["in"]) >= 12
        assert found["in"].min() < 0.1


@pytest.mark.parametrize("source", MODES)
def test_divisions_change_no_result(tmp_path: Path, source: str) -> None:
    """The world has agents, generated cars and SUMO's cars; the check compares rows every tick."""
    events = [
        {"at_s": 8, "action": "close", "edges": ["A0B0", "B1C1"]},
        {"at_s": 10, "action": "damage", "edges": ["A1B1"], "speed_mps": 4.0},
        {"at_s": 20, "action": "open", "edges": ["A0B0"]},
    ]
    more = {"map.events": events, "clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
    found = verify_zones(
        "grid4x4",
        (1, 4),
        steps=150,
        seed=2,
        agents=4,
        background=6,
        overrides=settings(source, [tiny_file(tmp_path)], **more),
        check=True,
    )
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == 150
    assert found.results[-1].crossings > 0


@pytest.mark.parametrize(("num", "zones"), [(2, 1), (1, 2)])
@pytest.mark.parametrize("source", MODES)
def test_a_worker_that_dies_changes_nothing(
    tmp_path: Path, source: str, num: int, zones: int
) -> None:
    """The worker's successor repeats the changes of roads in SUMO at the same ticks."""
    overrides = settings(source, [tiny_file(tmp_path)])
    made: dict[str, Any] = {"num_envs": num, "agents": 2, "background": 2, "overrides": overrides}
    plain, vec = make_vec("grid4x4", **made), make_vec("grid4x4", zones=zones, workers=2, **made)
    workers: Any = vec.worlds
    with closing(plain), closing(vec):
        for one in (plain, vec):
            one.reset(seed=9)
        for step in range(40):
            if step == 20:
                os.kill(workers.pool.pids[1], signal.SIGKILL)
            for one in (plain, vec):
                if step == 5:
                    one.close_road("A0B0", world=num - 1)
                if step == 30:
                    one.open_road("A0B0", world=num - 1)
                one.step(one.suggest_actions())
            hashes = [[one.state_hash(w) for w in range(num)] for one in (plain, vec)]
            assert hashes[0] == hashes[1], step
        assert len(workers.pool.deaths) == 1
        with pytest.raises(ConfigError, match="cannot be saved"):
            plain.save_state()
