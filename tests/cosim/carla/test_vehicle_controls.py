"""CARLA's controls become actions with the same signs and limits."""

from __future__ import annotations

import math

import pytest

from cavmarl.config.action import ActionConfig
from cavmarl.cosim.carla.vehicle_controls import (
    BRAKE_MPS2,
    FULL_STEER_RAD,
    THROTTLE_MPS2,
    AckermannControl,
    CarlaControl,
    action_of,
    motion_of,
)


def test_throttle_accelerates_and_brakes_slow_down() -> None:
    assert motion_of(CarlaControl(throttle=1.0), 0.0) == (THROTTLE_MPS2, 0.0)
    assert motion_of(CarlaControl(throttle=0.5), 10.0)[0] == pytest.approx(2.25 - 0.2 - 0.2)
    assert motion_of(CarlaControl(brake=1.0), 0.0) == (-BRAKE_MPS2, 0.0)
    assert motion_of(CarlaControl(throttle=0.2, hand_brake=True), 0.0)[0] < -BRAKE_MPS2 / 2
    assert motion_of(CarlaControl(throttle=1.0, reverse=True), 0.0)[0] == 0.0


def test_steer_is_positive_to_the_right() -> None:
    assert motion_of(CarlaControl(steer=1.0), 0.0)[1] == pytest.approx(-FULL_STEER_RAD)
    assert motion_of(CarlaControl(steer=-7.0), 0.0)[1] == pytest.approx(FULL_STEER_RAD)


def test_an_ackermann_control_approaches_its_speed() -> None:
    speed = 0.0
    for _ in range(200):
        acceleration, angle = motion_of(AckermannControl(0.1, 0.0, 8.0, 2.0, 0.0), speed)
        assert angle == -0.1
        assert acceleration <= 2.0
        speed += 0.05 * acceleration
    assert speed == pytest.approx(8.0, abs=0.01)


def test_actions_are_within_the_bounds_of_the_agent() -> None:
    config = ActionConfig(acceleration_mps2=5.0, steering_rad=0.5)
    pair = action_of(CarlaControl(brake=1.0, steer=-1.0), 10.0, config)
    assert pair.tolist() == [-1.0, 1.0]
    steer = math.degrees(float(action_of(CarlaControl(steer=0.1), 0.0, config)[1]) * 0.5)
    assert steer == pytest.approx(-7.0, abs=1e-4)
