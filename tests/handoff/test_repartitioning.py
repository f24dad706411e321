"""A partition that changes while a world runs balances loads and does not change results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.env.vector import make_vec
from cavmarl.handoff import repartitioning
from cavmarl.handoff.repartition_plan import Proposal
from cavmarl.zones.kernels.zone_lookup import zone_of
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.driving import drive, make_simulation, start

OFTEN = {
    "zones.repartition_steps": 3,
    "zones.repartition_tolerance": 0.0,
    "zones.check_invariants": True,
}


def worlds(env: str, zones: int, mode: str = "respawn", **overrides: Any) -> Simulation:
    made = make_simulation(
        env, mode=mode, agents=6, background=40, num_worlds=2,
        overrides={"zones.count": zones, **overrides},
    )  # fmt: skip
    start(made, seed=4)
    return made


@pytest.mark.parametrize("zones", [2, 4, 9])
@pytest.mark.parametrize(("env", "mode"), [("grid4x4", "respawn"), ("merge", "open")])
def test_a_repartitioned_world_equals_the_undivided_one(env: str, mode: str, zones: int) -> None:
    whole, repartitioned = worlds(env, 1, mode), worlds(env, zones, mode, **OFTEN)
    for _ in range(80):
        drive(whole)
        drive(repartitioned)
        for w in range(2):
            assert whole.state_hash(w) == repartitioned.state_hash(w)
        for name, expected in whole.outputs._asdict().items():
            assert expected.tobytes() == getattr(repartitioned.outputs, name).tobytes(), name
    assert len(repartitioned.zones.repartitions) > 2
    assert (
        repartitioned.migrations
        > sum(change.moved for change in repartitioned.zones.repartitions) // 2
        > 0
    )


def test_a_vehicle_that_enters_just_before_repartitioning_gets_its_new_zone() -> None:
    repartitioned = worlds("merge", 4, "open", **OFTEN)
    entered = 0
    for _ in range(120):
        drive(repartitioned)
        pending = [coordinator.notes()[0] for coordinator in repartitioned.coordinators]
        for w, births in enumerate(pending):
            for birth in births:
                zone, row = repartitioned.division.changes.find(w, birth.vehicle)
                place = repartitioned.division.owned(w, zone)[row]
                zones = repartitioned.partition.arrays
                assert zone == birth.zone == zone_of(zones, place["x"], place["y"])
                entered += len(repartitioned.zones.repartitions) > 0
    assert entered > 0


def test_the_journal_of_a_repartitioned_world_has_each_change_of_owner(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    repartitioned = make_simulation(
        "rush", mode="closed", agents=20, background=0,
        overrides={"zones.count": 4, "zones.journal": str(path), **OFTEN},
    )  # fmt: skip
    start(repartitioned, seed=1)
    for _ in range(30):
        drive(repartitioned)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert sum(len(line.get("switches", ())) for line in lines) == repartitioned.migrations > 20


def test_zones_with_balanced_loads_are_not_repartitioned() -> None:
    calm = worlds(
        "grid4x4", 2, **{"zones.repartition_steps": 3, "zones.repartition_tolerance": 0.9}
    )
    before = calm.partition
    for _ in range(30):
        drive(calm)
    assert calm.zones.repartitions == []
    assert calm.partition is before


def test_worlds_over_workers_are_repartitioned() -> None:
    overrides = {"zones.repartition_steps": 3, "zones.repartition_tolerance": 0.0}
    alone, shared = (
        make_vec("grid4x4", num_envs=2, zones=4, workers=workers, overrides=overrides)
        for workers in (0, 2)
    )
    try:
        for vec in (alone, shared):
            vec.reset(seed=2)
        for _ in range(20):
            actions = alone.suggest_actions()
            for ours, theirs in zip(alone.step(actions)[:2], shared.step(actions)[:2], strict=True):
                np.testing.assert_array_equal(ours, theirs)
        assert [alone.state_hash(w) for w in range(2)] == [shared.state_hash(w) for w in range(2)]
    finally:
        shared.close()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"zones.repartition_steps": -1}, "zones.repartition_steps"),
        ({"zones.repartition_tolerance": float("nan")}, "zones.repartition_tolerance"),
    ],
)
def test_invalid_settings_of_repartitioning_are_refused(
    overrides: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        make_vec("grid4x4", zones=2, overrides=overrides)


def test_repartitioning_of_a_world_over_workers_is_refused() -> None:
    with pytest.raises(ConfigError, match="over workers needs zones that do not change"):
        make_vec("grid4x4", zones=4, workers=2, overrides={"zones.repartition_steps": 5})


def test_a_swap_of_zones_hands_over_distant_vehicles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vehicles whose new zone is not a neighbor count as teleports; all results are equal."""
    path = tmp_path / "run.jsonl"
    strips = {"zones.layout": "strips", "zones.journal": str(path), "zones.count": 9, **OFTEN}
    strips["zones.repartition_steps"] = 6
    whole, repartitioned = (
        make_simulation("grid4x4", mode="closed", agents=6, background=60, overrides=overrides)
        for overrides in ({}, strips)
    )

    def turn(network: Any, partition: ZonePartition, *_: Any, **__: Any) -> Proposal:
        return Proposal(ZonePartition(partition.bounds, partition.rects[::-1]), 2.0, 1.0, 60)

    monkeypatch.setattr(repartitioning, "propose_zones", turn)
    for simulation in (whole, repartitioned):
        start(simulation, seed=4)
    for _ in range(12):
        drive(whole)
        drive(repartitioned)
        assert whole.state_hash() == repartitioned.state_hash()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    (turned,) = [line for line in lines if line.get("teleports")]
    switches = {vehicle: (source, target) for vehicle, source, target, *_ in turned["switches"]}
    assert len(switches) > 40
    for vehicle, (source, target) in switches.items():
        assert (vehicle in turned["teleports"]) == (abs(source - target) > 1)
