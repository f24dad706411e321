"""`zones.policy: hold`: vehicles stop before a border whose other side does not answer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import CavVectorEnv, make_vec
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import ACTION_FASTER
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import load_world
from cavmarl.handoff.coordinator.coordinators import Coordinators
from cavmarl.handoff.coordinator.journal_summary import summarize
from cavmarl.handoff.division import Division
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.ownership.messages import Begin, BorderWait, Record
from cavmarl.ownership.transport import Rates
from cavmarl.verify.equivalence import verify_zones
from cavmarl.verify.fault_campaign import run_campaign
from cavmarl.zones.kernels.zone_lookup import zone_of
from tests.support.faulted import BUSY, Checked, record, replay
from tests.support.sumo_worlds import write_stops

GRACE = 3
HOLD = {"zones.policy": "hold", "zones.grace_ticks": GRACE, "zones.check_invariants": True}
HEALED = 60  # the tick from which on messages arrive
PARTED = Faults(messages={"Prepare": Rates(drop=1.0)}, until=HEALED)
STEPS, ZONES = 60, 4


@dataclass
class Watched:
    """A divided run: what was held in which tick, and the state after every step."""

    vec: CavVectorEnv
    held: dict[int, dict[int, BorderWait]] = field(default_factory=dict)  # by tick, by vehicle
    rows: dict[int, NDArray[np.void]] = field(default_factory=dict)  # by tick, all vehicles
    hashes: list[str] = field(default_factory=list)

    def logged(self, records: Iterable[Record]) -> None:
        for line in records:
            if isinstance(line, Begin):
                self.held[line.tick] = {wait.vehicle: wait for wait in line.waiting if wait.held}

    def delivered(self, *_: object) -> None: ...

    @property
    def division(self) -> Division:
        return self.vec.simulation._tick.division

    def drive(self, steps: int, push: Callable[[NDArray[Any]], None] | None = None) -> Watched:
        self.vec.reset(seed=0)
        (coordinator,) = self.vec.simulation.coordinators
        for _ in range(steps):
            actions = self.vec.suggest_actions().copy()
            if push is not None:
                push(actions)
            self.vec.step(actions)
            self.rows[coordinator.tick] = self.vec.simulation.vehicles(0).copy()
            self.hashes.append(self.vec.state_hash(0))
        return self


def run(
    faults: Faults = PARTED,
    steps: int = STEPS,
    push: Callable[[NDArray[Any]], None] | None = None,
    **more: Any,
) -> Watched:
    overrides = {**BUSY, **HOLD, "zones.faults": faults.to_json(), **more}
    vec = make_vec("grid4x4", num_envs=1, zones=ZONES, overrides=overrides)
    found = Watched(vec)
    (coordinator,) = vec.simulation.coordinators
    coordinator.watch(found)
    coordinator.watch(Checked(vec.simulation.config.zones.max_deferred_ticks))
    return found.drive(steps, push)


@pytest.fixture(scope="module")
def parted() -> Watched:
    return run()


def test_vehicles_stand_before_the_border_and_go_on_when_it_is_healed(parted: Watched) -> None:
    last = parted.rows[HEALED - 2]
    held = parted.held[HEALED - 2]
    standing = last[np.isin(last["id"], list(held)) & (last["speed"] < 0.01)]
    assert len(standing) > 4
    zones = parted.division.zones
    for row in standing:
        front = 0.5 * row["length"] * np.array([np.cos(row["heading"]), np.sin(row["heading"])])
        place = np.array([row["x"], row["y"]]) + front
        assert zone_of(zones, *place) == row["owner"], "its front is before the border"
        least = np.abs(zones.rects[row["owner"]] - [*place, *place]).min()
        assert least < 12.0, "and near to it"
    assert not parted.held[HEALED + 2], "the first acknowledgement lets them go"
    end = {int(row["id"]): row for row in parted.rows[max(parted.rows)]}
    moved = [row for row in standing if int(row["id"]) in end]
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


def test_held_vehicles_brake_in_comfort(parted: Watched) -> None:
    types = parted.vec.simulation._shard.travel.types
    braking = [
        (float(row["accel"]), float(types[row["vtype"]]["decel"]))
        for tick, rows in parted.rows.items()
        for row in rows[np.isin(rows["id"], list(parted.held[tick]))]
    ]
    assert len(braking) > 100
    hard = [accel for accel, decel in braking if accel < -1.5 * decel]
    assert not hard, hard


def test_no_vehicle_is_lost_or_doubled(parted: Watched) -> None:
    for tick, rows in parted.rows.items():
        assert len(set(rows["id"].tolist())) == len(rows), tick
    held = {vehicle for held in parted.held.values() for vehicle in held}
    ever = np.concatenate([rows["id"] for rows in parted.rows.values()])
    assert held <= set(ever.tolist())


def test_a_vehicle_that_cannot_stop_any_more_is_forced(parted: Watched) -> None:
    counts = parted.vec.simulation.transfers[0].counts
    assert counts["forced"] > 0
    assert counts["switched"] > 0, "after healing"


def test_the_same_seed_holds_the_same_vehicles(parted: Watched) -> None:
    again = run()
    assert again.hashes == parted.hashes
    assert again.held == parted.held


def test_deaths_change_nothing_of_it(parted: Watched) -> None:
    harmed = run(replace(PARTED, seed=5, crash_rate=0.003))
    deaths = harmed.vec.simulation.revivals
    assert {death.zone is None for death in deaths} == {True, False}
    assert harmed.hashes == parted.hashes


def test_a_held_world_is_another_one(parted: Watched) -> None:
    whole = record("grid4x4", BUSY, STEPS)
    assert parted.hashes[0] == whole.hashes[1][0], "nothing is held yet"
    assert parted.hashes[-1] != whole.hashes[-1][0]


@pytest.mark.parametrize("faults", [None, Faults(), Faults(messages={"Step": Rates(drop=0.3)})])
def test_where_nothing_is_late_it_is_the_undivided_one(faults: Faults | None) -> None:
    replay(record("grid4x4", BUSY, 20), ZONES, faults, HOLD)


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


def test_such_worlds_are_not_compared() -> None:
    settings = {"zones.policy": "hold", "zones.grace_ticks": 3}
    world = load_world("grid4x4", zones=2, overrides=settings)
    assert not describe_world(*world)["equals_undivided"]
    assert describe_world(*load_world("grid4x4", zones=2))["equals_undivided"]
    for compare in (verify_zones, run_campaign):
        with pytest.raises(ConfigError, match="declared not to equal the undivided one"):
            compare("grid4x4", overrides=settings)
