"""Filters that thin out and crop clouds and remove outliers; each counts the removed points."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.maps.fidelity.cloud_files import Cloud

NEIGHBOURS = 8
_SWAPPED = 0.4  # x and y seem swapped if the swap raises the share on the map by more than this
_VOXEL_BITS = 20  # bits of a voxel's index on an axis, without its sign


def thin_out(cloud: Cloud, voxel_m: float, threads: int = 2) -> Cloud:
    """Replace the points in each cube of side `voxel_m` by their mean; 0: no filter."""
    if voxel_m == 0.0:
        return cloud
    if not 0.0 < voxel_m < np.inf:
        raise ConfigError(f"voxels of {voxel_m:g} m: give a side above 0, or 0 for no filter")
    gicp: Any = require("small_gicp", "maps")
    # The library numbers voxels from (0, 0, 0) and drops points too far from this origin.
    middle = 0.5 * (cloud.points.min(axis=0) + cloud.points.max(axis=0))
    if np.ptp(cloud.points, axis=0).max() / voxel_m >= 2.0 * (1 << _VOXEL_BITS):
        raise ConfigError(
            f"{cloud.name}: is {np.ptp(cloud.points, axis=0).max():.0f} m long, too long for "
            f"voxels of {voxel_m:g} m: use larger voxels, or remove stray points"
        )
    thinned = gicp.voxelgrid_sampling(cloud.points - middle, voxel_m, threads)
    return cloud.kept(np.asarray(thinned.points())[:, :3] + middle, "voxel filter")


def drop_outliers(cloud: Cloud, sigmas: float, threads: int = 2) -> Cloud:
    """Remove points that are far from their neighbours; 0 sigmas: no filter.

    A point is far if its mean distance to its `NEIGHBOURS` nearest points exceeds the mean over all
    points by `sigmas` standard deviations (Rusu et al., "Towards 3D point cloud based object maps",
    2008).
    """
    if sigmas == 0.0 or len(cloud.points) <= NEIGHBOURS:
        return cloud
    if not 0.0 < sigmas < np.inf:
        raise ConfigError(
            f"outliers beyond {sigmas:g} sigmas: give a number above 0, or 0 for no filter"
        )
    distance_m = neighbour_distances(cloud.points, NEIGHBOURS, threads).mean(axis=1)
    kept = distance_m <= distance_m.mean() + sigmas * distance_m.std()
    return cloud.kept(cloud.points[kept], "outlier filter")


def neighbour_distances(points: Any, number: int, threads: int = 2) -> Any:
    """Return (n, number) distances in m of each point to its nearest neighbours in the cloud."""
    gicp: Any = require("small_gicp", "maps")
    centred = points - points.mean(axis=0)
    _, squares = gicp.KdTree(centred, threads).batch_knn_search(centred, number + 1, threads)
    return np.sqrt(np.asarray(squares)[:, 1:])


def crop(cloud: Cloud, box_m: tuple[float, float, float, float], margin_m: float) -> Cloud:
    """Return the points within a box of the plane and a margin around it.

    Raises MapError: no point is inside, or far more points would be if x and y were swapped.
    """
    low = np.array(box_m[:2]) - margin_m
    high = np.array(box_m[2:]) + margin_m
    plane = cloud.points[:, :2]
    inside = ((plane >= low) & (plane <= high)).all(axis=1)
    swapped = ((plane[:, ::-1] >= low) & (plane[:, ::-1] <= high)).all(axis=1)
    if not inside.any() or swapped.mean() > inside.mean() + _SWAPPED:
        raise _elsewhere(cloud, low, high)
    return cloud.kept(cloud.points[inside], "off the map")


def _elsewhere(cloud: Cloud, low: Any, high: Any) -> MapError:
    plane = cloud.points[:, :2]
    swapped = ((plane[:, ::-1] >= low) & (plane[:, ::-1] <= high)).all(axis=1).mean() > 0.5
    degrees = bool((np.abs(plane) <= 360.0).all()) and float(np.ptp(plane, axis=0).max()) < 1.0
    (x0, y0), (x1, y1) = plane.min(axis=0), plane.max(axis=0)
    cure = "give its frame (--frame projected or degrees), or a transform (--start)"
    if swapped:
        cure = "its x and y seem to be swapped: --frame swapped"
    elif degrees:
        cure = "these look like degrees: --frame degrees"
    return MapError(
        f"{cloud.name}: is at x {x0:.1f} … {x1:.1f}, y {y0:.1f} … {y1:.1f}, the map at x "
        f"{low[0]:.1f} … {high[0]:.1f}, y {low[1]:.1f} … {high[1]:.1f}: {cure}"
    )
