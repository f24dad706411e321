"""Krauss's model: the speed from which a driver can still stop behind its leader.

Krauss: "Microscopic modeling of traffic flow: investigation of collision free vehicle dynamics",
DLR-Forschungsbericht 98-08, 1998, eq. 2.13, in the form that SUMO drives by default: the leader's
braking distance is taken with the harder of both decelerations.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel


@kernel
def safe_speed(
    gap: float,  # m that may be used up; a negative one answers 0 m/s
    front_speed: float,  # of the leader, m/s; 0 for a line
    decel: float,  # with which the driver brakes, m/s², positive
    front_decel: float,  # with which the leader brakes, m/s², positive
    reaction_s: float,  # before the driver brakes, s
) -> float:
    """The largest speed in m/s at which braking after `reaction_s` does not use up the gap.

    Solves v · reaction_s + v² / (2 · decel) = gap + front_speed² / (2 · max(decel, front_decel)).
    """
    room = gap + 0.5 * front_speed * front_speed / max(decel, front_decel)
    if room <= 0.0:
        return 0.0
    lag = decel * reaction_s
    return math.sqrt(lag * lag + 2.0 * decel * room) - lag


@kernel
def dawdle(
    speed: float,  # wanted, m/s
    accel: float,  # the largest acceleration, m/s²
    sigma: float,  # imperfection in [0, 1]
    share: float,  # a random number in [0, 1)
    dt: float,  # seconds of the tick
) -> float:
    """The speed that is left of a wanted one by imperfect driving, in m/s."""
    # A vehicle that starts from a stand is slowed in proportion, so that it does start.
    return max(speed - dt * sigma * min(accel, speed) * share, 0.0)
