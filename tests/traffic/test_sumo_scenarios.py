"""Scripted scenarios with SUMO: SUMO's drivers react to the actors, and SUMO's signals fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError
from cavmarl.config.registry import load_config
from cavmarl.core.records.codes import DRIVER_SCRIPTED, DRIVER_SUMO
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.traffic.scenarios.library import plan_scene
from cavmarl.traffic.scenarios.motions import Move
from cavmarl.verify.equivalence import verify_zones
from tests.support.driving import drive, idle
from tests.support.rerouting import write_demand
from tests.support.sumo_worlds import MODES, coupled, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2, "population.mode": "closed"}


def settings(source: str, folder: Path, name: str) -> dict[str, Any]:
    return {
        **CLOCK,
        "traffic.source": source,
        "traffic.demand": [str(tiny_file(folder))],
        "sensors.signal.timing": False,
        "scenario.name": name,
        "horizon_s": 60.0,
    }


@pytest.mark.parametrize("source", MODES)
def test_signals_fail_in_sumo_at_the_time_of_the_scenario(tmp_path: Path, source: str) -> None:
    own = {"scenario.name": "signal_outage", **CLOCK}
    with coupled("grid4x4", [tiny_file(tmp_path)], source, agents=1, overrides=own) as simulation:
        scene = simulation.scene
        assert scene is not None
        (outage,) = scene.outages
        dark_at = 0.0
        while dark_at < outage.at_s + 5.0:
            drive(simulation)
            dark_at = float(simulation.ticks()[0]) * 0.1
            letters = shown(simulation, outage.signal)
            assert (set(letters) <= set("oO")) is (dark_at >= outage.at_s - 1e-6), dark_at


def shown(simulation: Any, name: str) -> str:
    network = simulation.network
    signal = network.signal_ids.index(name)
    first = network.phases[simulation.signal_phases()[signal]]["first_state"]
    codes = network.phase_states[first : first + network.signals[signal]["num_links"]]
    return "".join(SIGNAL_STATES[code] for code in codes)


def test_sumos_cars_stop_before_actors(tmp_path: Path) -> None:
    """Vans close all lanes of a road until an agent is near; SUMO's cars queue behind them."""
    own = {"scenario.name": "road_closure", **CLOCK}
    world = load_world("grid4x4", agents=1, overrides=own)
    scene = plan_scene(world.config.scenario, world.network, 1)
    assert scene is not None
    stand = scene.actors[0].acts[0]
    assert isinstance(stand, Move)
    road = stand.beside
    edge = world.network.edge_ids[world.network.lanes["edge"][road]]
    flow = f'<flow id="f" from="{edge}" to="{edge}" begin="0" end="60" period="4"/>'
    with coupled("grid4x4", write_demand(tmp_path, flow), agents=1, overrides=own) as simulation:
        brake = idle(simulation)
        brake.controls[..., 0] = -5.0
        for _ in range(150):
            simulation.step(brake)
        rows = simulation.vehicles()
        vans, cars = rows[rows["driver"] == DRIVER_SCRIPTED], rows[rows["driver"] == DRIVER_SUMO]
        assert len(cars) >= 3
        assert (cars["speed"] < 0.1).any()
        assert np.isin(cars["lane"], vans["lane"]).all()
        assert (cars["s"] < vans["s"].min()).all()
        assert simulation.traffic_stats().contacts == 0


@pytest.mark.parametrize("source", MODES)
@pytest.mark.parametrize("name", ["pedestrian_crossing", "signal_outage"])
def test_divisions_change_no_result(tmp_path: Path, source: str, name: str) -> None:
    found = verify_zones(
        "grid4x4",
        (1, 4),
        steps=80,
        seed=2,
        agents=2,
        background=4,
        overrides=settings(source, tmp_path, name),
        check=True,
    )
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == 80


@pytest.mark.parametrize("source", MODES)
def test_logged_scenes_are_refused(tmp_path: Path, source: str) -> None:
    with pytest.raises(ConfigError, match=r"scenario\.name = 'scene\.json'.*native"):
        load_config("grid4x4", overrides=settings(source, tmp_path, "scene.json"))
