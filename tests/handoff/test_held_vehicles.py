"""`zones.policy` hold and reroute: vehicles stop before a border that does not answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import ACTION_FASTER
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import load_world
from cavmarl.handoff.coordinator.coordinators import Coordinators
from cavmarl.handoff.coordinator.journal_summary import summarize
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.ownership.messages import Refusal
from cavmarl.ownership.transport import Rates
from cavmarl.verify.equivalence import verify_zones
from cavmarl.verify.fault_campaign import run_campaign
from cavmarl.zones.kernels.zone_lookup import zone_of
from tests.support.faulted import BUSY, record, replay
from tests.support.parted import HEALED, HOLD, PARTED, REROUTE, STEPS, ZONES, Watched, run
from tests.support.sumo_worlds import write_stops


@pytest.fixture(scope="module")
def parted() -> Watched:
    return run()


@pytest.fixture(scope="module", params=[HOLD, REROUTE], ids=["hold", "reroute"])
def either(request: pytest.FixtureRequest) -> Watched:
    return run(**request.param)


def test_vehicles_stand_before_the_border_and_go_on_when_it_is_healed(either: Watched) -> None:
    last = either.rows[HEALED - 2]
    held = either.held[HEALED - 2]
    standing = last[np.isin(last["id"], list(held)) & (last["speed"] < 0.01)]
    assert len(standing) > 4
    zones = either.division.zones
    near = []
    for row in standing:
        front = 0.5 * row["length"] * np.array([np.cos(row["heading"]), np.sin(row["heading"])])
        place = np.array([row["x"], row["y"]]) + front
        assert zone_of(zones, *place) == row["owner"], "its front is before the border"
        near.append(np.abs(zones.rects[row["owner"]] - [*place, *place]).min() < 12.0)
    assert sum(near) > 4
    # One that is to turn away is named much earlier, and may stand for another reason.
    assert all(near) or policy_of(either) == {"zones.policy": "reroute"}
    assert not either.held[HEALED + 2], "the first acknowledgement lets them go"
    end = {int(row["id"]): row for row in either.rows[max(either.rows)]}
    moved = [row for row in standing[near] if int(row["id"]) in end]
    assert len(moved) > 4
    assert all(end[int(row["id"])]["distance_m"] > row["distance_m"] + 20.0 for row in moved)
    assert any(end[int(row["id"])]["owner"] != row["owner"] for row in moved)


def full_throttle(actions: NDArray[Any]) -> None:
    """All agents drive on, whatever they should do; `actions` are written."""
    if actions.ndim == 3:
        actions[..., 0] = 1.0
    else:
        actions[...] = ACTION_FASTER


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_agents_are_held_whatever_they_do(kind: str) -> None:
    many = {"population.agents": 40, "population.background": 0, "action.kind": kind}
    found = run(steps=HEALED // 2, push=full_throttle, **many)
    last = found.rows[HEALED]
    held = last[np.isin(last["id"], list(found.held[HEALED - 1]))]
    assert (held["agent"] >= 0).all()
    assert (held["speed"] < 0.1).sum() >= 2, "they stand all the same"
    zones = found.division.zones
    assert all(zone_of(zones, row["x"], row["y"]) == row["owner"] for row in held)


def test_held_vehicles_brake_in_comfort(either: Watched) -> None:
    types = either.vec.simulation._shard.travel.types
    braking = [
        (float(row["accel"]), float(types[row["vtype"]]["decel"]))
        for tick, rows in either.rows.items()
        for row in rows[np.isin(rows["id"], list(either.held[tick]))]
    ]
    assert len(braking) > 100
    hard = [accel for accel, decel in braking if accel < -1.5 * decel]
    assert not hard, hard


def test_no_vehicle_is_lost_or_doubled(either: Watched) -> None:
    for tick, rows in either.rows.items():
        assert len(set(rows["id"].tolist())) == len(rows), tick
    held = {vehicle for held in either.held.values() for vehicle in held}
    ever = np.concatenate([rows["id"] for rows in either.rows.values()])
    assert held <= set(ever.tolist())


def test_vehicles_stand_before_a_zone_that_refuses_them() -> None:
    found = run(Faults(messages={"Prepare": Rates(refuse=1.0)}, until=HEALED), HEALED // 2 + 6)
    (coordinator,) = found.vec.simulation.coordinators
    assert coordinator.directory.refusals[Refusal.LOAD] > 10
    assert len(found.held[HEALED - 1]) > 4
    backoff = found.vec.simulation.config.zones.backoff_ticks
    assert not found.held[HEALED + backoff + 2]


def test_a_vehicle_that_cannot_stop_any_more_is_forced(parted: Watched) -> None:
    counts = parted.vec.simulation.transfers[0].counts
    assert counts["forced"] > 0
    assert counts["switched"] > 0, "after healing"


def test_the_same_seed_holds_the_same_vehicles(either: Watched) -> None:
    again = run(**policy_of(either))
    assert again.hashes == either.hashes
    assert again.held == either.held


def test_deaths_change_nothing_of_it(either: Watched) -> None:
    harmed = run(replace(PARTED, seed=5, crash_rate=0.003), **policy_of(either))
    deaths = harmed.vec.simulation.revivals
    assert {death.zone is None for death in deaths} == {True, False}
    assert harmed.hashes == either.hashes


def test_a_held_world_is_another_one(parted: Watched) -> None:
    whole = record("grid4x4", BUSY, STEPS)
    assert parted.hashes[0] == whole.hashes[1][0], "nothing is held yet"
    assert parted.hashes[-1] != whole.hashes[-1][0]


@pytest.mark.parametrize("policy", [HOLD, REROUTE], ids=["hold", "reroute"])
@pytest.mark.parametrize("faults", [None, Faults(), Faults(messages={"Step": Rates(drop=0.3)})])
def test_where_nothing_is_late_it_is_the_undivided_one(
    faults: Faults | None, policy: dict[str, Any]
) -> None:
    replay(record("grid4x4", BUSY, 20), ZONES, faults, policy)


def test_what_crosses_was_seen_before_the_border() -> None:
    """Each vehicle that changes its owner was found on its way to that zone before."""
    # No border along a road: over such a one vehicles change lanes, which is on no way ahead.
    settings = {**BUSY, **HOLD, "zones.faults": "{}", "zones.layout": "grid"}
    vec = make_vec("grid4x4", num_envs=1, zones=9, overrides=settings)
    vec.reset(seed=1)
    found: dict[int, set[int]] = {}
    coordination = vec.simulation._tick.coordination
    assert isinstance(coordination, Coordinators)
    (states,) = coordination._states
    for _ in range(30):
        vec.step(vec.suggest_actions().copy())
        for entry in states.ahead:
            found.setdefault(entry.vehicle, set()).add(entry.target)
            assert entry.depth_m <= 0.0
    rows = vec.simulation.transfers[0].rows
    assert len(rows) > 10
    late = [row for row in rows if row.tick > 4 and row.target not in found.get(row.vehicle, ())]
    assert not late


def test_the_journal_names_what_is_held(tmp_path: Path) -> None:
    found = run(steps=8, **{"zones.journal": str(tmp_path / "run.jsonl")})
    found.vec.close()
    summary, _ = summarize(tmp_path / "run.jsonl")
    assert summary.held == sum(map(len, found.held.values())) > 0


def test_vehicles_of_sumo_cannot_be_held(tmp_path: Path) -> None:
    files = [str(path) for path in write_stops(tmp_path)]
    settings = {"traffic.source": "sumo-demand", "traffic.demand": files, **HOLD}
    with pytest.raises(ConfigError, match=r"zones\.policy = 'hold': vehicles that SUMO moves"):
        make_vec("merge", num_envs=1, zones=2, overrides=settings)


@pytest.mark.parametrize("policy", ["hold", "reroute"])
def test_such_worlds_are_not_compared(policy: str) -> None:
    settings = {"zones.policy": policy, "zones.grace_ticks": 3}
    world = load_world("grid4x4", zones=2, overrides=settings)
    assert not describe_world(*world)["equals_undivided"]
    assert describe_world(*load_world("grid4x4", zones=2))["equals_undivided"]
    for compare in (verify_zones, run_campaign):
        with pytest.raises(ConfigError, match="declared not to equal the undivided one"):
            compare("grid4x4", overrides=settings)


def policy_of(found: Watched) -> dict[str, str]:
    return {"zones.policy": found.vec.simulation.config.zones.policy}
