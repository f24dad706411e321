"""Two shards with half of the vehicles each give the results of one shard with all vehicles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.simulation import Simulation
from cavmarl.shards.shard import COMMON, Commands, Shard, common_of, make_zone_state
from cavmarl.shards.shard_group import ShardGroup
from cavmarl.zones.partition.zone_halo import zone_halo
from cavmarl.zones.partition.zone_layouts import cut_map
from tests.support.actuated import actuated_grid
from tests.support.driving import idle, make_simulation, make_traffic, start, suggested
from tests.support.world import traffic_of

STEPS = 120
TICKS = 1000
Returns = dict[tuple[int, int], float]  # (world, vehicle id) → return

SENSORS: dict[str, Any] = {
    "sensors.lidar.rays": 32,
    "sensors.kinematics.vehicles_count": 6,
    "sensors.kinematics.order": "shuffled",
    "sensors.occupancy_grid.features": ["presence", "vx", "on_road"],
    "sensors.lidar_observation.cells": 16,
    "sensors.stack": 3,
    "terms.team_share": 0.3,
}

EVERYWHERE_M = 1e5


class Halves:
    """Two shards with the vehicles left and right of the middle of undivided worlds.

    Each shard has ghosts of all vehicles of the other shard.

    Args:
        whole: the undivided worlds.
    """

    def __init__(self, whole: Simulation) -> None:
        self.shared = SharedOutputs(whole.config, whole.network, whole.num_worlds)
        traffic = traffic_of(whole)
        shards = []
        partition = cut_map(whole.network, "strips", 2)
        halo = zone_halo(partition, EVERYWHERE_M)
        zoned = make_zone_state(2, whole.num_worlds, whole.capacity)
        for zone in range(2):
            shard = Shard(
                whole.config,
                whole.network,
                plans=traffic.plans_now,
                travel=traffic.travel,
                zoned=zoned,
                outputs=self.shared.outputs,
                zone=zone,
                zones=partition.arrays,
                halo=halo,
                first=shards[0] if shards else None,
            )
            shards.append(shard)
        self.shards = shards
        self.executor = ShardGroup(shards)
        min_x, _, max_x, _ = whole.network.extent_m
        self._border = 0.5 * (min_x + max_x)

    def take(self, whole: Worlds, returns: Returns) -> bool:
        """Copy rows, tick and keys; return whether both shards own vehicles.

        Args:
            whole: the undivided worlds.
            returns: the agents' returns before the step.
        """
        first = self.shards[0].worlds
        first.ticks[:] = whole.ticks
        first.keys[:] = whole.keys
        for w, num in enumerate(whole.num_owned):
            rows = whole.rows[w, :num].copy()
            rows["episode_return"] = [returns.get((w, i), 0.0) for i in rows["id"]]
            right = rows["x"] >= self._border
            for shard, mine in zip(self.shards, (~right, right), strict=True):
                shard.worlds.rows[w, :num] = np.concatenate([rows[mine], rows[~mine]])
                shard.worlds.num_owned[w] = np.count_nonzero(mine)
                shard.worlds.num_rows[w] = num
        return all(shard.worlds.num_owned.all() for shard in self.shards)

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Compute observations and rewards, like a simulation at the end of a step."""
        self.shared.clear_outputs(chosen)
        self.executor.sense(chosen)
        self.shared.settle_outputs(chosen)
        self.executor.credit(chosen)


def returns_of(*parts: Worlds) -> Returns:
    """Return the episode return of each agent."""
    return {
        (w, row["id"]): row["episode_return"]
        for worlds in parts
        for w, num in enumerate(worlds.num_owned)
        for row in worlds.rows[w, :num]
        if row["driver"] == DRIVER_AGENT
    }


@pytest.mark.parametrize(
    ("env", "mode", "agents", "background"),
    [("merge", "open", 8, 16), ("grid4x4", "respawn", 10, 40), ("ring", "closed", 6, 10)],
)
def test_agents_in_two_shards_get_the_results_of_one_shard(
    env: str, mode: str, agents: int, background: int
) -> None:
    whole = make_simulation(
        env, mode=mode, agents=agents, background=background, num_worlds=2, overrides=SENSORS
    )
    halves = Halves(whole)
    rng = np.random.default_rng(5)
    start(whole, seed=5)
    halves.take(whole.worlds, {})
    halves.shared.switch_signals(common_of(halves.shards[0].worlds))
    halves.sense(np.array([True, True]))
    both = 0
    for step in range(STEPS):
        returns = returns_of(whole.worlds)
        chosen = np.array([True, True])
        if step == STEPS // 2:
            chosen[0] = False
            whole.reset(chosen)
            returns = {key: value for key, value in returns.items() if key[0] == 0}
        else:
            noise = rng.normal(0.0, (2.0, 0.05), size=(*whole.outputs.present.shape, 2))
            whole.step(Commands(suggested(whole) + noise, idle(whole).meta_actions))
        both += halves.take(whole.worlds, returns)
        halves.shared.switch_signals(common_of(halves.shards[0].worlds))
        halves.sense(chosen)
        for name, mine, one in zip(
            whole.outputs._fields, halves.shared.outputs, whole.outputs, strict=True
        ):
            np.testing.assert_array_equal(mine, one, err_msg=f"{name}, step {step}")
        expected = returns_of(whole.worlds)
        assert returns_of(*(shard.worlds for shard in halves.shards)) == expected
        assert step != STEPS // 2 - 1 or any(expected.values())
        whole.retire_agents()
    assert both > STEPS // 2, "a shard was often empty"


def test_signals_of_two_shards_equal_those_of_one_shard(tmp_path: Path) -> None:
    clock = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.1}
    whole = make_traffic(actuated_grid(tmp_path), background=30, num_worlds=2, overrides=clock)
    halves = Halves(whole)
    start(whole, seed=5)
    seen = set()
    for tick in range(TICKS):
        if tick == TICKS // 2:
            whole.reset(np.array([False, True]))
        elif tick > 0:
            whole.step(idle(whole))
        halves.take(whole.worlds, {})
        halves.executor.detect()
        halves.shared.switch_signals(common_of(halves.shards[0].worlds))
        for name in ("signal_phase", "controllers", "detected_s"):
            expected = getattr(whole.worlds, name)
            assert getattr(halves.shards[0].worlds, name).tobytes() == expected.tobytes()
        seen.add(whole.worlds.signal_phase.tobytes())
    assert len(seen) > 3
    assert halves.shards[0].worlds.detected_s.any()


def test_the_shards_of_a_world_share_its_clock_and_signals() -> None:
    halves = Halves(make_simulation("ring", mode="closed", agents=1, background=2))
    first, second = (shard.worlds for shard in halves.shards)
    shared = {name for name in Worlds._fields if getattr(first, name) is getattr(second, name)}
    assert shared == set(COMMON)
