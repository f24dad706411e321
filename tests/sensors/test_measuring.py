"""Sensors that measure their own vehicle, compared with slow twins (tests/naive) in each tick."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.env.vector import CavVectorEnv
from cavmarl.sensors.kernels.vehicle_readings import GRAVITY_MPS2
from tests.naive import rig as naive

PLACE = {"x_m": 1.5, "y_m": -0.5, "z_m": 1.2, "yaw_deg": 20.0, "pitch_deg": -5.0, "roll_deg": 3.0}
RIG: dict[str, Any] = {
    "wheels": {"type": "odometry", "rate_hz": 60},
    "imu": {"type": "imu", "rate_hz": 100, **PLACE},
    "level": {"type": "imu", "rate_hz": 20},
    "gnss": {"type": "gnss", "rate_hz": 20, **PLACE},
    "lane": {"type": "lane_boundary", "rate_hz": 20, **PLACE},
    "events": {"type": "collision"},
}
TICK_S = 0.05


def _make(**overrides: Any) -> CavVectorEnv:
    settings = {"clock.sim_dt_s": TICK_S, "clock.ctrl_dt_s": TICK_S, "rig": RIG, **overrides}
    return make_vec("grid4x4", agents=8, background=20, overrides=settings)


def _agents(vec: CavVectorEnv) -> dict[int, np.void]:
    rows = vec.simulation.vehicles().copy()
    return {int(row["agent"]): row for row in rows if row["agent"] >= 0}


def _trembling(vec: CavVectorEnv, rng: np.random.Generator) -> NDArray[np.float32]:
    actions = vec.suggest_actions()
    shaken = actions + rng.normal(0.0, 0.3, actions.shape)
    return np.clip(shaken, -1.0, 1.0).astype(np.float32)


def test_every_sample_equals_twin() -> None:
    vec, rng = _make(), np.random.default_rng(0)
    vec.reset(seed=2)
    before = _agents(vec)
    config, simulation = vec.config.rig, vec.simulation
    checked = 0
    for _ in range(80):
        *_, infos = vec.step(_trembling(vec, rng))
        if infos["episode_over"][0]:
            break
        frames, after = vec.frames(), _agents(vec)
        for agent, row in after.items():
            old = before.get(agent)
            if old is not None and old["id"] != row["id"]:
                old = None
            for k in range(3):
                wheels = frames["wheels"].data[0, agent, k]
                np.testing.assert_allclose(
                    wheels, naive.odometry(old, row, (k + 1) / 3), rtol=1e-5, atol=1e-5
                )
            for name, samples in (("imu", 5), ("level", 1)):
                for k in range(samples):
                    felt = naive.inertia(old, row, (k + 1) / samples, TICK_S, config[name])
                    got = frames[name].data[0, agent, k]
                    np.testing.assert_allclose(got, felt, rtol=1e-5, atol=1e-4)
            lane = naive.lane_boundary(vec.network, simulation.plans, row, config["lane"])
            got = frames["lane"].data[0, agent, 0]
            np.testing.assert_allclose(got, lane, rtol=1e-4, atol=1e-4)
            checked += 1
        before = after
    assert checked > 300


def _circling(steering: float) -> tuple[CavVectorEnv, float]:
    """Return a world with one car, and the radius of its circle at this steering angle."""
    vec = make_vec(
        "ring", agents=1, background=0,
        overrides={"clock.sim_dt_s": 0.01, "clock.ctrl_dt_s": 0.01, "rig": {
            "imu": {"type": "imu", "rate_hz": 100},
            "front": {"type": "imu", "rate_hz": 100, "x_m": 2.0},
            "wheels": {"type": "odometry", "rate_hz": 100},
        }},
    )  # fmt: skip
    vec.reset(seed=0)
    slip = math.atan(0.5 * math.tan(steering))
    return vec, 0.5 * 5.0 / math.sin(slip)


def test_the_imu_measures_the_centripetal_acceleration() -> None:
    steering = 0.1
    vec, radius = _circling(steering)
    actions = np.zeros((1, 1, 2), dtype=np.float32)
    actions[..., 1] = steering / vec.config.action.steering_rad
    for _ in range(20):
        *_, infos = vec.step(actions)
        assert not infos["episode_over"][0]
    frames = vec.frames()
    speed = float(frames["wheels"].data[0, 0, -1, 0])
    assert speed > 1.0
    x, y, z, *rates = frames["imu"].data[0, 0, -1].tolist()
    assert math.hypot(x, y) == pytest.approx(speed**2 / radius, rel=1e-4)
    assert y > 0.0  # the centre of the circle is to the left
    assert z == pytest.approx(GRAVITY_MPS2)
    assert rates == pytest.approx([0.0, 0.0, speed / radius], rel=1e-4)
    # At 2 m ahead of the centre, the acceleration along the car differs by -rate² · 2 m.
    ahead = frames["front"].data[0, 0, -1].tolist()
    assert ahead[0] - x == pytest.approx(-2.0 * (speed / radius) ** 2, rel=1e-3)
    assert ahead[3:] == pytest.approx(rates)


def test_the_imu_of_a_standing_vehicle_measures_only_gravity() -> None:
    imu = {"type": "imu", "rate_hz": 20, "pitch_deg": 30.0}
    vec = _make(rig={"imu": imu})
    vec.reset(seed=0)
    brake = np.zeros(vec.action_space.shape, dtype=np.float32)
    brake[..., 0] = -1.0
    for _ in range(120):
        vec.step(brake)
    felt = vec.frames()["imu"].data[0, 0, -1]
    half = 0.5 * GRAVITY_MPS2
    np.testing.assert_allclose(felt, [half, 0.0, half * math.sqrt(3.0), 0, 0, 0], atol=1e-5)


def test_each_event_is_reported_once_in_its_tick() -> None:
    settings = {"clock.ctrl_dt_s": 0.2, "population.mode": "respawn"}
    vec, rng = _make(**settings), np.random.default_rng(1)
    vec.reset(seed=1)
    reports = 0
    for _ in range(60):
        actions = np.clip(rng.normal(0.3, 1.0, (1, 8, 2)), -1.0, 1.0).astype(np.float32)
        before = vec.simulation.ticks()[0] * TICK_S
        *_, infos = vec.step(actions)
        last = vec.final_frames()["events"] if infos["episode_over"][0] else vec.frames()["events"]
        events = vec.simulation.outputs.events[0]
        for agent in range(8):
            num = int(last.fresh[0, agent])
            new = slice(last.stamp_s.shape[2] - num, None)
            stamps, data = last.stamp_s[0, agent, new], last.data[0, agent, new]
            assert ((stamps > before) & (stamps <= before + 0.2 + 1e-9)).all()
            if not infos["episode_over"][0]:
                assert int(np.bitwise_or.reduce(data[:, 0], initial=0)) == int(events[agent])
            reports += num
    assert reports > 10
