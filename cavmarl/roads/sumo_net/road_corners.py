"""Rounds the corners inside a road, so that a car can follow its lane.

A road may be drawn with a corner that is tighter than a car's turning circle. A car would leave its
lane there and meet oncoming cars. This module replaces such a corner by a wider curve, which is
tangent to the segments before and after the corner, on its inner side. The curves of all lanes of
an edge have the same centre, so the distances between lanes do not decrease. Drivers slow down for
the curve as for any other bend (`driving.kernels.motion.speed_limits_ahead`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import atan2_all, hypot_all
from cavmarl.roads.polylines import Shape, shape_length, smooth_curve, without_repeats

# A corner is a turn by more than `CORNER_RAD` with a radius below `TIGHT_M`, the turning circle of
# a car of 5 m. Corners sharper than `MOST_RAD` stay, because the curve would be far from the road.
CORNER_RAD = np.radians(35.0)
TIGHT_M = 5.6
MOST_RAD = np.radians(165.0)
MOST_CORNER_POINTS = 32
CAR_M = (5.0, 2.0)  # length and width of a car that keeps within its lane in the new curve
LEAST_RADIUS_M = 8.0  # bounds of the radius of the innermost lane's new curve
MOST_RADIUS_M = 20.0
END_M = 1.0  # a lane keeps this much of its first and last segment

Vector = NDArray[np.float64]


class Corner(NamedTuple):
    """A corner of a polyline: the points from `first` to `last`, and its turn in rad."""

    first: int
    last: int
    turn: float


class _Fillet(NamedTuple):
    """A curve that touches the lines before and after a corner."""

    corner: Corner
    apex: Vector  # where the two lines meet
    before: Vector  # unit vectors of both lines
    after: Vector
    tangent: float  # distance of the curve's ends from the apex, per m of radius


def find_corners(shape: Shape) -> list[Corner]:
    """Return the corners of a polyline (n, 3) in m that are too tight for a car."""
    if len(shape) < 3:
        return []
    heading = atan2_all(*np.diff(shape[:, 1::-1], axis=0).T)
    turns = ((np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi).tolist()
    if sum(map(abs, turns)) <= CORNER_RAD:
        return []
    s = [0.0, *np.cumsum(hypot_all(*np.diff(shape[:, :2], axis=0).T)).tolist()]
    found: list[Corner] = []
    first = 1
    while first <= len(turns):
        best = Corner(first, first, 0.0)
        turn = 0.0
        for last in range(first, min(first + MOST_CORNER_POINTS, len(turns) + 1)):
            if turn * turns[last - 1] < 0.0:
                break
            turn += turns[last - 1]
            if last > first and abs(turn) > MOST_RAD:
                break
            is_tight = _curve_m(s[last] - s[first], last - first) < TIGHT_M * abs(turn)
            if is_tight and abs(turn) > max(CORNER_RAD, abs(best.turn)):
                best = Corner(first, last, turn)
        if best.turn:
            found.append(best)
        first = best.last + 1
    return found


def _curve_m(length_m: float, segments: int) -> float:
    """Return the length of a curve that the points of a polyline divide into equal parts."""
    return length_m * (segments + 1) / max(segments, 1)


def round_corners(
    shapes: list[Shape], widths_m: Sequence[float], edges: Sequence[range]
) -> list[int]:
    """Round the corners of roads; return the rows of the changed lanes.

    Args:
        shapes: one (n, 3) array per lane row, in m; changed in place.
        widths_m: the width of each lane.
        edges: the lane rows of each edge.
    """
    changed: list[int] = []
    for lanes in edges:
        corners = {lane: find_corners(shapes[lane]) for lane in lanes}
        if not any(corners.values()):
            continue
        radius = _radius(min(widths_m[lane] for lane in lanes))
        fillets = {lane: _fillets(shapes[lane], corners[lane], radius) for lane in lanes}
        drawn = [shapes[lane] for lane in lanes]
        radii = _radii([fillets[lane] for lane in lanes], drawn, radius)
        for lane, wanted in zip(lanes, radii, strict=True):
            if _round(shapes, lane, fillets[lane], wanted):
                changed.append(lane)
    return changed


def _radius(width_m: float) -> float:
    """Return the smallest radius in m of a curve in which a car keeps within a lane.

    The rear axle follows a smaller circle than the front corner on the outer side.
    """
    length, width = CAR_M
    room = max(width_m - width, 0.5 * length**2 / MOST_RADIUS_M)
    return max(0.5 * length**2 / room, LEAST_RADIUS_M)


def _fillets(shape: Shape, corners: Sequence[Corner], radius: float) -> list[_Fillet]:
    """Return the curves for corners; each curve also replaces the gentle bends in its range."""
    found: list[_Fillet] = []
    for number, corner in enumerate(corners):
        low = corners[number - 1].last if number else 0
        high = corners[number + 1].first if number + 1 < len(corners) else len(shape) - 1
        fillet = _fillet(shape, corner)
        while fillet is not None:
            need = radius * fillet.tangent
            first, last = fillet.corner.first, fillet.corner.last
            if first - 1 > low and _apart(fillet.apex, shape[first - 1]) < need:
                first -= 1
            elif last + 1 < high and _apart(fillet.apex, shape[last + 1]) < need:
                last += 1
            else:
                break
            wider = _fillet(shape, Corner(first, last, corner.turn))
            if wider is None:
                break
            fillet = wider
        if fillet is not None:
            found.append(fillet)
    return found


def _fillet(shape: Shape, corner: Corner) -> _Fillet | None:
    """Return the curve for a corner, or None if the lines around it do not meet ahead."""
    start, end = shape[corner.first - 1 : corner.first + 1, :2]
    begin, stop = shape[corner.last : corner.last + 2, :2]
    before = (end - start) / hypot_all(*(end - start))
    after = (stop - begin) / hypot_all(*(stop - begin))
    sine = float(before[0] * after[1] - before[1] * after[0])
    cosine = _dot(before, after)
    turn = float(atan2_all(np.float64(sine), np.float64(cosine)))
    if abs(turn) > MOST_RAD or turn * corner.turn <= 0.0 or abs(turn) < 0.5 * CORNER_RAD:
        return None
    across = begin - end
    along = float(across[0] * after[1] - across[1] * after[0]) / sine
    apex = end + along * before
    if _dot(apex - start, before) <= 0.0 or _dot(stop - apex, after) <= 0.0:
        return None
    return _Fillet(corner, apex, before, after, (1.0 - cosine) / abs(sine))


def _dot(one: Vector, other: Vector) -> float:
    return float(one[0] * other[0] + one[1] * other[1])


def _apart(one: Vector, other: Vector) -> float:
    return float(hypot_all(*(other[:2] - one[:2])))


def _radii(
    lanes: Sequence[Sequence[_Fillet]], shapes: Sequence[Shape], innermost: float
) -> list[list[float]]:
    """Return the radii in m of the curves of an edge's lanes."""
    fits = [
        _fitting(shape, fillets, [innermost] * len(fillets))
        for fillets, shape in zip(lanes, shapes, strict=True)
    ]
    if len({tuple(fillet.corner.turn > 0.0 for fillet in fillets) for fillets in lanes}) > 1:
        return fits  # the lanes have different corners
    wanted = [list(radii) for radii in fits]
    for number, fillet in enumerate(lanes[0]):
        inwards = (fillet.after - fillet.before) / hypot_all(*(fillet.after - fillet.before))
        places = [_dot(fillets[number].apex, inwards) for fillets in lanes]
        # The cosine of half of the turn, from its tangent.
        share = 1.0 / np.sqrt(1.0 + fillet.tangent**2)
        for radii, place in zip(wanted, places, strict=True):
            radii[number] = innermost + (max(places) - place) * share
    fits = [
        _fitting(shape, fillets, radii)
        for fillets, shape, radii in zip(lanes, shapes, wanted, strict=True)
    ]
    for number in range(len(lanes[0])):
        scale = min(fit[number] / radii[number] for fit, radii in zip(fits, wanted, strict=True))
        for radii in wanted:
            radii[number] *= scale
    return wanted


