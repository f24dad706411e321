"""Features of trajectories that the realism meta-metric compares.

The definitions are those of the Waymo Open Sim Agents Challenge (Montali et al. 2023,
arXiv:2305.12032, appendix, and the evaluation code of 2024), in the plane: heights are not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ScenarioError
from cavmarl.core.math.elementary_arrays import cos_all, hypot_all, sin_all
from cavmarl.maps.scenes.logged_scene import wrapped

Numbers = NDArray[np.float64]

NEVER_M = 1e10  # distance without another object
CORNER_SHARE = 0.7  # radius of the corners of an object, as a share of half its shorter side
MOST_TTC_S = 5.0
_ASKEW_RAD = math.radians(75.0)  # largest difference in heading of follower and leader
_SLIGHTLY_RAD = math.radians(10.0)  # the same, for a sideways overlap below `_OVERLAP_M`
_OVERLAP_M = 0.5
_CLOSED_M2 = 1.0  # a polyline whose ends are this close is a ring
_POINTS = 4096  # points that are compared with a polyline at once


@dataclass(frozen=True)
class Trajectories:
    """The poses of N objects at T times.

    Attributes:
        poses: (N, T, 3) x and y of the centre in m, and heading in rad.
        valid: (N, T) whether the object is present.
        sizes_m: (N, 2) length and width.
    """

    poses: Numbers
    valid: NDArray[np.bool_]
    sizes_m: Numbers


@dataclass(frozen=True)
class RolloutFeatures:
    """Features (E, T) of the first E objects, in m, s and rad; valid where `valid` is true.

    Derivatives are central differences: NaN at the first and the last time, accelerations also
    beside them.
    """

    valid: NDArray[np.bool_]
    linear_speed: Numbers
    linear_acceleration: Numbers
    angular_speed: Numbers
    angular_acceleration: Numbers
    distance_to_nearest_object: Numbers
    time_to_collision: Numbers
    distance_to_road_edge: Numbers

    @property
    def collided(self) -> NDArray[np.bool_]:
        """(E, T) whether the object overlaps another one."""
        return self.distance_to_nearest_object < 0.0

    @property
    def off_road(self) -> NDArray[np.bool_]:
        """(E, T) whether a corner of the object is beyond a road edge."""
        return self.distance_to_road_edge > 0.0


def features_of(
    objects: Trajectories, evaluated: int, road_edges: Sequence[Numbers], step_s: float
) -> RolloutFeatures:
    """Return the features of the first `evaluated` objects.

    `road_edges`: polylines (n, 2) with the road on their left. `step_s`: time between two poses.

    Raises ScenarioError: there are no road edges.
    """
    poses, valid = objects.poses[:evaluated], objects.valid[:evaluated]
    speed = _half_steps(poses[..., :2])
    linear = hypot_all(speed[..., 0], speed[..., 1]) / step_s
    turn = wrapped(2.0 * _half_steps(poses[..., 2])) / 2.0
    return RolloutFeatures(
        valid=valid,
        linear_speed=linear,
        linear_acceleration=_half_steps(linear) / step_s,
        angular_speed=turn / step_s,
        angular_acceleration=wrapped(2.0 * _half_steps(turn)) / 2.0 / (step_s * step_s),
        distance_to_nearest_object=_distances(objects, evaluated),
        time_to_collision=_times_to_collision(objects, evaluated, step_s),
        distance_to_road_edge=_edge_distances(objects, evaluated, road_edges),
    )


def derivative_valid(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a central difference of valid values is valid."""
    found = np.zeros_like(valid)
    found[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return found


def _half_steps(values: Numbers) -> Numbers:
    """Return half the differences of the values before and after, NaN at both ends; axis 1."""
    found = np.full_like(values, np.nan)
    found[:, 1:-1] = (values[:, 2:] - values[:, :-2]) / 2.0
    return found


def corners_of(poses: Numbers, sizes_m: Numbers) -> Numbers:
    """Return (N, T, 4, 2) the corners of boxes, counter-clockwise.

    `poses`: (N, T, 3). `sizes_m`: (N, 2).
    """
    cos, sin = cos_all(poses[..., 2]), sin_all(poses[..., 2])
    signs = np.array([(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)])
    u, v = (0.5 * sizes_m[:, None, None, k] * signs[None, None, :, k] for k in (0, 1))
    x = poses[..., None, 0] + u * cos[..., None] - v * sin[..., None]
    y = poses[..., None, 1] + u * sin[..., None] + v * cos[..., None]
    return np.stack([x, y], axis=-1)


def _distances(objects: Trajectories, evaluated: int) -> Numbers:
    """Return (E, T) the signed distance to the nearest other object; negative: overlap.

    Objects are boxes with round corners: all points within a radius of a smaller box, the core.
    """
    radius = 0.5 * CORNER_SHARE * objects.sizes_m.min(axis=1)
    cores = replace(objects, sizes_m=objects.sizes_m - 2.0 * radius[:, None])
    corners = corners_of(cores.poses, cores.sizes_m)
    found = np.full(objects.valid[:evaluated].shape, NEVER_M)
    for k in range(evaluated):
        apart = signed_distances(cores, corners, k) - (radius + radius[k])[:, None]
        both = objects.valid & objects.valid[k]
        both[k] = False
        found[k] = np.where(both, apart, NEVER_M).min(axis=0)
    return found


def signed_distances(objects: Trajectories, corners: Numbers, k: int) -> Numbers:
    """Return (N, T) the signed distance between the boxes of object k and of each object.

    If two boxes are apart, it is the shortest distance from a corner of one box to the other box.
    If they overlap, it is the length of the shortest move that separates them, negated.
    """
    outside = np.full(objects.valid.shape, np.inf)
    gap = np.full(objects.valid.shape, -np.inf)
    for owner, other in ((objects.poses[k][None], None), (objects.poses, k)):
        cos, sin = cos_all(owner[..., 2]), sin_all(owner[..., 2])
        points = corners if other is None else corners[other][None]
        size = objects.sizes_m[k][None, :] if other is None else objects.sizes_m
        east, north = (points[..., axis] - owner[..., None, axis] for axis in (0, 1))
        u = east * cos[..., None] + north * sin[..., None]
        v = north * cos[..., None] - east * sin[..., None]
        long, wide = 0.5 * size[:, None, None, 0], 0.5 * size[:, None, None, 1]
        over_u = np.maximum(np.abs(u) - long, 0.0)
        over_v = np.maximum(np.abs(v) - wide, 0.0)
        outside = np.minimum(outside, hypot_all(over_u, over_v).min(axis=-1))
        for along, half in ((u, long[..., 0]), (v, wide[..., 0])):
            gap = np.maximum(gap, along.min(axis=-1) - half)
            gap = np.maximum(gap, -half - along.max(axis=-1))
    found: Numbers = np.where(gap < 0.0, gap, outside)
    return found


def _times_to_collision(objects: Trajectories, evaluated: int, step_s: float) -> Numbers:
    """Return (E, T) the time until each object reaches the object that it follows, 5 s at most.

    It is also 5 s if the speed of either object is unknown.
    """
    moves = _half_steps(objects.poses[..., :2])
    speed = hypot_all(moves[..., 0], moves[..., 1]) / step_s
    speed[~derivative_valid(objects.valid)] = np.nan
    heading, half = objects.poses[..., 2], 0.5 * objects.sizes_m
    found = np.full(objects.valid[:evaluated].shape, MOST_TTC_S)
    times = np.arange(objects.valid.shape[1])
    for k in range(evaluated):
        cos, sin = cos_all(heading[k]), sin_all(heading[k])
        east, north = (objects.poses[..., axis] - objects.poses[k, :, axis] for axis in (0, 1))
        turned = np.abs(heading - heading[k])
        cos_turned, sin_turned = np.abs(cos_all(turned)), np.abs(sin_all(turned))
        length, width = half[:, None, 0], half[:, None, 1]
        ahead = east * cos + north * sin - half[k, 0] - (length * cos_turned + width * sin_turned)
        beside = np.abs(north * cos - east * sin) - half[k, 1]
        beside -= length * sin_turned + width * cos_turned
        follows = objects.valid & (ahead > 0.0) & (turned <= _ASKEW_RAD) & (beside < 0.0)
        follows &= (beside < -_OVERLAP_M) | (turned <= _SLIGHTLY_RAD)
        gap = np.where(follows, ahead, NEVER_M)
        leader = gap.argmin(axis=0)
        closing = speed[k] - speed[leader, times]
        with np.errstate(divide="ignore", invalid="ignore"):
            ttc = np.minimum(gap[leader, times] / closing, MOST_TTC_S)
        found[k] = np.where(closing > 0.0, ttc, MOST_TTC_S)
    return found


def _edge_distances(
    objects: Trajectories, evaluated: int, road_edges: Sequence[Numbers]
) -> Numbers:
    """Return (E, T) the largest signed distance of a corner to the nearest road edge.

    It is positive off the road.
    """
    lines = [line for line in map(_without_repeats, road_edges) if len(line) >= 2]
    if not lines:
        raise ScenarioError(
            "the scene has no road edges, which two of the components need: export it with the "
            "edges of the road (ROAD_EDGE… or road_edge)"
        )
    corners = corners_of(objects.poses[:evaluated], objects.sizes_m[:evaluated])
    points = corners.reshape(-1, 2)
    nearest = np.full(len(points), NEVER_M)
    least = np.stack([_box_distance(points, line) for line in lines])
    for number in np.argsort(least.mean(axis=1), kind="stable").tolist():
        near = np.flatnonzero(least[number] <= np.abs(nearest))
        for first in range(0, len(near), _POINTS):
            part = near[first : first + _POINTS]
            apart = _line_distance(points[part], lines[number])
            closer = np.abs(apart) < np.abs(nearest[part])
            nearest[part] = np.where(closer, apart, nearest[part])
    largest = nearest.reshape(corners.shape[:-1]).max(axis=-1)
    found: Numbers = np.where(objects.valid[:evaluated], largest, -NEVER_M)
    return found


def _without_repeats(line: Numbers) -> Numbers:
    found: Numbers = line[np.concatenate([[True], (np.diff(line, axis=0) != 0.0).any(axis=1)])]
    return found


def _box_distance(points: Numbers, line: Numbers) -> Numbers:
    """Return (P,) the distance of points to the box around a polyline, a lower bound."""
    low, high = line.min(axis=0), line.max(axis=0)
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    return hypot_all(outside[:, 0], outside[:, 1])


def _line_distance(points: Numbers, line: Numbers) -> Numbers:
    """Return (P,) the signed distance of points to a polyline, positive on its right.

    If the nearest point of the polyline is one of its vertices, the sides of both segments there
    decide: at a bend to the right, a point is on the left if it is on the left of either segment;
    at another bend, if it is on the left of both segments.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    away = points[:, None] - start[None]
    square = step[:, 0] * step[:, 0] + step[:, 1] * step[:, 1]
    share = (away[..., 0] * step[:, 0] + away[..., 1] * step[:, 1]) / square
    on = np.clip(share, 0.0, 1.0)
    east, north = away[..., 0] - on * step[:, 0], away[..., 1] - on * step[:, 1]
    apart = hypot_all(east, north)
    side = np.sign(away[..., 0] * step[:, 1] - away[..., 1] * step[:, 0])
    segment = apart.argmin(axis=1)
    row = np.arange(len(points))
    count = len(step)
    ends = line[0] - line[-1]
    is_ring = bool(ends[0] * ends[0] + ends[1] * ends[1] < _CLOSED_M2)
    at = share[row, segment]
    neighbour = segment + np.where(at < 0.0, -1, 1)
    inside = (neighbour >= 0) & (neighbour < count)
    other = np.where(inside | is_ring, neighbour % count, segment)
    own, theirs = side[row, segment], side[row, other]
    first = np.where(at < 0.0, neighbour, segment) % count
    second = (first + 1) % count
    cross = step[first, 0] * step[second, 1] - step[first, 1] * step[second, 0]
    at_vertex = np.where(cross > 0.0, np.maximum(own, theirs), np.minimum(own, theirs))
    sign = np.where((at < 0.0) | (at >= 1.0), at_vertex, own)
    found: Numbers = sign * apart[row, segment]
    return found
