"""The Intelligent Driver Model: how hard a car accelerates or brakes behind another.

Treiber, Hennecke, Helbing: "Congested traffic states in empirical observations and microscopic
simulations", Phys. Rev. E 62, 2000, with highway-env's defaults (`IDMVehicle`). As there, the
desired gap is not cut at zero: a car also holds back a little behind one that speeds away fast.

A driver with several leaders takes the free term once and the largest interaction:
`idm_free(…) - max(idm_interaction(…), …)`. The exponents 4 and 2 are multiplied out: `pow` does not
give the same bits on every processor.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.scalars import not_zero

ACCEL_MAX = 3.0  # m/s², desired acceleration from rest on a free road
DECEL_COMFORT = 5.0  # m/s², braking that feels comfortable, a positive number
JAM_DISTANCE_M = 10.0  # m between the centres of two standing cars of 5 m: bumpers 5 m apart
TIME_HEADWAY_S = 1.5  # s, time gap that a driver keeps
ACCEL_LIMIT = 6.0  # m/s², what the car can do at most, speeding up and braking


@kernel
def idm_free(
    speed: float,  # m/s; driving backwards counts as standing
    target_speed: float,  # m/s, already cut to the speed limit
    accel_max: float,  # m/s², see `ACCEL_MAX`
) -> float:
    """Acceleration on a free road in m/s²: accel_max · (1 - (speed / target_speed)⁴)."""
    ratio = max(speed, 0.0) / abs(not_zero(target_speed))
    squared = ratio * ratio
    return accel_max * (1.0 - squared * squared)


@kernel
def idm_interaction(
    speed: float,  # m/s
    distance: float,  # to the leader in m, measured as `jam_distance` is; kept 1 cm away from zero
    front_speed: float,  # of the leader along the follower's heading, m/s
    accel_max: float,  # m/s², see `ACCEL_MAX`
    decel_comfort: float,  # m/s², positive, see `DECEL_COMFORT`
    jam_distance: float,  # m, see `JAM_DISTANCE_M`
    time_headway: float,  # s, see `TIME_HEADWAY_S`
) -> float:
    """How much a leader takes off the free acceleration, in m/s², at least zero.

    gap         = jam_distance + speed · time_headway
                  + speed · (speed - front_speed) / (2 · sqrt(accel_max · decel_comfort))
    interaction = accel_max · (gap / distance)²
    """
    gap = (
        jam_distance
        + speed * time_headway
        + speed * (speed - front_speed) / (2.0 * math.sqrt(accel_max * decel_comfort))
    )
    ratio = gap / not_zero(distance)
    return accel_max * (ratio * ratio)
