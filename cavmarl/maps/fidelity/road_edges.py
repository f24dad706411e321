"""Compares the borders and heights of a map's roads with a cloud.

The border of a road is the first step of more than `STEP_M` from the road's height, searched from
the middle of the outer lane outwards: a kerb, a bank, a ditch or a wall. A cross-section without a
step is not counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import require
from cavmarl.maps.fidelity.map_surface import Box, along_lane, lanes_in
from cavmarl.roads.network import RoadNetwork

Points = NDArray[np.float64]

STATION_M = 2.0  # distance between two cross-sections
BEYOND_M = 3.0  # the cloud's border is searched up to this distance outside of the map's border
STEP_M = 0.05  # minimum change of height at a border
_BIN_M = 0.1
_LEVEL_M = 1.5  # points farther above or below the road do not belong to it
_FEWEST = 3  # minimum number of points for a bin and for a height
_FEWEST_STATIONS = 6
_OUTLIER = 3.0  # distance of outliers from the median, in median deviations


@dataclass(frozen=True)
class RoadFit:
    """The differences between the roads of a cloud and of a map; offsets are cloud minus map."""

    stations: int  # cross-sections of the map in the cloud's box
    edge_offset_m: Points  # at sections with a border in the cloud; positive: farther outside
    height_offset_m: Points  # at cross-sections with a road in the cloud
    # (4, 4) from the cloud to the map; None: too few borders, or all in one direction
    transform: Points | None

    @property
    def lateral_rmse_m(self) -> float | None:
        return _rmse(self.edge_offset_m)

    @property
    def height_rmse_m(self) -> float | None:
        return _rmse(self.height_offset_m)

    def to_dict(self) -> dict[str, Any]:
        return {
            "stations": self.stations,
            "borders_found": len(self.edge_offset_m),
            "lateral_rmse_m": self.lateral_rmse_m,
            "lateral_median_m": _median(self.edge_offset_m),
            "heights_found": len(self.height_offset_m),
            "height_rmse_m": self.height_rmse_m,
            "height_median_m": _median(self.height_offset_m),
            "transform": None if self.transform is None else self.transform.tolist(),
        }


def _rmse(values: Points) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _median(values: Points) -> float | None:
    return float(np.median(values)) if len(values) else None


@dataclass(frozen=True)
class _Stations:
    border: Points  # (n, 3) on the outer border of a road
    outwards: Points  # (n, 2)
    inner_m: Points  # (n,) from the border to the middle of the outer lane


def fit_roads(network: RoadNetwork, points: Points, box_m: Box, threads: int = 2) -> RoadFit:
    """Compare a cloud (n, 3) in the map's frame with the map's borders and heights."""
    stations = _stations(network, box_m)
    if not len(stations.border):
        return RoadFit(0, np.zeros(0), np.zeros(0), None)
    gicp: Any = require("small_gicp", "maps")
    middle = stations.border.mean(axis=0)
    flat = stations.border - middle
    flat[:, 2] = 0.0
    asked = points - middle
    asked[:, 2] = 0.0
    rows = np.asarray(
        gicp.KdTree(flat, threads).batch_nearest_neighbor_search(asked, threads)[0], dtype=np.int64
    )
    apart = points - stations.border[rows]
    out = stations.outwards[rows]
    outer_m = (apart[:, :2] * out).sum(axis=1)
    along_m = apart[:, 0] * out[:, 1] - apart[:, 1] * out[:, 0]
    near = (np.abs(along_m) <= 0.5 * STATION_M) & (np.abs(apart[:, 2]) <= _LEVEL_M)
    near &= (outer_m <= BEYOND_M) & (outer_m >= -2.0 * stations.inner_m[rows])
    rows, outer_m, height_m = rows[near], outer_m[near], apart[near, 2]
    order = np.argsort(rows, kind="stable")
    rows, outer_m, height_m = rows[order], outer_m[order], height_m[order]
    found, firsts = np.unique(rows, return_index=True)
    edges: dict[int, float] = {}
    heights = []
    for station, first, end in zip(found, firsts, [*firsts[1:], len(rows)], strict=True):
        border_m, road_m = _section(outer_m[first:end], height_m[first:end])
        if road_m is not None:
            heights.append(road_m)
        if border_m is not None:
            edges[int(station)] = border_m
    at = np.array(list(edges), dtype=np.int64)
    offset_m = np.array(list(edges.values()))
    transform = _motion(stations, at, offset_m, np.array(heights))
    return RoadFit(len(stations.border), offset_m, np.array(heights), transform)


def _stations(network: RoadNetwork, box_m: Box) -> _Stations:
    lanes = network.lanes
    outer = lanes_in(network, box_m)
    outer = outer[~lanes["internal"][outer] & (lanes["index"][outer] == 0)]
    side = 1.0 if network.left_hand else -1.0
    border, outwards, inner = [], [], []
    for lane in outer:
        places, direction = along_lane(network, int(lane), STATION_M)
        out = side * np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        half_m = 0.5 * float(lanes["width_m"][lane])
        places[:, :2] += half_m * out
        border.append(places)
        outwards.append(out)
        inner.append(np.full(len(places), half_m))
    if not border:
        return _Stations(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    return _Stations(np.concatenate(border), np.concatenate(outwards), np.concatenate(inner))


def _section(outer_m: Points, height_m: Points) -> tuple[float | None, float | None]:
    """Return the position of the cloud's border and its road's height, relative to the map's."""
    low_m = float(outer_m.min())
    road = (
        outer_m <= max(0.5 * low_m, low_m + 0.5) if low_m < -0.5 else np.zeros(len(outer_m), bool)
    )
    if road.sum() < _FEWEST:
        return None, None
    road_m = float(np.median(height_m[road]))
    bins = np.floor(outer_m / _BIN_M).astype(np.int64)
    order = np.lexsort((height_m, bins))
    numbers, firsts = np.unique(bins[order], return_index=True)
    ends = [*firsts[1:].tolist(), len(order)]
    before = None
    for number, first, end in zip(numbers.tolist(), firsts.tolist(), ends, strict=True):
        if number * _BIN_M < 0.5 * low_m or end - first < _FEWEST:
            continue
        inside = outer_m[order[first:end]]
        steps = np.abs(height_m[order[first:end]] - road_m) > STEP_M
        if steps.mean() > 0.5:
            # The border is the first point off the road, but not before the last point on it.
            return float(
                inside[steps].min() if before is None else max(before, inside.min())
            ), road_m
        before = float(inside[~steps].max())
    return None, road_m


