"""SUMO's persons are mirrored as rows; other persons, and containers, are counted."""

from __future__ import annotations

import logging
import math
import os
import signal
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import parallel_env
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.verify.equivalence import verify_zones
from tests.support.driving import drive
from tests.support.rerouting import sumo_binary, write_demand
from tests.support.sumo_worlds import MODES, alone, coupled

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

PEOPLE = """
<vType id="car" sigma="0"/>
<flow id="f" type="car" from="A0A1" to="C1C2" begin="0" end="100" period="8"/>
<person id="p0" depart="0"><walk from="A0A1" to="A1B1"/></person>
<person id="p1" depart="1"><walk from="B0B1" to="B1C1"/></person>
<person id="p2" depart="2"><walk edges="A0A1" arrivalPos="30"/></person>
<container id="c" depart="3"><tranship edges="A0A1"/></container>
"""


def make_map(folder: Path) -> Path:
    """Make a grid with sidewalks and crossings."""
    net = folder / "walk.net.xml"
    words = (
        "--grid --grid.number 3 --grid.length 100 --sidewalks.guess --crossings.guess "
        f"--walkingareas -o {net}"
    )
    subprocess.run([sumo_binary("netgenerate"), *words.split()], check=True, capture_output=True)
    return net


def people(simulation: Simulation) -> np.ndarray:
    rows = simulation.vehicles()
    found: np.ndarray = rows[rows["driver"] == DRIVER_EXTERNAL]
    return found


def test_persons_are_at_their_places_in_sumo_until_they_arrive(tmp_path: Path) -> None:
    files = write_demand(tmp_path, PEOPLE)
    own = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 0.4}
    most = 0
    with (
        coupled(make_map(tmp_path), files, overrides=own) as simulation,
        alone(simulation, tmp_path) as libsumo,
    ):
        pedestrian = simulation.type_rows["pedestrian"]
        for _ in range(120):
            drive(simulation)
            libsumo.simulationStep()
            libsumo.simulationStep()
            rows = np.sort(people(simulation), order=["x", "y"])
            persons = libsumo.person
            there = sorted(persons.getPosition(name) for name in persons.getIDList())
            assert len(rows) == len(there)
            for row, place in zip(rows, there, strict=True):
                assert (row["x"], row["y"]) == pytest.approx(place)
            assert (rows["vtype"] == pedestrian).all()
            assert np.isin(
                np.round(rows["speed"], 6),
                [round(persons.getSpeed(name), 6) for name in persons.getIDList()],
            ).all()
            most = max(most, len(rows))
        assert most == 3
        assert len(people(simulation)) < 3, "no person has arrived"
        heading = math.radians(90.0 - persons.getAngle("p0"))
        assert np.abs(np.cos(people(simulation)["heading"] - heading)).max() > 0.99


def test_zones_change_no_result(tmp_path: Path) -> None:
    found = verify_zones(
        make_map(tmp_path),
        (1, 4),
        steps=80,
        seed=2,
        agents=2,
        background=2,
        overrides=settings("sumo-traffic", tmp_path),
        check=True,
    )
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == 80


def test_workers_change_no_result_even_if_one_dies(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    made: dict[str, Any] = {"agents": 2, "overrides": settings("sumo-traffic", tmp_path)}
    plain, divided = parallel_env(net, **made), parallel_env(net, zones=2, workers=2, **made)
    workers: Any = divided.worlds
    with closing(plain), closing(divided):
        for env in (plain, divided):
            env.reset(seed=4)
        for step in range(70):
            if step == 20:
                os.kill(workers.pool.pids[1], signal.SIGKILL)
            for env in (plain, divided):
                env.step(env.suggest_actions())
            assert plain.state_hash() == divided.state_hash(), step
            if step == 20:
                assert len(people(plain.simulation)) == 3
        assert len(people(plain.simulation)) < 3, "no person has arrived"
        assert len(workers.pool.deaths) == 1


def settings(source: str, folder: Path, **more: Any) -> dict[str, Any]:
    return {
        "traffic.source": source,
        "traffic.demand": [str(path) for path in write_demand(folder, PEOPLE)],
        "population.mode": "respawn",
        "sensors.signal.timing": False,
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 0.4,
        "horizon_s": 60.0,
        **more,
    }


def tolerated(net: Path, overrides: dict[str, Any]) -> str:
    demand = load_world(net, overrides=overrides).demand
    assert demand is not None
    return "\n".join(demand.tolerated)


@pytest.mark.parametrize("source", MODES)
def test_elements_that_are_not_mirrored_are_reported_with_counts(
    tmp_path: Path, source: str
) -> None:
    net = make_map(tmp_path)
    told = tolerated(net, settings(source, tmp_path))
    assert "1 <container> moves in SUMO only" in told
    assert ("3 <person> moves in SUMO only" in told) is (source == "sumo-demand")
    off = settings(source, tmp_path, **{"sumo.max_persons": 0})
    told = tolerated(net, off)
    assert "3 <person> moves in SUMO only; traffic.source = sumo-traffic mirrors" in told


def test_persons_without_room_are_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    own = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 0.4, "sumo.max_persons": 2}
    files = write_demand(tmp_path, PEOPLE)
    with (
        caplog.at_level(logging.WARNING),
        coupled(make_map(tmp_path), files, overrides=own) as simulation,
    ):
        for _ in range(20):
            drive(simulation)
        assert len(people(simulation)) == 2
    assert caplog.text.count("1 persons of SUMO are not mirrored; raise sumo.max_persons") == 1