def _fitting(shape: Shape, fillets: Sequence[_Fillet], radii: Sequence[float]) -> list[float]:
    """Reduce the radii until the curves neither overlap nor reach the lane's ends."""
    needs = [fillet.tangent * radius for fillet, radius in zip(fillets, radii, strict=True)]
    rooms = list(needs)
    for number, fillet in enumerate(fillets):
        first, last = fillet.corner.first, fillet.corner.last
        into = _apart(fillet.apex, shape[first - 1]) - (END_M if first == 1 else 0.0)
        out = _apart(fillet.apex, shape[last + 1]) - (END_M if last + 2 == len(shape) else 0.0)
        rooms[number] = min(rooms[number], max(into, 0.0), max(out, 0.0))
    for number in range(1, len(fillets)):
        if fillets[number].corner.first - 1 <= fillets[number - 1].corner.last:
            between = _apart(fillets[number].apex, fillets[number - 1].apex)
            both = needs[number - 1] + needs[number]
            for one in (number - 1, number):
                rooms[one] = min(rooms[one], between * needs[one] / both)
    return [room / fillet.tangent for room, fillet in zip(rooms, fillets, strict=True)]


def _round(
    shapes: list[Shape], lane: int, fillets: Sequence[_Fillet], radii: Sequence[float]
) -> bool:
    """Replace the corners of a lane by curves; return whether the lane has changed."""
    whole = shapes[lane]
    for fillet, radius in zip(reversed(fillets), reversed(radii), strict=True):
        first, last = fillet.corner.first, fillet.corner.last
        drawn_m = _curve_m(shape_length(whole[first : last + 1]), last - first)
        if radius <= drawn_m / abs(fillet.corner.turn):
            continue  # there is no room for a wider curve than the map's
        length = radius * fillet.tangent
        start = _point(fillet.apex - length * fillet.before, whole[first - 1], whole[first])
        end = _point(fillet.apex + length * fillet.after, whole[last + 1], whole[last])
        curve = smooth_curve(
            np.stack([start - np.append(fillet.before, 0.0), start]),
            np.stack([end, end + np.append(fillet.after, 0.0)]),
        )
        whole = without_repeats(np.concatenate([whole[:first], curve, whole[last + 1 :]]))
    changed = whole is not shapes[lane]
    shapes[lane] = whole
    return changed


def _point(place: Vector, outer: Vector, inner: Vector) -> Vector:
    """Return (3,) the position of a place in the plane, with the segment's height there."""
    share = min(_apart(place, outer) / _apart(inner, outer), 1.0)
    return np.append(place, outer[2] + share * (inner[2] - outer[2]))
