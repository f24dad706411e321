"""The stretch of a lane that the body of a scripted actor covers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.geometry import project


@kernel
def covered_stretch(
    points: NDArray[np.void],  # POINT
    lane: np.void,  # LANE
    body: NDArray[np.float64],  # (n, 2) sample points of the body, m
) -> tuple[float, float]:
    """Return the first and last position on the lane that the body covers, in m.

    If it covers none, return (inf, -inf).
    """
    reach = 0.5 * lane["width_m"]
    first, last = math.inf, -math.inf
    for k in range(len(body)):
        s, d, _, _ = project(
            points, lane["first_point"], lane["num_points"], body[k, 0], body[k, 1]
        )
        if abs(d) < reach and 0.0 <= s <= lane["length_m"]:
            first, last = min(first, s), max(last, s)
    return first, last
