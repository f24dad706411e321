"""Stop signs and agents: in an agent's seat, too, the built-in driver stands and then goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cavmarl
from cavmarl.config.terms import TERMS
from cavmarl.core.records.codes import DRIVER_AGENT
from tests.support.netgenerate import netgenerate

STOP_SIGNS = ("allway_stop", "priority_stop")
ARRIVAL = TERMS.index("arrival")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A grid of three roads by three, by SUMO's type of all its junctions."""
    folder = tmp_path_factory.mktemp("stops")
    options = ("--grid", "--grid.number=3", "--grid.length=80", "--default-junction-type")
    return {
        kind: netgenerate(folder / f"{kind}.net.xml", *options, kind)
        for kind in (*STOP_SIGNS, "priority")
    }


def drive(
    path: Path, agents: int, steps: int, zones: int = 1, background: int = 0
) -> tuple[int, float, list[str]]:
    """The built-in driver in all seats: (arrivals, longest wait at a stop sign in s, hashes)."""
    arrivals, longest, hashes = 0, 0.0, []
    settings = {"horizon_s": 400, "population.mode": "closed"}
    vec = cavmarl.make_vec(
        path, agents=agents, background=background, zones=zones, overrides=settings
    )
    try:
        policy = cavmarl.load_policy("idm", vec)
        observations, infos = vec.reset(seed=3)
        for _ in range(steps):
            actions = policy.act_batch(observations, infos["mask"])
            observations, *_, infos = vec.step(actions)
            arrivals += int(np.sum(infos["terms"][..., ARRIVAL]))
            hashes.append(vec.state_hash(0))
            if zones == 1:
                cars = vec.simulation.vehicles()
                at_sign = (cars["driver"] == DRIVER_AGENT) & (cars["stopped_at"] >= 0)
                longest = max(longest, *cars["wait_s"][at_sign].tolist(), 0.0)
    finally:
        vec.close()
    return arrivals, longest, hashes


@pytest.mark.parametrize("kind", STOP_SIGNS)
def test_the_built_in_driver_passes_stop_signs(maps: dict[str, Path], kind: str) -> None:
    arrivals, longest, _ = drive(maps[kind], agents=1, steps=1500)
    assert arrivals >= 1
    assert 0.5 <= longest < 1.5, "alone it stands, and goes on at once"


def test_agents_and_others_let_each_other_through_at_stop_signs(maps: dict[str, Path]) -> None:
    arrivals, _, hashes = drive(maps["allway_stop"], agents=6, steps=1200, background=10)
    assert arrivals >= 6
    assert hashes == drive(maps["allway_stop"], 6, 1200, zones=4, background=10)[2]


def test_without_stop_signs_no_stop_is_noted(maps: dict[str, Path]) -> None:
    assert drive(maps["priority"], agents=6, steps=200, background=10)[1] == 0.0
