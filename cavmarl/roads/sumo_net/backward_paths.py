"""Redraws paths over junctions that run backwards, so that a car can follow them.

netconvert joins the end of one lane to the start of another with a line. If roads overlap, the
start may lie behind the end, or beside it. The line then runs against the direction of both roads,
or folds back. This module shortens both lanes until a smooth curve joins them. The removed part of
a lane is added to the other paths that begin or end there, so only the repaired paths change.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import atan2_all
from cavmarl.roads.polylines import (
    SAME_POINT_M,
    Shape,
    cut_shape,
    shape_length,
    smooth_curve,
    without_repeats,
)

# A car cannot follow a path in two cases. (1) The path has a corner above KINK_RAD, and it turns
# ASTRAY_RAD more than its roads do. (2) The path has a corner above BACK_RAD, but its roads make no
# U-turn (a turn above U_TURN_RAD).
KINK_RAD = np.radians(60.0)
ASTRAY_RAD = np.radians(90.0)
BACK_RAD = np.radians(100.0)
U_TURN_RAD = np.radians(150.0)
SMOOTH_RAD = np.radians(60.0)  # accepted excess turning of a new path
WORTH_RAD = np.radians(3.0)  # a longer cut is better only if it saves this much turning
STEP_M = 0.5  # minimum cut of a lane, and step between two cuts
MOST_M = 12.0  # maximum cut of a lane
MOST_SHARE = 0.4  # maximum cut as a share of the lane, because its other end may be cut as well


class Way(NamedTuple):
    """The LANE rows of a movement over a junction."""

    before: int
    inside: tuple[int, ...]
    after: int


def mend_backward_paths(shapes: list[Shape], ways: Sequence[Way]) -> None:
    """Redraw paths that no car can follow; `shapes`: (n, 3) in m per lane, changed in place.

    An end of a lane is not cut if a movement without internal lanes begins or ends there.
    """
    fixed_ends = {way.before for way in ways if not way.inside}
    fixed_starts = {way.after for way in ways if not way.inside}
    broken = [way for way in ways if way.inside and _is_broken(shapes, way)]
    back: dict[int, float] = defaultdict(float)
    front: dict[int, float] = defaultdict(float)
    for way in broken:
        cut = _needed_cut(shapes, way, way.before in fixed_ends, way.after in fixed_starts)
        back[way.before] = max(back[way.before], cut[0])
        front[way.after] = max(front[way.after], cut[1])
    tails = {
        lane: cut_shape(shapes[lane], shape_length(shapes[lane]) - m)
        for lane, m in back.items()
        if m
    }
    for lane, (kept, _) in tails.items():
        shapes[lane] = kept
    heads = {lane: cut_shape(shapes[lane], m) for lane, m in front.items() if m}
    for lane, (_, kept) in heads.items():
        shapes[lane] = kept
    mended = set(broken)
    for way in ways:
        if not way.inside or way in mended:
            continue
        if way.before in tails:
            first = way.inside[0]
            shapes[first] = _join(tails[way.before][1], shapes[first])
        if way.after in heads:
            last = way.inside[-1]
            shapes[last] = _join(shapes[last], heads[way.after][0])
        if (way.before in tails or way.after in heads) and _is_broken(shapes, way):
            mended.add(way)  # the added part of a lane runs backwards
    for way in ways:
        if way in mended:
            redraw(shapes, way)


def _is_broken(shapes: Sequence[Shape], way: Way) -> bool:
    path = _join(*(shapes[lane] for lane in way.inside))
    corners = _corners(shapes[way.before], path, shapes[way.after])
    sharpest, astray = np.abs(corners).max(), _astray(corners)
    turns_round = np.abs(corners).sum() - astray > U_TURN_RAD
    goes_back = sharpest > BACK_RAD and not turns_round
    return bool(goes_back or (sharpest > KINK_RAD and astray > ASTRAY_RAD))


def _corners(before: Shape, path: Shape, after: Shape) -> NDArray[np.float64]:
    """Return the changes of direction in rad along a path, including both adjacent lanes."""
    steps = np.concatenate([before[-2:], path[1:], after[1:2] - after[0] + path[-1]])
    heading = atan2_all(*np.diff(steps[:, 1::-1], axis=0).T)
    corners: NDArray[np.float64] = (np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi
    return corners


def _astray(corners: NDArray[np.float64]) -> float:
    """Return how much more a path turns in total than its roads, in rad."""
    net = (corners.sum() + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.abs(corners).sum() - abs(net))


def _needed_cut(
    shapes: Sequence[Shape], way: Way, fixed_end: bool, fixed_start: bool
) -> tuple[float, float]:
    """Return the smallest cuts of both lanes in m for a smooth curve, or else the best cuts."""
    rooms = [
        0.0 if fixed else min(MOST_SHARE * shape_length(shapes[lane]), MOST_M)
        for lane, fixed in ((way.before, fixed_end), (way.after, fixed_start))
    ]
    steps = [np.append(np.arange(STEP_M, room, STEP_M), room).tolist() for room in rooms]
    best = (np.inf, 0.0, 0.0)
    for cuts in sorted(product(*steps), key=lambda pair: (sum(pair), max(pair))):
        before = cut_shape(shapes[way.before], shape_length(shapes[way.before]) - cuts[0])[0]
        after = cut_shape(shapes[way.after], cuts[1])[1]
        astray = _astray(_corners(before, smooth_curve(before, after), after))
        if astray < best[0] - WORTH_RAD:
            best = (astray, *cuts)
        if astray <= SMOOTH_RAD:
            break
    return best[1:]


def redraw(shapes: list[Shape], way: Way) -> None:
    """Replace the internal lanes of a movement by a curve, divided in proportion to the lanes."""
    curve = smooth_curve(shapes[way.before], shapes[way.after])
    lengths = [max(shape_length(shapes[lane]), SAME_POINT_M) for lane in way.inside]
    whole = shape_length(curve)
    for lane, length in zip(way.inside[:-1], lengths, strict=False):
        shapes[lane], curve = cut_shape(curve, whole * length / sum(lengths))
    shapes[way.inside[-1]] = curve


def _join(*parts: Shape) -> Shape:
    return without_repeats(np.concatenate(parts))
