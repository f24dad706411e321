"""Comparison of a surveyed cloud with the surface of the map that it was made on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.maps.fidelity.cloud_registration import FEWEST_POINTS, Target, nearest_distances
from cavmarl.maps.fidelity.comparison import Comparison, compare
from cavmarl.maps.fidelity.map_surface import map_surface
from cavmarl.roads.network import RoadNetwork

Points = NDArray[np.float64]

_ON_LANE_M = 0.4  # maximum horizontal distance of a point on a lane from the lane's surface
_HIGH_M = 0.5  # height above the road; higher points are not ground
_WALL_M = 2.0  # points farther from a wall belong to other objects
_SEEN_M = 0.5  # a place on a lane is covered if a point is this near
_MARGIN_M = 1.0
_SAMPLED_M = 0.5  # spacing of samples on the map's surface


@dataclass(frozen=True)
class SurveyFit:
    """The distance of a cloud from a map's surface; in m."""

    height_rmse_m: float  # vertical error of points on lanes
    height_median_m: float
    wall_rmse_m: float | None  # error of points near walls, across the wall; None: no such points
    wall_median_m: float | None
    seen_share: float  # covered share of the lanes around the cloud

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def fit_survey(cloud: Cloud, network: RoadNetwork) -> tuple[SurveyFit, Comparison]:
    """Compare a cloud in the map's frame with the map, without alignment.

    Points on the ground beside lanes, which the map does not have, are left out and counted.

    Raises MapError: no point of the cloud lies on the map.
    """
    gicp: Any = require("small_gicp", "maps")
    plane = cloud.points[:, :2]
    box = (*(plane.min(axis=0) - _MARGIN_M), *(plane.max(axis=0) + _MARGIN_M))
    whole, spacing_m = map_surface(network, box, _SAMPLED_M)
    lanes = map_surface(replace(network, walls=network.walls[:0]), box, spacing_m)[0].points
    flat = np.array([1.0, 1.0, 0.0])
    rows, squares = gicp.KdTree(lanes * flat).batch_nearest_neighbor_search(cloud.points * flat)
    above_m = cloud.points[:, 2] - lanes[np.asarray(rows), 2]
    high = above_m > _HIGH_M
    ground = (np.asarray(squares) < _ON_LANE_M**2) & ~high
    kept = cloud.kept(cloud.points[ground | high], "ground beside lanes")
    if not ground.any() or len(kept.points) < FEWEST_POINTS:
        raise MapError(f"{cloud.name}: has no ground on '{network.name}'; survey more steps")
    wall_m = _across_walls(whole.points[len(lanes) :], cloud.points[high])
    seen = nearest_distances(lanes, kept.points) < _SEEN_M
    fit = SurveyFit(
        height_rmse_m=float(np.sqrt(np.mean(above_m[ground] ** 2))),
        height_median_m=float(np.median(above_m[ground])),
        wall_rmse_m=float(np.sqrt(np.mean(wall_m**2))) if len(wall_m) else None,
        wall_median_m=float(np.median(wall_m)) if len(wall_m) else None,
        seen_share=float(seen.mean()),
    )
    return fit, compare(kept, whole, registered=False)


def _across_walls(walls: Points, points: Points) -> Points:
    """Return absolute distances of points from sampled walls, perpendicular to the wall."""
    if len(walls) < FEWEST_POINTS or not len(points):
        return np.zeros(0)
    target = Target(walls)
    rows, distance_m = target.nearest(points)
    near = distance_m < _WALL_M
    normals = np.asarray(target.cloud.normals())[rows[near], :3]
    found: Points = np.abs(((points[near] - walls[rows[near]]) * normals).sum(axis=1))
    return found
