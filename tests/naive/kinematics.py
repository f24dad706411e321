"""The kinematic bicycle with the slip angle written out."""

from __future__ import annotations

import math


def bicycle_step(
    x: float,
    y: float,
    heading: float,
    speed: float,
    accel: float,
    steering: float,
    length: float,
    dt: float,
) -> tuple[float, float, float, float, float]:
    """Evaluate the equations of the kernel one by one, without wrapping the heading."""
    slip = math.atan(math.tan(steering) / 2.0)
    yaw_rate = speed * math.sin(slip) / (length / 2.0)
    return (
        x + speed * math.cos(heading + slip) * dt,
        y + speed * math.sin(heading + slip) * dt,
        heading + yaw_rate * dt,
        speed + accel * dt,
        yaw_rate,
    )


def clip_control(
    speed: float, accel: float, steering: float, crashed: bool, min_speed: float, max_speed: float
) -> tuple[float, float]:
    """Clip acceleration and steering; outside of the speed range, only allow a return to it."""
    wanted = -speed if crashed else accel
    if speed > max_speed:
        wanted = min(wanted, max_speed - speed)
    if speed < min_speed:
        wanted = max(wanted, min_speed - speed)
    return wanted, 0.0 if crashed else steering
