"""Where the paths of two movements over a junction meet.

The map says *that* two links are foes (a bit of the junction's request); this module says *where*:
the stretch of each path on which a vehicle could touch one on the other path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAMPLE_M = 0.5
# Half a car (2 m wide) on either path and a margin that covers corners cut in a turn.
NEAR_M = 1.0 + 1.0 + 0.6
# Half a car with a margin.
HALF_LENGTH_M = 2.6
HALF_WIDTH_M = 1.1
# Paths further apart than this in height are a bridge and the road below it.
CLEARANCE_M = 3.0
# The half length of the stretch where foes never come near each other in the plane.
TOUCH_M = 1.0


class LinkPath(NamedTuple):
    """The path of a link over its junction, sampled every `SAMPLE_M` or closer, with both ends."""

    s: NDArray[np.float64]  # (n,) m from the stop line
    xyz: NDArray[np.float64]  # (n, 3) m


class Poses(NamedTuple):
    """Car boxes along a path."""

    xyz: NDArray[np.float64]  # (n, 3) centres, m
    heading: NDArray[np.float64]  # (n,) rad


class Overlap(NamedTuple):
    """The shared area of two paths, in metres from each stop line."""

    enter_m: float
    leave_m: float
    foe_enter_m: float
    foe_leave_m: float


def sample_path(s: NDArray[np.float64], xyz: NDArray[np.float64]) -> LinkPath:
    """Sample a polyline with arc lengths `s` (n,) and points `xyz` (n, 3), metres, evenly."""
    count = int(np.ceil((s[-1] - s[0]) / SAMPLE_M)) + 1
    at = np.linspace(s[0], s[-1], max(count, 2))
    return LinkPath(at, np.stack([np.interp(at, s, xyz[:, axis]) for axis in range(3)], axis=1))


def overlap(path: LinkPath, foe: LinkPath, *, merging: bool) -> Overlap | None:
    """Where two foes meet, or None if one passes over the other.

    `path`: the path of one link. `foe`: the path of the other. `merging`: both lead into the same
    lane, so the shared area lasts to the end of both.

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


def grazing(path: LinkPath, foe: LinkPath) -> Overlap | None:
    """Where cars on two paths would touch as they stand askew in their bends, or None.

    The answer is in places of a front bumper that comes and a rear bumper that leaves, as in
    `overlap`.
    """
    mine, theirs = poses(path), poses(foe)
    apart = mine.xyz[:, None, :] - theirs.xyz[None, :, :]
    square = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]
    level = np.abs(apart[..., 2]) <= CLEARANCE_M
    reach = 2.0 * np.hypot(HALF_LENGTH_M, HALF_WIDTH_M)
    rows, columns = np.nonzero(level & (square < reach * reach))
    if not rows.size:
        return None
    meet = touching(apart[rows, columns, :2], mine.heading[rows], theirs.heading[columns])
    if not meet.any():
        return None
    here, there = path.s[rows[meet]], foe.s[columns[meet]]
    return Overlap(*map(float, (*_from_centres(path, here), *_from_centres(foe, there))))


def poses(path: LinkPath) -> Poses:
    """How a car stands along a path: as a chord of it, both bumpers on the path.

    Before and behind its ends the path goes on straight.
    """
    ends = [path.s[0] - 2.0 * HALF_LENGTH_M, *path.s, path.s[-1] + 2.0 * HALF_LENGTH_M]
    first, last = path.xyz[1] - path.xyz[0], path.xyz[-1] - path.xyz[-2]
    reach = 2.0 * HALF_LENGTH_M
    xyz = np.concatenate(
        [
            [path.xyz[0] - first * reach / max(float(np.hypot(*first[:2])), 1e-6)],
            path.xyz,
            [path.xyz[-1] + last * reach / max(float(np.hypot(*last[:2])), 1e-6)],
        ]
    )

    def at(s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.interp(s, ends, xyz[:, axis]) for axis in range(3)], axis=1)

    front, rear = at(path.s + HALF_LENGTH_M), at(path.s - HALF_LENGTH_M)
    chord = front - rear
    return Poses(0.5 * (front + rear), np.arctan2(chord[:, 1], chord[:, 0]))


def touching(
    apart: NDArray[np.float64], mine: NDArray[np.float64], theirs: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether pairs of car boxes have no separating axis.

    `apart`: (n, 2) between the centres, m. `mine`: (n,) headings, rad. `theirs`: (n,) headings,
    rad.
    """
    across = np.abs(np.sin(mine - theirs))
    along = np.abs(np.cos(mine - theirs))
    separated = np.zeros(len(apart), dtype=np.bool_)
    for heading in (mine, theirs):
        forward = np.abs(apart[:, 0] * np.cos(heading) + apart[:, 1] * np.sin(heading))
        sideways = np.abs(apart[:, 1] * np.cos(heading) - apart[:, 0] * np.sin(heading))
        separated |= forward > HALF_LENGTH_M * (1.0 + along) + HALF_WIDTH_M * across
        separated |= sideways > HALF_WIDTH_M * (1.0 + along) + HALF_LENGTH_M * across
    return ~separated


def _from_centres(path: LinkPath, centres: NDArray[np.float64]) -> tuple[float, float]:
    """The stretch that a car covers of the shared area, from the places of its centre there."""
    enter, leave = centres.min() + HALF_LENGTH_M, centres.max() - HALF_LENGTH_M
    middle = 0.5 * (enter + leave)
    return _stretch(path, min(enter, middle), max(leave, middle))


def _stretch(path: LinkPath, start: float, end: float) -> tuple[float, float]:
    return max(0.0, start), min(path.s[-1], end)
