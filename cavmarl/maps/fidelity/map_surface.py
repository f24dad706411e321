"""The surface of a map as a cloud: lanes from border to border, and walls of buildings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.roads.network import RoadNetwork

Points = NDArray[np.float64]
Box = tuple[float, float, float, float]

MOST_POINTS = 2_000_000
_FINEST_M = 0.1


def map_surface(network: RoadNetwork, box_m: Box, spacing_m: float = 0.25) -> tuple[Cloud, float]:
    """Return points on the map's lanes and walls within a box of the plane, and their spacing.

    If more than `MOST_POINTS` would be needed, the spacing is larger than `spacing_m`.

    Raises MapError: the box has no lane.
    """
    lanes = lanes_in(network, box_m)
    if not len(lanes):
        place = "x {0:.1f} … {2:.1f}, y {1:.1f} … {3:.1f}".format(*box_m)
        raise MapError(
            f"the map '{network.name}' has no lane in the box of the cloud ({place}): give another "
            "cloud, or the cloud's frame (--frame projected, degrees, swapped)"
        )
    area_m2 = float((network.lanes["length_m"][lanes] * network.lanes["width_m"][lanes]).sum())
    walls = _walls_in(network, box_m)
    area_m2 += float((_lengths(walls) * walls["height"]).sum()) if len(walls) else 0.0
    spacing_m = max(spacing_m, _FINEST_M, float(np.sqrt(area_m2 / MOST_POINTS)))
    parts = [_lane_places(network, int(lane), spacing_m) for lane in lanes]
    parts += [_wall_places(wall, spacing_m, _ground_m(network)) for wall in walls]
    points = np.concatenate(parts)
    low, high = np.array(box_m[:2]), np.array(box_m[2:])
    points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
    return Cloud(f"map '{network.name}'", points, {"sampled": len(points)}), spacing_m


def lanes_in(network: RoadNetwork, box_m: Box) -> NDArray[np.int64]:
    """Return LANE rows whose bounding boxes meet a box."""
    rows = network.lanes
    meets = (rows["max_x"] >= box_m[0]) & (rows["min_x"] <= box_m[2])
    meets &= (rows["max_y"] >= box_m[1]) & (rows["min_y"] <= box_m[3])
    return np.flatnonzero(meets)


def along_lane(network: RoadNetwork, lane: int, spacing_m: float) -> tuple[Points, Points]:
    """Return points (n, 3) on a lane's centre line, at most `spacing_m` apart, and directions."""
    points = network.lane_points(lane)
    end_m = float(points["s"][-1])
    at = np.linspace(0.0, end_m, int(end_m / spacing_m) + 2)
    places = np.stack([np.interp(at, points["s"], points[axis]) for axis in "xyz"], axis=1)
    segment = np.clip(np.searchsorted(points["s"], at, side="right") - 1, 0, len(points) - 2)
    return places, np.stack([points["cos"][segment], points["sin"][segment]], axis=1)


def _lane_places(network: RoadNetwork, lane: int, spacing_m: float) -> Points:
    places, direction = along_lane(network, lane, spacing_m)
    half_m = 0.5 * float(network.lanes["width_m"][lane])
    across = np.linspace(-half_m, half_m, int(2.0 * half_m / spacing_m) + 2)
    left = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))], axis=1)
    found: Points = (places[:, None] + across[None, :, None] * left[:, None]).reshape(-1, 3)
    return found


def _walls_in(network: RoadNetwork, box_m: Box) -> NDArray[np.void]:
    walls = network.walls
    x = np.stack([walls["ax"], walls["bx"]])
    y = np.stack([walls["ay"], walls["by"]])
    meets = (x.max(axis=0) >= box_m[0]) & (x.min(axis=0) <= box_m[2])
    found: NDArray[np.void] = walls[
        meets & (y.max(axis=0) >= box_m[1]) & (y.min(axis=0) <= box_m[3])
    ]
    return found


def _lengths(walls: NDArray[np.void]) -> Points:
    found: Points = np.hypot(walls["bx"] - walls["ax"], walls["by"] - walls["ay"])
    return found


def _ground_m(network: RoadNetwork) -> tuple[Points, Points]:
    """Return points of roads in the plane (n, 2) and their heights, as the ground under walls."""
    points = network.points
    return np.stack([points["x"], points["y"]], axis=1), np.asarray(points["z"])


def _wall_places(wall: np.void, spacing_m: float, ground: tuple[Points, Points]) -> Points:
    start = np.array([wall["ax"], wall["ay"]])
    end = np.array([wall["bx"], wall["by"]])
    length_m, height_m = float(np.hypot(*(end - start))), float(wall["height"])
    near = np.argmin(((ground[0] - 0.5 * (start + end)) ** 2).sum(axis=1))
    share = np.linspace(0.0, 1.0, int(length_m / spacing_m) + 2)
    up = ground[1][near] + np.linspace(0.0, height_m, int(height_m / spacing_m) + 2)
    plane = start + share[:, None] * (end - start)
    flat = np.repeat(plane, len(up), axis=0)
    return np.column_stack([flat, np.tile(up, len(plane))])
