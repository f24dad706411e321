"""The driver `cacc`, which uses messages of the vehicle ahead, compared with `idm`."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import load_policy, make_vec
from cavmarl.core.errors import PolicyError
from tests.support.rerouting import sumo_binary

AGENTS = 8
HEARS = {"v2x.enabled": True, "sensors.messages.objects": 8, "sensors.lanes.range_m": 100.0}
ROAD = {
    "population.mode": "closed",
    "clock.ctrl_dt_s": 0.1,
    "horizon_s": 120.0,
    "traffic.origins": ["start"],
    "traffic.destinations": ["road"],
    "traffic.min_trip_m": 0.0,
}
WARMUP, STEPS = 500, 900


class Platoon(NamedTuple):
    """Measured motion of a platoon whose leader's speed oscillates.

    Attributes:
        spread: (n,) standard deviation of each vehicle's speed in m/s, the leader first.
        headway_s: mean headway of the followers.
        gap_m: the smallest gap.
    """

    spread: NDArray[np.float64]
    headway_s: float
    gap_m: float


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a road of four kilometres with one lane."""
    folder = tmp_path_factory.mktemp("road")
    (folder / "n.xml").write_text(
        '<nodes><node id="A" x="0" y="0"/><node id="B" x="500" y="0"/><node id="C" x="4000" y="0"/>'
        "</nodes>",
        encoding="utf-8",
    )
    (folder / "e.xml").write_text(
        '<edges><edge id="start" from="A" to="B" numLanes="1" speed="25"/>'
        '<edge id="road" from="B" to="C" numLanes="1" speed="25"/></edges>',
        encoding="utf-8",
    )
    net = folder / "road.net.xml"
    command = [sumo_binary("netconvert"), "-n", folder / "n.xml", "-e", folder / "e.xml", "-o", net]
    subprocess.run(command, check=True, capture_output=True)
    return net


def drive(road: Path, policy: str, **settings: Any) -> Platoon:
    env = make_vec(road, agents=AGENTS, background=0, overrides=HEARS | ROAD | settings)
    driver = load_policy(policy, env)
    observations, infos = env.reset(seed=1)
    first = env.simulation.vehicles()
    order = first["agent"][np.argsort(-first["x"])]
    speeds, gaps = [], []
    for step in range(STEPS):
        actions = driver.act_batch(observations, infos["mask"])
        rows = env.simulation.vehicles()
        rows = rows[np.argsort(rows["agent"])][order]
        wanted = 15.0 + 2.5 * np.sin(2.0 * np.pi * step / 100.0)
        actions[0, order[0], 0] = np.clip((wanted - rows["speed"][0]) / 5.0, -1.0, 1.0)
        speeds.append(rows["speed"].copy())
        gaps.append(rows["x"][:-1] - rows["x"][1:] - 5.0)
        observations, _, ended, _, infos = env.step(actions)
        assert not ended.any()
    speed, gap = np.array(speeds[WARMUP:]), np.array(gaps[WARMUP:])
    return Platoon(speed.std(axis=0), float((gap / speed[:, 1:]).mean()), float(np.min(gaps)))


def test_cacc_follows_closer_than_idm_and_oscillations_do_not_grow(road: Path) -> None:
    cacc, idm = drive(road, "cacc"), drive(road, "idm")
    assert cacc.headway_s < 0.5 * idm.headway_s
    assert cacc.gap_m > 0.0
    # String stability: no vehicle's speed oscillates more than that of the vehicle ahead.
    assert (np.diff(cacc.spread) <= 0.0).all()


def test_without_messages_cacc_drives_like_idm(road: Path) -> None:
    deaf, idm = drive(road, "cacc", **{"v2x.channel.loss": 1.0}), drive(road, "idm")
    assert deaf.headway_s == idm.headway_s
    assert (deaf.spread == idm.spread).all()


def test_the_error_names_missing_requirements() -> None:
    with pytest.raises(PolicyError, match=r"cacc needs .* overrides=.*v2x\.enabled"):
        load_policy("cacc", make_vec("ring"))
    discrete = make_vec("ring", overrides=HEARS | {"action.kind": "discrete"})
    with pytest.raises(PolicyError, match="continuous"):
        load_policy("cacc", discrete)


def test_cacc_drives_through_a_city_as_safely_as_idm() -> None:
    ends = {}
    for policy in ("cacc", "idm"):
        env = make_vec("grid4x4", overrides=HEARS | {"population.mode": "respawn"})
        driver = load_policy(policy, env)
        observations, infos = env.reset(seed=2)
        ended = arrived = 0
        for _ in range(300):
            observations, _, terminated, _, infos = env.step(
                driver.act_batch(observations, infos["mask"])
            )
            ended += int(terminated.sum())
            arrived = int(infos["arrivals"][0])
        ends[policy] = (ended, arrived, env.traffic_stats()["removed"])
    assert ends["cacc"][2] <= ends["idm"][2]
    assert ends["cacc"][0] >= 0.8 * ends["idm"][0]
