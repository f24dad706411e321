from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.driving.kernels.motion import bicycle as kinematics
from tests.naive import kinematics as naive
from tests.naive.geometry import wrap_angle
from tests.support.builders import angles

SPEEDS = st.floats(-45.0, 45.0)
ACCELS = st.floats(-10.0, 10.0)
STEERINGS = st.floats(-math.pi / 3, math.pi / 3)


@given(angles(), SPEEDS, ACCELS, STEERINGS, st.floats(1.0, 20.0), st.floats(0.001, 0.2))
def test_bicycle_step_equals_twin(
    heading: float, speed: float, accel: float, steering: float, length: float, dt: float
) -> None:
    x, y, turned, faster, yaw_rate = kinematics.bicycle_step(
        3.0, -4.0, heading, speed, accel, steering, length, dt
    )
    twin = naive.bicycle_step(3.0, -4.0, heading, speed, accel, steering, length, dt)
    assert (x, y, faster, yaw_rate) == pytest.approx((*twin[:2], *twin[3:]), rel=1e-12, abs=1e-12)
    assert -math.pi < turned <= math.pi
    assert abs(wrap_angle(turned - twin[2])) < 1e-12


def test_a_car_with_constant_steering_returns_after_one_circle() -> None:
    # tan(slip) = tan(steering) / 2 and radius = (length / 2) / sin(slip).
    slip = math.atan(math.tan(0.3) / 2.0)
    radius = 2.5 / math.sin(slip)
    dt, speed = 0.001, 10.0
    steps = round(2.0 * math.pi * radius / speed / dt)
    x = y = heading = 0.0
    for _ in range(steps):
        x, y, heading, _, _ = kinematics.bicycle_step(x, y, heading, speed, 0.0, 0.3, 5.0, dt)
    assert math.hypot(x, y) < 0.02
    assert abs(heading) < 0.002
