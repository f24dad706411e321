"""Trips that need a U-turn at a junction, as in SUMO, and trips without a route."""

from __future__ import annotations

import logging
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from tests.traffic.demand.conftest import sumo_binary

# A and B are joined in both directions; no road leaves C.
NODES = """<nodes><node id="A" x="0" y="0"/><node id="B" x="100" y="0"/>
<node id="C" x="200" y="0"/></nodes>"""
EDGES = "".join(
    f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="13.89"/>'
    for a, b in ("AB", "BA", "BC")
)
ROUND = '<trip id="round" depart="0" from="AB" to="BA"/>'
LOST = '<trip id="lost" depart="1" from="BC" to="AB"/>'


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turn")
    (folder / "n.xml").write_text(NODES, encoding="utf-8")
    (folder / "e.xml").write_text(f"<edges>{EDGES}</edges>", encoding="utf-8")
    command = [sumo_binary("netconvert"), "-n", "n.xml", "-e", "e.xml", "-o", "turn.net.xml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "turn.net.xml"


def world(net: Path, trips: str, on_bad_route: str = "error") -> cavmarl.CavEnv:
    path = net.with_name("x.rou.xml")
    path.write_text(f"<routes>\n{trips}\n</routes>", encoding="utf-8")
    keys: dict[str, Any] = {
        "traffic.demand": [str(path)],
        "traffic.on_bad_route": on_bad_route,
        "population.mode": "respawn",
        "horizon_s": 40,
    }
    return cavmarl.parallel_env(net, agents=1, background=0, seed=0, overrides=keys)


def test_a_trip_makes_a_u_turn_if_no_other_movement_exists(net: Path) -> None:
    env = world(net, ROUND)
    env.reset()
    sides = []
    while env.agents:
        env.step(env.suggest_actions())
        vehicles = env.simulation.vehicles()
        sides += np.sign(vehicles["y"][vehicles["agent"] < 0]).tolist()
    assert sides == sorted(sides), "the vehicle did not drive on the south side first, then north"
    assert {-1.0, 1.0} <= set(sides)
    assert (vehicles["agent"] >= 0).all(), "the vehicle has not arrived"
    assert env.traffic_stats()["contacts"] == env.traffic_stats()["removed"] == 0


def test_a_trip_without_a_route_is_refused(net: Path) -> None:
    with pytest.raises(cavmarl.RouteError) as caught:
        world(net, ROUND + "\n" + LOST)
    for word in (
        "x.rou.xml, line 3",
        "no route from edge 'BC' to edge 'AB'",
        "on_bad_route = skip",
    ):
        assert word in str(caught.value)


def test_a_trip_without_a_route_can_be_skipped(net: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        env = world(net, ROUND + LOST, on_bad_route="skip")
    assert env.simulation.demand is not None
    assert env.simulation.demand.element_ids == ("round",)
    assert (
        "x.rou.xml: left out 1 vehicles and flows that cannot drive their routes: lost"
        in caplog.text
    )
