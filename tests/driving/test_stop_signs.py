"""At stop signs, the built-in driver of an agent stops and then goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cavmarl
from cavmarl.config.terms import TERMS
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.kernels.junctions.junctions import note_stop
from cavmarl.roads.routing import PLAN
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netgenerate
from tests.support.traffic import on_lane

STOP_SIGNS = ("allway_stop", "priority_stop")
ARRIVAL = TERMS.index("arrival")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return grids of three by three junctions, by the SUMO type of the junctions."""
    folder = tmp_path_factory.mktemp("stops")
    options = ("--grid", "--grid.number=3", "--grid.length=80", "--default-junction-type")
    return {
        kind: netgenerate(folder / f"{kind}.net.xml", *options, kind)
        for kind in (*STOP_SIGNS, "priority")
    }


def drive(
    path: Path, agents: int, steps: int, zones: int = 1, background: int = 0
) -> tuple[int, float, list[str]]:
    """Run the built-in driver; return arrivals, longest wait at a stop sign in s, and hashes."""
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
    assert 0.5 <= longest < 1.5, "the agent did not stop, or waited long without other traffic"


def test_agents_and_background_vehicles_pass_stop_signs_in_turn(maps: dict[str, Path]) -> None:
    arrivals, _, hashes = drive(maps["allway_stop"], agents=6, steps=1200, background=10)
    assert arrivals >= 6
    assert hashes == drive(maps["allway_stop"], 6, 1200, zones=4, background=10)[2]


def test_no_stop_is_recorded_without_stop_signs(maps: dict[str, Path]) -> None:
    assert drive(maps["priority"], agents=6, steps=200, background=10)[1] == 0.0


@pytest.mark.parametrize(
    ("stub", "to_line_m", "wait_s", "notes"),
    [(False, 6.5, 1.0, True), (False, 6.5, 0.1, False), (False, 8.0, 1.0, False),
     (True, 3.0, 1.0, True), (True, 8.0, 1.0, False)],
)  # fmt: skip
def test_a_vehicle_that_waits_close_before_a_stop_sign_has_stopped_at_the_sign(
    maps: dict[str, Path], stub: bool, to_line_m: float, wait_s: float, notes: bool
) -> None:
    # The vehicle waits some metres before its line, because other vehicles sweep over the line. If
    # `stub`, its lane is very short, and it waits on the preceding lane.
    roads = read_network(maps["allway_stop"])
    link = next(
        k
        for k, row in enumerate(roads.links)
        if row["state"] == ord("w") and roads.lanes["num_into"][row["from_lane"]] > 0
    )
    lane = int(roads.links["from_lane"][link])
    before = int(roads.arrays.into[roads.lanes["first_into"][lane]])
    lanes = roads.lanes.copy()
    if stub:
        lanes["length_m"][lane] = 0.2
    arrays = roads.arrays._replace(lanes=lanes)
    steps = np.zeros((1, len(lanes)), PLAN)
    steps["next"], steps["link"] = -1, -1
    steps["next"][0, before], steps["link"][0, lane] = lane, link
    own = before if stub else lane
    rest = to_line_m - (0.2 if stub else 0.0) + 2.5
    row = on_lane(roads, own, float(lanes["length_m"][own]) - rest, wait_s=wait_s)
    note_stop(arrays, steps, row[0], np.zeros(0, np.int32))
    assert row["stopped_at"][0] == (link if notes else -1)
    row["wait_s"] = 0.0
    note_stop(arrays, steps, row[0], np.zeros(0, np.int32))
    assert row["stopped_at"][0] == (link if notes else -1), (
        "the stop is forgotten when the vehicle goes on"
    )
    row["lane"] = int(roads.links["first_internal"][link])
    note_stop(arrays, steps, row[0], np.zeros(0, np.int32))
    assert row["stopped_at"][0] == -1