def _motion(
    stations: _Stations, at: NDArray[np.int64], offset_m: Points, heights_m: Points
) -> Points | None:
    """Return the least-squares motion in the plane; its z is minus the median height offset."""
    if len(at) < _FEWEST_STATIONS:
        return None
    middle = np.median(offset_m)
    deviation = np.median(np.abs(offset_m - middle)) + 1e-3
    at, offset_m = at[np.abs(offset_m - middle) <= _OUTLIER * deviation + _BIN_M], offset_m[
        np.abs(offset_m - middle) <= _OUTLIER * deviation + _BIN_M
    ]  # fmt: skip
    out = stations.outwards[at]
    place = stations.border[at, :2] + offset_m[:, None] * out
    centre = place.mean(axis=0)
    arm = place - centre
    size_m = max(float(np.abs(arm).max()), 1.0)
    turn = (arm[:, 0] * out[:, 1] - arm[:, 1] * out[:, 0]) / size_m
    rows = np.column_stack([out, turn])
    if np.linalg.svd(rows, compute_uv=False)[-1] < 0.05 * np.sqrt(len(rows)):
        return None
    step, *_ = np.linalg.lstsq(rows, -offset_m, rcond=None)
    angle = float(step[2] / size_m)
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[:2, 3] = centre + step[:2] - motion[:2, :2] @ centre
    motion[2, 3] = -float(np.median(heights_m)) if len(heights_m) else 0.0
    return motion
