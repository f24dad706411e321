"""Moves the two directions of a street apart if their lanes are drawn on the same strip.

Vehicles of opposite directions have no right of way over each other, so they would collide on such
lanes. Examples are tram tracks that are open to cars, and streets that are drawn around their
centre line. This module moves all lanes of both edges by the same distance to the side of traffic,
until the lanes of both directions are side by side. Lanes, connections and permissions stay, so
each route remains possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.roads.polylines import Shape, without_repeats
from cavmarl.roads.sumo_net.backward_paths import Way, redraw

NEAR_M = 2.0  # the width of a car; vehicles on lanes with closer centre lines would collide
STEP_M = 5.0  # distance between the compared places of a lane
LEAST_PLACES = 3  # smallest number of compared places in a strip
OPPOSITE = -0.9  # largest cosine between opposite directions
LEVEL_M = 3.0  # lanes with a larger difference in height do not meet
SHORT_M = 3.0  # a shorter path over a junction has no room for a curve
MOST_MITER = 3.0  # in a corner, a point moves at most this many times as far as the lane

Vector = NDArray[np.float64]


class Road(NamedTuple):
    """An edge: its lane rows and the identities of its junctions."""

    lanes: range
    begin: int
    end: int


class Strip(NamedTuple):
    """Two opposite edges with lanes on the same strip."""

    one: Road
    other: Road
    lanes: tuple[tuple[int, int], ...]  # pairs of rows of these lanes
    apart_m: float  # distance by which the lanes of each edge have to move


def find_strips(
    shapes: Sequence[Shape], widths_m: Sequence[float], roads: Sequence[Road], left_hand: bool
) -> list[Strip]:
    """Return the pairs of opposite edges with lanes on the same strip.

    Args:
        shapes: one (n, 3) array per lane row, in m.
        widths_m: the width of each lane.
        roads: all edges outside of junctions.
        left_hand: whether the map has left-hand traffic.
    """
    by_ends: dict[tuple[int, int], list[Road]] = {}
    found: list[Strip] = []
    for road in roads:
        for other in by_ends.get((road.end, road.begin), ()):
            strip = _strip(shapes, widths_m, other, road, left_hand)
            if strip is not None:
                found.append(strip)
        by_ends.setdefault((road.begin, road.end), []).append(road)
    return found


def move_apart(
    shapes: list[Shape], strips: Sequence[Strip], ways: Sequence[Way], left_hand: bool
) -> None:
    """Move the edges of strips apart, and redraw the paths over junctions at their ends.

    `shapes` (n, 3) of all lanes in m are changed in place.
    """
    moves: dict[int, float] = {}
    for strip in strips:
        for lane in (*strip.one.lanes, *strip.other.lanes):
            moves[lane] = max(moves.get(lane, 0.0), strip.apart_m)
    for lane, apart_m in moves.items():
        shapes[lane] = _beside(shapes[lane], apart_m if left_hand else -apart_m)
    for way in ways:
        if not way.inside or not (way.before in moves or way.after in moves):
            continue
        start, end = shapes[way.before][-1], shapes[way.after][0]
        if len(way.inside) == 1 and hypot_all(*(end - start)[:2]) < SHORT_M:
            # The new path is a straight line. If it has sharp corners with the lanes,
            # `mend_backward_paths` makes room for a curve.
            shapes[way.inside[0]] = without_repeats(np.stack([start, end]))
        else:
            redraw(shapes, way)


def _strip(
    shapes: Sequence[Shape], widths_m: Sequence[float], one: Road, other: Road, left_hand: bool
) -> Strip | None:
    side = -1.0 if left_hand else 1.0
    middle = side * _left_of(shapes[one.lanes[-1]], shapes[other.lanes[-1]])
    if middle.min(initial=np.inf) >= NEAR_M:
        return None  # the innermost lanes do not overlap, and all others are farther apart
    lanes: list[tuple[int, int]] = []
    missing_m = 0.0
    for own, far in product(one.lanes, other.lanes):
        aside = side * _left_of(shapes[own], shapes[far])
        if not len(aside):
            continue
        if (np.abs(aside) < NEAR_M).sum() >= min(LEAST_PLACES, len(aside)):
            lanes.append((own, far))
        missing_m = max(missing_m, 0.5 * (widths_m[own] + widths_m[far]) - float(aside.min()))
    return Strip(one, other, tuple(lanes), 0.5 * missing_m) if lanes else None


def _left_of(shape: Shape, other: Shape) -> Vector:
    """Return how far to the left another lane is, in m, where its direction is opposite."""
    steps = np.diff(shape, axis=0)
    sizes = hypot_all(steps[:, 0], steps[:, 1])
    s = np.concatenate([[0.0], np.cumsum(sizes)])
    number = max(round(s[-1] / STEP_M), 1)
    at = np.concatenate([(np.arange(number) + 0.5) * s[-1] / number, s[1:-1]])
    segment = np.searchsorted(s, at, side="right") - 1
    ahead = steps[segment] / sizes[segment, None]
    places = shape[segment] + ahead * (at - s[segment])[:, None]

    far = np.diff(other, axis=0)
    lengths = hypot_all(far[:, 0], far[:, 1])
    along = far / lengths[:, None]
    apart = places[:, None] - other[None, :-1]
    share = (apart[..., :2] * along[None, :, :2]).sum(axis=2)
    inside = (share >= 0.0) & (share <= lengths)
    offset = np.clip(share, 0.0, lengths)[..., None] * along - apart
    distance = hypot_all(offset[..., 0], offset[..., 1])
    nearest = np.where(inside, distance, np.inf).argmin(axis=1)
    rows = np.arange(len(places))
    offset, along = offset[rows, nearest], along[nearest]
    cosine = ahead[:, 0] * along[:, 0] + ahead[:, 1] * along[:, 1]
    meets = inside[rows, nearest] & (cosine < OPPOSITE) & (np.abs(offset[:, 2]) < LEVEL_M)
    left: Vector = (ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0])[meets]
    return left


def _beside(shape: Shape, left_m: float) -> Shape:
    """Return a polyline parallel to another one, `left_m` to its left."""
    steps = np.diff(shape[:, :2], axis=0)
    steps /= hypot_all(steps[:, 0], steps[:, 1])[:, None]
    normals = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
    before, after = normals[[0, *range(len(normals))]], normals[[*range(len(normals)), -1]]
    middle = before + after
    # `square` is twice the squared cosine of half the turn: the parallels of both segments meet at
    # the offset `left_m * middle / square` from the corner.
    square = np.maximum((middle * before).sum(axis=1), 2.0 / MOST_MITER**2)
    moved = shape.copy()
    moved[:, :2] += left_m * middle / square[:, None]
    return moved
