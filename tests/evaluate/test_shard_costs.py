"""Measured costs of shards belong to their zones, and measuring them changes no result.

No test checks a duration.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate import shard_costs
from cavmarl.evaluate.built_in_runs import DrivenWorld, world_maker
from cavmarl.evaluate.shard_costs import MeasuredRound, measure_rounds, measure_shards


@pytest.fixture
def simulation() -> Simulation:
    return world_maker("grid4x4", seconds=60, agents=4, background=20, seed=1)(4)


def test_measuring_each_zone_changes_no_result(simulation: Simulation) -> None:
    plain = DrivenWorld(world_maker("grid4x4", seconds=60, agents=4, background=20, seed=1)(4))
    rounds = list(measure_rounds(simulation, 2, 5, before=5))
    for _ in range(15):
        plain.step(plain.commands())
    assert simulation.state_hash() == plain.simulation.state_hash()
    assert np.array_equal(
        np.sort(rounds[-1].ids), np.sort(plain.simulation.vehicles()["id"].astype(np.int64))
    )
    assert rounds[-1].agents.sum() == 4
    assert rounds[-1].places.shape == (len(rounds[-1].ids), 2)


def test_every_zone_has_a_positive_cost(simulation: Simulation) -> None:
    told: list[tuple[int, int]] = []
    found = measure_shards(
        simulation, 2, 1, steps=10, before=2, told=lambda *counts: told.append(counts)
    )
    assert told == [(done, 24) for done in range(1, 25)]
    costs = found.costs
    assert [(shard.world, shard.zone) for shard in costs] == [
        (world, zone) for world in (0, 1) for zone in range(4)
    ]
    assert all(shard.cost_s > 0.0 for shard in costs)
    assert found.zone_costs_s() == [
        costs[zone].cost_s + costs[4 + zone].cost_s for zone in range(4)
    ]
    assert len(found.places) > 24


def test_a_cost_is_the_median_of_five_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    # The first round is expensive in the first zone, as if a kernel were loaded there.
    round_costs_s = ([90.0, 1.0], [1.0, 1.0], [2.0, 5.0], [3.0, 1.0], [2.0, 1.0])
    none = np.zeros(0, np.int64)
    rounds = [
        MeasuredRound(np.array(costs_s), none, np.zeros((0, 2)), none.astype(np.bool_))
        for costs_s in round_costs_s
    ]
    monkeypatch.setattr(shard_costs, "measure_rounds", lambda *_, **__: iter(rounds))
    world: Any = SimpleNamespace(seed=lambda seed, number: None, reset=lambda: None)
    found = measure_shards(world, 1, 0, steps=5, before=1)
    assert [shard.cost_s for shard in found.costs] == [2.0, 1.0]


def test_suggested_actions_are_not_part_of_the_cost(simulation: Simulation) -> None:
    clock = simulation.zones.measure_costs()
    simulation.suggest(np.zeros((*simulation.outputs.present.shape, 2)))
    assert not clock.take_s().any()


def test_invalid_numbers_of_steps_are_refused(simulation: Simulation) -> None:
    with pytest.raises(ConfigError, match="steps = 4"):
        measure_shards(simulation, 1, 0, steps=4, before=1)
    with pytest.raises(ConfigError, match="before = 0"):
        next(measure_rounds(simulation, 1, 1, before=0))
