"""MOBIL: whether a lane change is worthwhile and imposes no hard braking.

Kesting, Treiber, Helbing: "General lane-changing model MOBIL for car-following models",
Transportation Research Record 1999, 2007, with highway-env's defaults (`IDMVehicle.mobil`).
"""

from __future__ import annotations

from cavmarl.core.compiled import kernel

POLITENESS = 0.0  # weight of the followers' gains, from 0 (selfish) to 1
MIN_ACCEL_GAIN = 0.2  # m/s², smallest gain of acceleration for which a driver changes lanes
MAX_BRAKING_IMPOSED = 2.0  # m/s², a change that imposes harder braking is unsafe
LANE_CHANGE_DELAY_S = 1.0  # time between two decisions of a driver


@kernel
def mobil_accepts(
    own_accel: float,  # present acceleration of the car that considers the change
    own_accel_after: float,  # its acceleration after the change
    new_follower_accel: float,  # present acceleration of the follower on the new lane; 0: none
    new_follower_accel_after: float,  # its acceleration after the change; 0: no such car
    old_follower_accel: float,  # present acceleration of the follower on the old lane; 0: none
    old_follower_accel_after: float,  # its acceleration after the change; 0: no such car
    # the route needs a change to this side, so safety alone decides; the caller checks the side
    mandatory: bool,
    max_braking: float = MAX_BRAKING_IMPOSED,  # m/s², harder braking makes the change unsafe
) -> bool:
    """Return whether to change to a lane; accelerations in m/s², from the car-following model."""
    if new_follower_accel_after < -max_braking:
        return False
    if mandatory:
        return own_accel_after >= -max_braking
    gain = (
        own_accel_after
        - own_accel
        + POLITENESS
        * (
            new_follower_accel_after
            - new_follower_accel
            + old_follower_accel_after
            - old_follower_accel
        )
    )
    return gain >= MIN_ACCEL_GAIN
