"""The kinematic bicycle: how a car moves under acceleration and steering.

Polack, Altché, d'Andréa-Novel, de La Fortelle: "The kinematic bicycle model: a consistent model for
planning feasible trajectories for autonomous vehicles?", IV 2017; integrated as highway-env's
`Vehicle.step`, with the same limits.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin, tangent
from cavmarl.core.math.geometry import wrap_angle

MAX_SPEED_MPS = 40.0  # beyond it the engine gives way
MIN_SPEED_MPS = -40.0


@kernel
def bicycle_step(
    x: float,  # m, of the centre
    y: float,  # m, of the centre
    heading: float,  # rad
    speed: float,  # m/s along the heading, negative backwards
    accel: float,  # m/s²
    steering: float,  # angle of the front wheels in rad, within (-pi/2, pi/2), positive to the left
    length: float,  # of the car, m; its half is the distance from the centre to each axle
    dt: float,  # s
) -> tuple[float, float, float, float, float]:
    """Move a car for one tick; place and heading with the speed before it, explicit Euler.

        slip    = atan(tan(steering) / 2)
        x      += speed · cos(heading + slip) · dt
        y      += speed · sin(heading + slip) · dt
        heading += speed · sin(slip) / (length / 2) · dt
        speed  += accel · dt

    Returns:
        x, y, heading, speed after the tick, and the yaw rate during it in rad/s. The heading
        is kept in (-pi, pi]; highway-env lets it grow.
    """
    # Sine and cosine of the slip angle without inverse functions: tan(slip) is known.
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
