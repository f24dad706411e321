"""Two shards, each with a part of the vehicles, sense and switch signals as one that has them all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.kernels.arrays import Worlds
from cavmarl.kernels.codes import DRIVER_AGENT
from cavmarl.kernels.signals import merge_detections
from cavmarl.runtime.commons import Commons
from cavmarl.runtime.executor import SerialExecutor
from cavmarl.runtime.simulation import Simulation
from cavmarl.shard.shard import COMMON, Commands, Shard
from tests.driving import idle, make_simulation, start, suggested

STEPS = 120
SIGNALS = ("signal_phase", "controllers", "detected_s")

SENSORS: dict[str, Any] = {
    "sensors.lidar.rays": 32,
    "sensors.kinematics.vehicles_count": 6,
    "sensors.kinematics.order": "shuffled",
    "sensors.occupancy_grid.features": ["presence", "vx", "on_road"],
    "sensors.lidar_observation.cells": 16,
    "sensors.puffer_drive.enabled": True,
    "sensors.stack": 3,
    "terms.team_share": 0.3,
}


class Halves:
    """The vehicles of an undivided world in two shards, by x, each with the others as ghosts."""

    def __init__(self, whole: Simulation, common: bool = True) -> None:
        config, network, traffic = whole.config, whole.network, whole._traffic
        self.commons = Commons(config, network, whole.num_worlds)
        self.shards: list[Shard] = []
        for _ in range(2):
            shard = Shard(
                config,
                network,
                traffic.plans,
                traffic.travel,
                whole.num_worlds,
                whole.capacity,
                self.commons.outputs,
                self.shards[0].worlds if self.shards and common else None,
            )
            self.shards.append(shard)
        self.executor = SerialExecutor(self.shards)
        min_x, _, max_x, _ = network.extent_m
        self._border = 0.5 * (min_x + max_x)

    def take(self, whole: Worlds) -> list[int]:
        """Copy the rows and the tick of a world; how many vehicles each shard owns."""
        for shard in self.shards:
            shard.worlds.ticks[:] = whole.ticks
            shard.worlds.keys[:] = whole.keys
        for w, num in enumerate(whole.num_owned):
            rows = whole.rows[w, :num]
            right = rows["x"] >= self._border
            for shard, mine in zip(self.shards, (~right, right), strict=True):
                shard.worlds.rows[w, :num] = np.concatenate([rows[mine], rows[~mine]])
                shard.worlds.num_owned[w] = np.count_nonzero(mine)
                shard.worlds.num_rows[w] = num
        return [int(shard.worlds.num_owned.sum()) for shard in self.shards]

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """What a simulation does at the end of a step."""
        self.commons.clear_outputs(chosen)
        self.executor.each("sense", chosen)
        self.commons.settle_outputs(chosen)
        self.executor.each("credit", chosen)

    def owned(self, world: int) -> NDArray[np.void]:
        """All vehicles of a world, by id."""
        parts = [s.worlds.rows[world, : s.worlds.num_owned[world]] for s in self.shards]
        rows = np.concatenate(parts)
        return rows[np.argsort(rows["id"])]


def steps(whole: Simulation, halves: Halves, seed: int) -> Iterator[int]:
    """Drive an undivided world, and hand the halves its rows as its agents sense them."""
    everywhere = np.ones(whole.num_worlds, dtype=np.bool_)
    rng = np.random.default_rng(seed)
    start(whole, seed)
    shares = halves.take(whole.worlds)
    halves.sense(everywhere)
    yield min(shares)
    for step in range(STEPS):
        noise = rng.normal(0.0, (2.0, 0.05), size=(*whole.outputs.present.shape, 2))
        whole.step(Commands(suggested(whole) + noise, idle(whole).meta_actions))
        shares = halves.take(whole.worlds)
        halves.sense(everywhere)
        yield min(shares)
        if step == STEPS // 2:
            chosen = np.arange(whole.num_worlds) == 1
            whole.reset(chosen)
            halves.take(whole.worlds)
            halves.sense(chosen)
        whole.retire_agents()


@pytest.mark.parametrize(
    ("env", "mode", "agents", "background"),
    [("merge", "entering", 8, 16), ("grid4x4", "seats", 10, 40), ("ring", "closed", 6, 10)],
)
def test_agents_get_the_same(env: str, mode: str, agents: int, background: int) -> None:
    whole = make_simulation(
        env, mode=mode, agents=agents, background=background, num_worlds=2, overrides=SENSORS
    )
    halves = Halves(whole)
    before: dict[tuple[int, int], float] = {}
    both = 0
    for smaller in steps(whole, halves, seed=5):
        both += smaller > 0
        for name, mine, other in zip(
            whole.outputs._fields, halves.commons.outputs, whole.outputs, strict=True
        ):
            np.testing.assert_array_equal(mine, other, err_msg=name)
    assert both > STEPS // 2, "hardly ever vehicles in both shards"
    assert not before
