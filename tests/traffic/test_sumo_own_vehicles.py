"""SUMO's drivers react to agents' fleets, inserted vehicles and vehicles of the caller."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavEnv, ConfigError, parallel_env
from cavmarl.config.registry import load_config
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_EXTERNAL, DRIVER_SUMO
from tests.support.driving import idle
from tests.support.rerouting import make_map, write_demand
from tests.support.sumo_worlds import MODES, coupled, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

FLOW = (
    '<vType id="car" sigma="0" speedDev="0"/>'
    '<flow id="f" type="car" from="in" to="out" begin="0" end="900" period="4"/>'
)
MIN_GAP_M = 2.5  # gap at which SUMO's car stops


def settings(source: str, files: list[Path], **more: Any) -> dict[str, Any]:
    plain = {
        "traffic.source": source,
        "traffic.demand": [str(file) for file in files],
        "population.mode": "respawn",
        "sensors.signal.timing": False,
        "clock.sim_dt_s": 0.1,
        "clock.ctrl_dt_s": 0.2,
        "horizon_s": 60.0,
    }
    return plain | {key.replace("__", "."): value for key, value in more.items()}


def gap_behind(rows: np.ndarray, own: np.void) -> float:
    """Return the gap in m between a vehicle and SUMO's next car behind it, which stands."""
    behind = rows[(rows["driver"] == DRIVER_SUMO) & (rows["x"] < own["x"])]
    assert len(behind) >= 3
    first = behind[behind["x"].argmax()]
    assert first["speed"] < 0.1
    return float(own["x"] - first["x"] - 0.5 * (own["length"] + first["length"]))


@pytest.mark.parametrize(
    ("fleet", "length_m"),
    [
        ({"population.types": ["bus"]}, 12.0),
        (
            {
                "population.own_types": {"lorry": {"like": "truck", "length_m": 9.5}},
                "population.fleet": [{"type": "lorry"}],
            },
            9.5,
        ),
    ],
)
def test_sumos_cars_stop_behind_an_agent_of_another_type(
    tmp_path: Path, fleet: dict[str, Any], length_m: float
) -> None:
    files = write_demand(tmp_path, FLOW)
    origin = {"traffic.origins": ["in"], "traffic.destinations": ["out"], "clock.sim_dt_s": 0.1}
    with coupled(make_map(tmp_path), files, agents=1, overrides=origin | fleet) as simulation:
        brake = idle(simulation)
        brake.controls[..., 0] = -5.0
        for _ in range(300):
            simulation.step(brake)
        rows = simulation.vehicles()
        agent = rows[rows["driver"] == DRIVER_AGENT][0]
        assert agent["length"] == length_m
        assert gap_behind(rows, agent) == pytest.approx(MIN_GAP_M, abs=0.5)
        assert simulation.traffic_stats().contacts == 0


def test_sumos_cars_stop_behind_a_posed_vehicle_until_it_leaves(tmp_path: Path) -> None:
    """The posed vehicle has its own size. A person beside the road does not stop SUMO's cars."""
    files = write_demand(tmp_path, FLOW)
    wanted = settings("sumo-traffic", files, population__external=2)
    net = make_map(tmp_path)
    with closing(parallel_env(net, agents=1, background=0, overrides=wanted)) as env:
        env.reset(seed=1)
        x, y = env.network.lane_polyline(env.network.lane_ids.index("in_0"))[0][:2].tolist()
        truck = env.external.spawn(x + 200.0, y, 0.0, vtype="truck", size_m=(10.0, 2.4, 3.0))
        env.external.spawn(x + 100.0, y - 4.0, 1.5, vtype="pedestrian")
        for _ in range(200):
            env.step(env.suggest_actions())
        rows = env.simulation.vehicles(0)
        own = rows[(rows["driver"] == DRIVER_EXTERNAL) & (rows["length"] == 10.0)][0]
        assert gap_behind(rows, own) == pytest.approx(MIN_GAP_M, abs=0.5)
        passed = rows[(rows["driver"] == DRIVER_SUMO) & (rows["x"] > own["x"])]
        env.external.remove(truck)
        for _ in range(60):
            env.step(env.suggest_actions())
        rows = env.simulation.vehicles(0)
        assert (rows["length"] != 10.0).all()
        now = rows[(rows["driver"] == DRIVER_SUMO) & (rows["x"] > own["x"])]
        assert len(now) > len(passed)
        assert env.traffic_stats()["contacts"] == 0


def act(env: CavEnv, step: int) -> None:
    """Insert, spawn, pose or remove a vehicle if it is planned for this step."""
    roads = np.flatnonzero(~env.network.lanes["internal"] & (env.network.lanes["length_m"] > 60.0))
    lane = int(roads[7])
    x, y = env.network.lane_polyline(lane)[0][:2]
    if step in (2, 3, 30):
        env.insert_vehicle(env.network.lane_ids[int(roads[step])], 20.0 + step)
    if step == 5:
        env.external.spawn(float(x), float(y), 0.3, vtype="cyclist")
    if step == 20:
        env.external.pose(0, float(x) + 4.0, float(y), 0.3)
    if step == 40:
        env.external.remove(0)


def hashes(source: str, folder: Path, **more: Any) -> list[str]:
    wanted = settings(
        source,
        [tiny_file(folder)],
        population__types=["car", "truck", "bus"],
        population__insertions=4,
        population__external=2,
    )
    found = []
    with closing(parallel_env("grid4x4", agents=3, background=4, overrides=wanted, **more)) as env:
        env.reset(seed=2)
        for step in range(60):
            act(env, step)
            env.step(env.suggest_actions())
            if step % 10 == 9:
                found.append(env.state_hash())
        assert env.deadlocks() == ()
        assert env.traffic_stats()["departed"] > 3 + 4 + 3, "no vehicle comes from SUMO"
    return found


@pytest.mark.parametrize("source", MODES)
def test_divisions_change_no_result(tmp_path: Path, source: str) -> None:
    undivided = hashes(source, tmp_path)
    assert hashes(source, tmp_path, zones=4) == undivided
    assert hashes(source, tmp_path, zones=2, workers=2) == undivided


@pytest.mark.parametrize("source", MODES)
def test_contraflow_is_refused(tmp_path: Path, source: str) -> None:
    wanted = settings(source, [tiny_file(tmp_path)])
    wanted |= {"map.contraflow": ["A0B0"], "map.changed_lanes": 8}
    with pytest.raises(ConfigError, match=r"map\.contraflow.*native"):
        load_config("grid4x4", overrides=wanted)


@pytest.mark.parametrize("source", MODES)
def test_sensors_of_external_agents_need_the_worlds_in_this_process(
    tmp_path: Path, source: str
) -> None:
    wanted = settings(source, [tiny_file(tmp_path)], population__external=1)
    wanted |= {"population.external_agents": True, "clock.ctrl_dt_s": 0.1}
    wanted["rig"] = {"gnss": {"type": "gnss", "rate_hz": 10}}
    with pytest.raises(ConfigError, match=r"external_agents.*backend='local'"):
        parallel_env("grid4x4", agents=1, overrides=wanted, workers=2)
