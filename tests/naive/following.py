"""The acceleration that a driver applies with IDM and with the model of Krauss."""

from __future__ import annotations

import numpy as np

from tests.naive import idm, krauss

CAR_M = 5.0  # IDM measures distances between the centres of cars of this length


def idm_response(
    kind: np.void, speed: float, allowed: float, leaders: list[tuple[float, float]]
) -> float:
    """Return the acceleration by IDM behind several leaders (bumper gap, speed)."""
    jam = float(kind["min_gap"]) + CAR_M
    own = (float(kind["accel"]), float(kind["decel"]), jam, float(kind["tau"]))
    wanted = [idm.idm_acceleration(speed, allowed, None, 0.0, *own)]
    for gap, front_speed in leaders:
        distance = max(gap, 0.1) + CAR_M
        wanted.append(idm.idm_acceleration(speed, allowed, distance, front_speed, *own))
    return min(max(min(wanted), -6.0), 6.0)


def krauss_response(
    kind: np.void,
    speed: float,
    allowed: float,
    leaders: list[tuple[float, float, float]],
    share: float,
    dt: float,
) -> float:
    """Return the acceleration by Krauss behind leaders (bumper gap, speed, deceleration)."""
    accel, decel = float(kind["accel"]), float(kind["decel"])
    wanted = min(allowed, speed + accel * dt)
    for gap, front_speed, front_decel in leaders:
        room = gap - float(kind["min_gap"])
        wanted = min(
            wanted, krauss.safe_speed(room, front_speed, decel, front_decel, float(kind["tau"]))
        )
    driven = krauss.dawdle(max(wanted, 0.0), accel, float(kind["sigma"]), share, dt)
    return max((driven - speed) / dt, -float(kind["emergency_decel"]))
