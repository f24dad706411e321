"""`population.types`: cars, trucks and buses, each with its own dynamics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicle_types import AGENT_TYPES

FLEET = ["car", "truck", "bus"]


def make(env: str = "merge", types: list[str] = FLEET, **keywords: Any) -> Any:
    overrides = {
        "population.types": types,
        "sensors.ego.size": True,
        **keywords.pop("overrides", {}),
    }
    return cavmarl.make_vec(env, agents=6, background=4, overrides=overrides, **keywords)


def sizes(vec: Any) -> dict[int, tuple[float, float]]:
    rows = vec.worlds.simulation.vehicles(0)
    return {int(row["agent"]): (row["length"], row["width"]) for row in rows if row["agent"] >= 0}


def test_types_are_assigned_in_turn_to_agents_and_their_successors() -> None:
    vec = make()
    vec.reset(seed=0)
    wanted = {"car": (5.0, 2.0)} | {
        name: (kind.length, kind.width) for name, kind in AGENT_TYPES.items()
    }
    rng = np.random.default_rng(0)
    followed = 0
    for _ in range(120):  # random actions make vehicles leave the road, so that others replace them
        actions = rng.uniform(-1.0, 1.0, (1, 6, 2)).astype(np.float32)
        _, _, terminated, _, _ = vec.step(actions)
        followed += int(terminated.sum())
        for agent, size in sizes(vec).items():
            assert size == wanted[FLEET[agent % 3]]
    assert followed > 6


def test_ego_observations_contain_the_size() -> None:
    vec = make()
    observations, _ = vec.reset(seed=0)
    assert np.allclose(observations[0, :3, 13], [5.0 / 20.0, 8.0 / 20.0, 12.0 / 20.0])
    assert np.allclose(observations[0, :3, 14], [2.0 / 4.0, 2.5 / 4.0, 2.55 / 4.0])
    assert np.allclose(observations[0, :3, 15], [0.5, 0.48, 0.6])
    assert np.allclose(observations[0, :3, 17], [1.0, 0.15, 0.12])


def test_accelerating_braking_and_turning_are_limited_by_the_type() -> None:
    overrides = {"action.steering_rad": 1.2, "action.acceleration_mps2": 5.0}
    vec = make("highway", overrides=overrides, zones=1)
    vec.reset(seed=1)
    before = {int(row["agent"]): row.copy() for row in vec.worlds.simulation.vehicles(0)}
    full = np.zeros((1, 6, 2), dtype=np.float32)
    full[..., 0] = 1.0
    vec.step(full)
    gained = {
        int(row["agent"]): (row["speed"] - before[int(row["agent"])]["speed"]) / 0.2
        for row in vec.worlds.simulation.vehicles(0)
        if row["agent"] >= 0
    }
    for agent, accel in gained.items():
        most = {"car": 5.0, "truck": 1.5, "bus": 1.2}[FLEET[agent % 3]]
        assert accel == pytest.approx(most, abs=1e-6)
    full[..., 1] = 1.0
    vec.step(full)
    for row in vec.worlds.simulation.vehicles(0):
        if row["agent"] >= 0:
            most = {"car": 1.2, "truck": 0.7, "bus": 0.75}[FLEET[row["agent"] % 3]]
            assert row["steering"] == pytest.approx(most, abs=1e-6)


def test_the_yaw_rate_follows_from_the_wheelbase() -> None:
    """A bus has a wheelbase of 6 m."""
    vec = make("highway", types=["bus"])
    vec.reset(seed=1)
    action = np.zeros((1, 6, 2), dtype=np.float32)
    action[..., 1] = 0.1
    vec.step(action)
    angle = 0.1 * vec.config.action.steering_rad
    slip = np.arctan(0.5 * np.tan(angle))
    for row in vec.worlds.simulation.vehicles(0):
        if row["agent"] >= 0:
            assert row["yaw_rate"] == pytest.approx(row["speed"] * np.sin(slip) / 3.0, rel=0.02)


def test_a_krauss_driver_keeps_the_speed_limit_if_it_decides_every_few_ticks() -> None:
    vec = make("highway", types=["car"], overrides={"traffic.model": "Krauss"})
    assert vec.config.clock.ticks_per_step > 1
    vec.reset(seed=2)
    accels = []
    for step in range(100):
        vec.step(vec.suggest_actions())
        rows = vec.worlds.simulation.vehicles(0)
        fast = (rows["agent"] >= 0) & (rows["speed"] > 20.0)
        accels += np.abs(rows["accel"][fast]).tolist() if step > 50 else []
    assert len(accels) > 50
    assert np.median(accels) < 0.5


def test_zones_change_no_result() -> None:
    def drive(**keywords: Any) -> list[bytes]:
        vec = make("grid4x4", **keywords)
        vec.reset(seed=3)
        return [vec.step(vec.suggest_actions())[0].tobytes() for _ in range(60)]

    assert drive() == drive(zones=4)


@pytest.mark.parametrize("types", [[], ["lorry"], "bus"])
def test_unknown_types_are_refused(types: Any) -> None:
    with pytest.raises(ConfigError, match=r"population\.types"):
        make(types=types)
