"""The kinematic bicycle model: the motion of a car for an acceleration and a steering angle.

Polack, Altché, d'Andréa-Novel, de La Fortelle: "The kinematic bicycle model: a consistent model for
planning feasible trajectories for autonomous vehicles?", IV 2017. The integration and the limits
are those of highway-env's `Vehicle.step`.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin, tangent
from cavmarl.core.math.geometry import wrap_angle

MAX_SPEED_MPS = 40.0  # limit of the motor
MIN_SPEED_MPS = -40.0


@kernel
def bicycle_step(
    x: float,  # m, position of the centre
    y: float,  # m, position of the centre
    heading: float,  # rad
    speed: float,  # m/s along the heading, negative backwards
    accel: float,  # m/s²
    steering: float,  # angle of the front wheels in rad, within (-pi/2, pi/2), positive to the left
    length: float,  # m; each axle is half the car's length from the centre
    dt: float,  # s
) -> tuple[float, float, float, float, float]:
    """Move a car by one tick with explicit Euler, using the speed before the tick.

        slip    = atan(tan(steering) / 2)
        x      += speed · cos(heading + slip) · dt
        y      += speed · sin(heading + slip) · dt
        heading += speed · sin(slip) / (length / 2) · dt
        speed  += accel · dt

    Returns:
        x, y, heading and speed after the tick, and the yaw rate during the tick in rad/s. The
        heading is normalized to (-pi, pi]; in highway-env it is not.
    """
    # tan(slip) is known, so sine and cosine of the slip angle need no inverse functions.
    tan_slip = 0.5 * tangent(steering)
    cos_slip = 1.0 / math.sqrt(1.0 + tan_slip * tan_slip)
    sin_slip = tan_slip * cos_slip
    cos_heading, sin_heading = cos_sin(heading)
    step_m = speed * dt
    yaw_rate = speed * sin_slip / (0.5 * length)
    return (
        x + step_m * (cos_heading * cos_slip - sin_heading * sin_slip),
        y + step_m * (sin_heading * cos_slip + cos_heading * sin_slip),
        wrap_angle(heading + yaw_rate * dt),
        speed + accel * dt,
        yaw_rate,
    )
