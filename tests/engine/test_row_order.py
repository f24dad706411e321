"""Results do not depend on the order of rows: a world with shuffled rows has the same bytes."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.engine.simulation import Simulation
from tests.support.driving import drive, make_simulation, start

STEPS = 150


def shuffle_rows(simulation: Simulation, rng: np.random.Generator) -> int:
    """Shuffle the committed rows of each world; return how many rows changed their place."""
    worlds = simulation.shards[0].worlds
    moved = 0
    for w, num in enumerate(worlds.num_owned):
        order = rng.permutation(num)
        worlds.rows[w, :num] = worlds.rows[w, order]
        moved += np.count_nonzero(order != np.arange(num))
    return moved


SENSORS = {
    "sensors.kinematics.vehicles_count": 6,
    "sensors.kinematics.order": "shuffled",
    "sensors.occupancy_grid.features": ["presence", "vx", "on_road"],
    "sensors.lidar_observation.cells": 16,
    "sensors.stack": 3,
}


@pytest.mark.parametrize(
    ("env", "mode", "agents", "background"),
    [
        ("ring", "closed", 1, 24),
        ("ring", "closed", 8, 8),
        ("merge", "respawn", 1, 24),
        ("merge", "respawn", 8, 12),
        ("merge", "open", 8, 12),
        ("grid4x4", "respawn", 1, 60),
        ("grid4x4", "open", 8, 40),
        ("grid4x4", "closed", 8, 40),
    ],
)
def test_shuffled_rows_give_the_same_bytes(
    env: str, mode: str, agents: int, background: int
) -> None:
    tidy, shuffled = (
        make_simulation(env, mode=mode, agents=agents, background=background, overrides=SENSORS)
        for _ in range(2)
    )
    for simulation in (tidy, shuffled):
        start(simulation, seed=5)
    rng = np.random.default_rng(0)
    # Every second agent steers to the left more than its driver can correct, so some vehicles
    # collide or leave the road, and new vehicles enter.
    pull = np.zeros((1, tidy.outputs.present.shape[1], 2))
    pull[0, ::2, 1] = 1.6
    moved = 0
    for step in range(STEPS):
        moved += shuffle_rows(shuffled, rng)
        noise = rng.normal(pull * (step > 50), (2.0, 0.1)) if agents > 1 else 0.0
        drive(tidy, noise)
        drive(shuffled, noise)
        assert shuffled.state_hash() == tidy.state_hash(), f"step {step}"
        assert shuffled.traffic_stats() == tidy.traffic_stats()
        for mine, other in zip(shuffled.outputs, tidy.outputs, strict=True):
            np.testing.assert_array_equal(mine, other)
    assert moved > 10 * STEPS, "too few rows changed their place"
    assert agents == 1 or tidy.traffic_stats().removed > 0
