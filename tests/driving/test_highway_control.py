from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cavmarl.driving.kernels.motion import highway_control as control
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from tests.naive import control as naive
from tests.naive.idm import not_zero
from tests.support.builders import angles


@given(st.floats(-5.0, 45.0), st.floats(-8.0, 8.0), angles(), st.floats(1.0, 20.0))
def test_steering_control_equals_twin(
    speed: float, d: float, heading_error: float, length: float
) -> None:
    # Skip cars that face exactly backwards, because rounding decides the direction of their turn.
    approach = math.asin(max(-1.0, min(1.0, -d / 0.6 / not_zero(speed))))
    approach = max(-math.pi / 4, min(math.pi / 4, approach))
    assume(abs(abs(heading_error + approach) - math.pi) > 1e-9)
    steering = control.steering_control(speed, d, heading_error, length)
    twin = naive.steering_control(speed, d, heading_error, length)
    # The twin uses asin, which loses half of the digits near ±1, where its slope is infinite.
    assert steering == pytest.approx(twin, abs=1e-7)
    assert abs(steering) <= control.MAX_STEERING_RAD


@given(st.floats(-40.0, 40.0), st.floats(0.0, 40.0))
def test_speed_control_is_proportional(speed: float, target_speed: float) -> None:
    accel = control.speed_control(speed, target_speed)
    assert accel == pytest.approx((target_speed - speed) / 0.6, rel=1e-12)


@pytest.mark.parametrize("speed", [3.0, 15.0, 30.0])
def test_a_car_converges_to_the_centre_of_its_lane(speed: float) -> None:
    y, heading = 3.0, 0.2
    for _ in range(200):
        steering = control.steering_control(speed, y, -heading, 5.0)
        _, y, heading, _, _ = bicycle_step(0.0, y, heading, speed, 0.0, steering, 5.0, 0.05)
    assert abs(y) < 0.01
    assert abs(heading) < 0.01
