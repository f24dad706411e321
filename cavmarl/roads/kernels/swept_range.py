"""The contact range of bodies on two paths: the hull of all pairs of positions that overlap."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import hypot
from cavmarl.core.math.geometry import boxes_overlap


@kernel
def swept_range(
    mine: NDArray[np.float64],
    theirs: NDArray[np.float64],
    own: tuple[float, float, float, float, float],
    other: tuple[float, float, float, float, float],
    level_m: float,
    foes: bool,
) -> tuple[float, float, float, float]:
    """Return each centre's first and last position with contact; without contact, first is inf.

    Args:
        mine: (n, 6) positions on a path: distance of the centre from the stop line, x, y, z, and
            cosine and sine of the body's heading.
        theirs: (m, 6) positions on the other path.
        own: half length and half width of the body, length of its path, and start and end of the
            conflict's area on that path, all in m; the area is used only if `foes`.
        other: the same for the other body.
        level_m: bodies with a larger difference in height do not touch.
        foes: whether a conflict keeps the bodies apart in its area. Then a pair of positions counts
            only if one body has not reached the area (for example, waits) or has left it.
    """
    first, last = math.inf, -math.inf
    foe_first, foe_last = math.inf, -math.inf
    reach = hypot(own[0], own[1]) + hypot(other[0], other[1])
    for i in range(mine.shape[0]):
        s = mine[i, 0]
        for j in range(theirs.shape[0]):
            dx = mine[i, 1] - theirs[j, 1]
            dy = mine[i, 2] - theirs[j, 2]
            if dx * dx + dy * dy > reach * reach or abs(mine[i, 3] - theirs[j, 3]) > level_m:
                continue
            foe_s = theirs[j, 0]
            on, foe_on = _is_on(s, own), _is_on(foe_s, other)
            if not (on or foe_on):
                continue
            if foes and _is_in_area(s, own) and _is_in_area(foe_s, other):
                continue
            if boxes_overlap(
                mine[i, 1],
                mine[i, 2],
                mine[i, 4],
                mine[i, 5],
                own[0],
                own[1],
                theirs[j, 1],
                theirs[j, 2],
                theirs[j, 4],
                theirs[j, 5],
                other[0],
                other[1],
            ):
                first, last = min(first, s), max(last, s)
                foe_first, foe_last = min(foe_first, foe_s), max(foe_last, foe_s)
    return first, last, foe_first, foe_last


@inlined_kernel
def _is_on(s: float, body: tuple[float, float, float, float, float]) -> bool:
    """Return whether a body at position `s` extends over its junction."""
    on: bool = s + body[0] > 0.0 and s - body[0] < body[2]
    return on


@inlined_kernel
def _is_in_area(s: float, body: tuple[float, float, float, float, float]) -> bool:
    """Return whether a body at position `s` extends over the area of the conflict."""
    inside: bool = s + body[0] > body[3] and s - body[0] < body[4]
    return inside
