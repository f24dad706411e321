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
    backward_motion_of,
    drives_backward,
    motion_of,
    same_turn,
)
from cavmarl.driving.kernels.motion.bicycle import bicycle_step


def test_throttle_accelerates_and_brakes_slow_down() -> None:
    assert motion_of(CarlaControl(throttle=1.0), 0.0) == (THROTTLE_MPS2, 0.0)
    assert motion_of(CarlaControl(throttle=0.5), 10.0)[0] == pytest.approx(2.25 - 0.2 - 0.2)
    assert motion_of(CarlaControl(brake=1.0), 0.0) == (-BRAKE_MPS2, 0.0)
    assert motion_of(CarlaControl(throttle=0.2, hand_brake=True), 0.0)[0] < -BRAKE_MPS2 / 2
    assert motion_of(CarlaControl(throttle=1.0, reverse=True), 0.0)[0] == 0.0
    assert motion_of(CarlaControl(throttle=1.0, reverse=True), 5.0)[0] < -THROTTLE_MPS2


def test_the_reverse_gear_drives_backward_from_a_standstill() -> None:
    back = CarlaControl(throttle=1.0, reverse=True, steer=0.5)
    assert drives_backward(back, 0.0)
    assert not drives_backward(back, 3.0)
    assert not drives_backward(back._replace(brake=1.0), 0.0)
    assert not drives_backward(back._replace(hand_brake=True), 0.0)
    assert drives_backward(CarlaControl(throttle=1.0, manual_gear_shift=True, gear=-1), 0.0)
    assert backward_motion_of(back, 0.0) == (-THROTTLE_MPS2, pytest.approx(-0.5 * FULL_STEER_RAD))
    for control in (CarlaControl(throttle=1.0), back._replace(throttle=0.0, brake=1.0)):
        assert drives_backward(control, -3.0)
        assert backward_motion_of(control, -3.0)[0] > BRAKE_MPS2
    assert drives_backward(AckermannControl(0.1, 0.0, -2.0, 0.0, 0.0), 0.0)
    assert backward_motion_of(AckermannControl(0.1, 0.0, -2.0, 0.0, 0.0), 0.0)[0] == -4.0
    assert backward_motion_of(AckermannControl(0.1, 0.0, -2.0, 0.0, 0.0), 0.0)[1] == -0.1


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
    pair = action_of(CarlaControl(brake=1.0, steer=-1.0), 10.0, 0.6, config)
    assert pair.tolist() == [-1.0, 1.0]
    steer = math.degrees(float(action_of(CarlaControl(steer=0.1), 0.0, 0.6, config)[1]) * 0.5)
    assert steer == pytest.approx(-7.0, abs=1e-4)


def test_vehicles_with_different_wheelbases_get_the_same_yaw_rate() -> None:
    for angle in (-1.0, 0.05, 0.6):
        longer = same_turn(angle, 1.4)
        yaw_rates = [
            bicycle_step(0.0, 0.0, 0.0, 5.0, 0.0, steering, wheelbase_m, 0.05)[4]
            for steering, wheelbase_m in ((angle, 3.0), (longer, 4.2))
        ]
        assert yaw_rates[0] == pytest.approx(yaw_rates[1])
    assert same_turn(1.2, 3.0) < 0.5 * math.pi
