"""The results of shards do not depend on their division into groups."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from cavmarl.engine.simulation import Simulation
from cavmarl.shards.executor import PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import TICKS_IN_ORDER, Shard
from cavmarl.shards.shard_group import ShardGroup
from tests.support.driving import drive, idle, make_simulation, start
from tests.support.world import executor_of, use_executor

STEPS = 2 * TICKS_IN_ORDER
ZONES = 4
TIMES = {"zones.count": ZONES, "clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
Parting = Callable[[Sequence[Shard]], list[Sequence[Shard]]]


class Groups(PhaseExecutor):
    """An executor that calls several groups of shards in turn, as several processes would."""

    def __init__(self, parts: Sequence[Sequence[Shard]]) -> None:
        self._groups = [ShardGroup(part) for part in parts]

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        for group in self._groups:
            phase.run(group, arguments)


def divided(**overrides: Any) -> Simulation:
    simulation = make_simulation(
        "grid4x4", mode="respawn", agents=4, background=60, num_worlds=2,
        overrides={**TIMES, **overrides},
    )  # fmt: skip
    start(simulation, seed=3)
    return simulation


def all_rows(simulation: Simulation) -> bytes:
    """Return the bytes of all rows and counts of all zones."""
    zoned = simulation.division.zoned
    numbers = (zoned.num_owned, zoned.num_rows, zoned.num_near, zoned.num_contacts)
    rows = [
        shard.worlds.rows[w, :num].tobytes()
        for shard in simulation.shards
        for w, num in enumerate(shard.worlds.num_rows)
    ]
    return b"".join([*(array.tobytes() for array in numbers), *rows])


@pytest.mark.parametrize(
    "part",
    [
        lambda shards: [[shard] for shard in shards],
        lambda shards: [[shards[0], shards[2]], [shards[1], shards[3]]],
    ],
    ids=["alone", "in twos"],
)
def test_one_group_of_all_shards_gives_the_results_of_several_groups(part: Parting) -> None:
    together, apart = divided(), divided()
    use_executor(apart, Groups(part(apart.shards)))
    for step in range(STEPS):
        drive(together)
        drive(apart)
        assert all_rows(together) == all_rows(apart), f"step {step}"
        assert together.state_hash(1) == apart.state_hash(1)
    assert together.migrations > 10
    assert together.traffic_stats().departed > 64, "no vehicle has left and been replaced"


def test_a_shard_can_be_advanced_by_itself() -> None:
    simulation = divided()
    shard = simulation.shards[2]
    others = [other for other in simulation.shards if other is not shard]
    before = [other.sides[0].tobytes() + other.sides[1].tobytes() for other in others]
    own = shard.worlds.rows[0, : shard.worlds.num_owned[0]].copy()
    alone = ShardGroup([shard])
    for _ in range(2):
        alone.advance(idle(simulation))
        alone.resolve()
        alone.commit()
    rows = shard.worlds.rows[0, : len(own)]
    assert sorted(rows["id"]) == sorted(own["id"])
    assert (rows["tick"] == 2).all()
    assert [other.sides[0].tobytes() + other.sides[1].tobytes() for other in others] == before


def test_rows_that_other_zones_may_see_are_listed_during_advance() -> None:
    simulation = divided()
    division = simulation.division
    for _ in range(STEPS):
        executor_of(simulation).advance(idle(simulation))
        for shard in simulation.shards:
            left, low, right, high = division.halo.inner[shard.zone]
            worlds = shard.worlds
            for w in range(2):
                rows = worlds.next_rows[w, : worlds.num_owned[w]]
                x, y = rows["x"], rows["y"]
                inside = (left < x) & (x < right) & (low < y) & (y < high)
                noted = worlds.outer[w, : worlds.num_outer[w]]
                np.testing.assert_array_equal(noted["row"], np.flatnonzero(~inside))
                for name in ("x", "y", "s", "speed", "lane"):
                    np.testing.assert_array_equal(noted[name], rows[name][noted["row"]])
        simulation.division.exchange()
        assert (division.zoned.num_outer == -1).all()
        executor_of(simulation).commit()
        simulation.shards[0].worlds.ticks[:] += 1
