"""The Intelligent Driver Model in one expression, with powers."""

from __future__ import annotations

import math


def not_zero(value: float) -> float:
    """Return the number, with its magnitude raised to at least 0.01 m or m/s."""
    return math.copysign(max(abs(value), 0.01), value if value != 0.0 else 1.0)


def idm_acceleration(
    speed: float,
    target_speed: float,
    distance: float | None,
    front_speed: float,
    accel_max: float,
    decel_comfort: float,
    jam_distance: float,
    time_headway: float,
) -> float:
    """Evaluate equation 5 of Treiber, Hennecke, Helbing 2000; no leader if `distance` is None."""
    free = 1.0 - (max(speed, 0.0) / abs(not_zero(target_speed))) ** 4
    if distance is None:
        return accel_max * free
    closing = speed - front_speed
    gap = (
        jam_distance
        + speed * time_headway
        + speed * closing / (2.0 * math.sqrt(accel_max * decel_comfort))
    )
    return accel_max * (free - (gap / not_zero(distance)) ** 2)
