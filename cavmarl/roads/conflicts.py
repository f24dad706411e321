"""Where the paths of two movements over a junction meet.

The map says *that* two links are foes (a bit of the junction's request); this module says *where*:
the stretch of each path on which a vehicle could touch one on the other path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAR_M", "LinkPath", "Overlap", "least_distance", "overlap", "sample_path"]

SAMPLE_M = 0.5
# Half a car (2 m wide) on either path and a margin that covers corners cut in a turn.
NEAR_M = 1.0 + 1.0 + 0.6
# Paths further apart than this in height are a bridge and the road below it.
CLEARANCE_M = 3.0
# The half length of the stretch where foes never come near each other in the plane.
TOUCH_M = 1.0


class LinkPath(NamedTuple):
    """The path of a link over its junction, sampled every `SAMPLE_M` or closer, with both ends."""

    s: NDArray[np.float64]  # (n,) m from the stop line
    xyz: NDArray[np.float64]  # (n, 3) m


class Overlap(NamedTuple):
    """The shared area of two paths, in metres from each stop line."""

    enter_m: float
    leave_m: float
    foe_enter_m: float
    foe_leave_m: float


def sample_path(s: NDArray[np.float64], xyz: NDArray[np.float64]) -> LinkPath:
    """Sample a polyline with arc lengths `s` (n,) and points `xyz` (n, 3), metres, evenly."""
    count = int(np.ceil(s[-1] / SAMPLE_M)) + 1
    at = np.linspace(0.0, s[-1], max(count, 2))
    return LinkPath(at, np.stack([np.interp(at, s, xyz[:, axis]) for axis in range(3)], axis=1))


def overlap(path: LinkPath, foe: LinkPath, *, merging: bool) -> Overlap | None:
    """Where two foes meet, or None if one passes over the other.

    Args:
        path: the path of one link.
        foe: the path of the other.
        merging: both lead into the same lane, so the shared area lasts to the end of both.

    Returns:
        The hull of all stretches with less than `NEAR_M` between the centre lines; `TOUCH_M` around
        the closest points where no stretch is that near.
    """
    plane = path.xyz[:, None, :2] - foe.xyz[None, :, :2]
    square = plane[..., 0] * plane[..., 0] + plane[..., 1] * plane[..., 1]
    level = np.abs(path.xyz[:, None, 2] - foe.xyz[None, :, 2]) <= CLEARANCE_M
    near = level & (square <= NEAR_M * NEAR_M)
    if near.any():
        mine, theirs = path.s[near.any(axis=1)], foe.s[near.any(axis=0)]
        half = 0.5 * SAMPLE_M
        found = Overlap(
            *_stretch(path, mine[0] - half, mine[-1] + half),
            *_stretch(foe, theirs[0] - half, theirs[-1] + half),
        )
    else:
        row, column = np.unravel_index(square.argmin(), square.shape)
        if not level[row, column]:
            return None
        mine, theirs = path.s[row], foe.s[column]
        found = Overlap(
            *_stretch(path, mine - TOUCH_M, mine + TOUCH_M),
            *_stretch(foe, theirs - TOUCH_M, theirs + TOUCH_M),
        )
    if merging:
        found = found._replace(leave_m=path.s[-1], foe_leave_m=foe.s[-1])
    return Overlap(*map(float, found))


def least_distance(path: LinkPath, foe: LinkPath) -> float:
    """The least distance in m of two paths in the plane, where they are on one level; else inf."""
    plane = path.xyz[:, None, :2] - foe.xyz[None, :, :2]
    square = plane[..., 0] * plane[..., 0] + plane[..., 1] * plane[..., 1]
    level = np.abs(path.xyz[:, None, 2] - foe.xyz[None, :, 2]) <= CLEARANCE_M
    return float(np.sqrt(square[level].min())) if level.any() else float("inf")


def _stretch(path: LinkPath, start: float, end: float) -> tuple[float, float]:
    return max(0.0, start), min(path.s[-1], end)
