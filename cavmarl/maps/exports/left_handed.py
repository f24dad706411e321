"""The frame of CARLA and Unreal: x east, y south, z up, angles clockwise; and back.

Swapping the sign of y makes one of the other; so does doing it again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


def swap_positions(positions_m: Values) -> Values:
    """Positions, velocities or accelerations (n, 2) or (n, 3) in the other frame."""
    swapped = np.array(positions_m, dtype=np.float64)
    swapped[..., 1] = -swapped[..., 1]
    return swapped


def swap_turns(angles: Values) -> Values:
    """Headings in rad or degrees, or yaw rates, in the other frame; headings stay in one turn."""
    return -np.asarray(angles, dtype=np.float64)
