"""Approximate angles with a known maximum error, for bounds that are widened by this error."""

from __future__ import annotations

from cavmarl.core.compiled import kernel
from cavmarl.core.math.geometry import PI

# Maximum error of `rough_atan2`.
ANGLE_ERROR_RAD = 0.005


@kernel
def rough_atan2(y: float, x: float) -> float:
    """Return the angle of a point other than (0, 0), with an error below `ANGLE_ERROR_RAD`.

    Rajan, Wang, Inkol, Joyal: "Efficient approximations for the arctangent function", IEEE Signal
    Processing Magazine 23(3), 2006, the equation with an error of at most 0.0038 rad.
    """
    across = abs(y)
    along = abs(x)
    small = min(across, along)
    large = max(across, along)
    ratio = small / large
    angle = ratio * (0.25 * PI + 0.273 * (1.0 - ratio))
    if across > along:
        angle = 0.5 * PI - angle
    if x < 0.0:
        angle = PI - angle
    return -angle if y < 0.0 else angle
