"""Layouts of zones: a grid, strips, or recursive coordinate bisection.

Bisection halves the weight of the map (lanes or expected vehicles) across its longer side, and then
each half again (Berger and Bokhari, IEEE Trans. Computers C-36, 1987). A number of zones that is
not a power of two is split as evenly as possible. Grid and strips have equal sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.zones import MAX_ZONES, ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import Bounds, ZonePartition
from cavmarl.zones.partition.zone_survey import junction_boxes, lane_samples

Floats = NDArray[np.float64]
Rect = tuple[float, float, float, float]

_WEIGHTS = ("lane_length", "uniform")
MIN_SIDE_M = 5.0  # minimum side of a zone: about the length of a car
# Margin around the roads, so that even a single straight road has an area.
_RIM_M = 5.0
# How far a cut may move to avoid junctions, as a share of a zone's side or of the smaller weight.
_SIDE_SHIFT = 0.25
_WEIGHT_SHIFT = 0.1
# Distance of a moved cut from the junction that it avoids, if there is room.
_CLEAR_M = 1.0


@dataclass(frozen=True)
class _Area:
    """The area to cut, with its weight and its junctions."""

    bounds: Bounds  # the box of the map
    samples: Floats | None  # (n, 3) x, y and weight; None: weight by area
    junctions: Floats  # (m, 4) boxes that cuts avoid


def cut_map(
    network: RoadNetwork,
    layout: str,  # `grid`, `strips` or `bisection`
    count: int,  # k
    *,
    # whether to move cuts, by at most a quarter of a zone's side (bisection: a tenth of the
    # weight), so that they do not cut junctions
    avoid_junctions: bool = False,
    weight: str = "lane_length",  # for bisection: `lane_length`, or `uniform` for area
    # (n, 3) x and y in m and a weight, such as expected vehicles; it replaces `weight`
    density: Floats | None = None,
) -> ZonePartition:
    """Divide a map into `count` zones."""
    if layout not in ZONE_LAYOUTS:
        raise ConfigError(f"layout '{layout}' does not exist; use {', '.join(ZONE_LAYOUTS)}")
    if weight not in _WEIGHTS:
        raise ConfigError(f"weight '{weight}' does not exist; use {', '.join(_WEIGHTS)}")
    if not 1 <= count <= MAX_ZONES:
        raise ConfigError(f"{count} zones: must be a whole number from 1 to {MAX_ZONES}")
    min_x, min_y, max_x, max_y = network.extent_m
    area = _Area(
        bounds=(min_x - _RIM_M, min_y - _RIM_M, max_x + _RIM_M, max_y + _RIM_M),
        samples=_samples(network, weight, density) if layout == "bisection" else None,
        junctions=junction_boxes(network) if avoid_junctions else np.empty((0, 4)),
    )
    if layout == "bisection":
        rects = _bisected(area, area.bounds, area.samples, count)
    else:
        rects = _gridded(area, *_grid_shape(area.bounds, count, strips=layout == "strips"))
    return ZonePartition(area.bounds, np.array(rects))


def _samples(network: RoadNetwork, weight: str, density: Floats | None) -> Floats | None:
    if density is None:
        return None if weight == "uniform" else lane_samples(network)
    density = np.asarray(density, dtype=np.float64)
    shaped = density.ndim == 2 and density.shape[1] == 3
    if not (shaped and np.isfinite(density).all() and (density[:, 2] >= 0.0).all()):
        raise ConfigError("density: must be rows of finite x, y and weight, with no weight below 0")
    return density[density[:, 2] > 0.0]


def _grid_shape(bounds: Bounds, count: int, *, strips: bool) -> tuple[int, int]:
    """Return (rows, columns) with cells as square as possible; strips cut the longer side."""
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    shapes = [(rows, count // rows) for rows in range(1, count + 1) if count % rows == 0]
    if strips:
        shapes = [(1, count)] if width >= height else [(count, 1)]

    def shorter_side(shape: tuple[int, int]) -> float:
        return min(height / shape[0], width / shape[1])

    best = max(shapes, key=shorter_side)
    if shorter_side(best) < MIN_SIDE_M:
        raise ConfigError(
            f"{count} zones: {best[0]} rows and {best[1]} columns of a map of {width:.0f} m x "
            f"{height:.0f} m would be {height / best[0]:.2f} m x {width / best[1]:.2f} m; a zone's "
            f"sides must be at least {MIN_SIDE_M:g} m, so use fewer zones or another layout"
        )
    return best


def _gridded(area: _Area, rows: int, columns: int) -> list[Rect]:
    xs, ys = _even_cuts(area, 0, columns), _even_cuts(area, 1, rows)
    return [
        (xs[column], ys[row], xs[column + 1], ys[row + 1])
        for row in range(rows)
        for column in range(columns)
    ]


def _even_cuts(area: _Area, axis: int, parts: int) -> list[float]:
    """Return the `parts` + 1 sides of zones along an axis."""
    low, high = area.bounds[axis], area.bounds[axis + 2]
    side = (high - low) / parts
    room = min(_SIDE_SHIFT * side, (side - MIN_SIDE_M) / 2.0)
    cuts = [low + side * part for part in range(1, parts)]
    return [
        low,
        *(_quiet_cut(area, area.bounds, axis, (cut - room, cut, cut + room)) for cut in cuts),
        high,
    ]


def _bisected(area: _Area, rect: Rect, samples: Floats | None, count: int) -> list[Rect]:
    if count == 1:
        return [rect]
    size = (rect[2] - rect[0], rect[3] - rect[1])
    if samples is not None and len(samples):
        size = tuple(np.ptp(samples[:, :2], axis=0))
    share = (count // 2) / count
    for axis in (0, 1) if size[0] >= size[1] else (1, 0):
        window = _window(rect, samples, axis, share)
        if window is not None:
            break
    else:
        raise ConfigError(
            f"the map cannot hold this many zones: no cut divides x {rect[0]:.2f} to "
            f"{rect[2]:.2f}, y {rect[1]:.2f} to {rect[3]:.2f} into {count} zones, each with a part "
            f"of the weight and with sides of at least {MIN_SIDE_M:g} m; use fewer zones"
        )
    cut = _quiet_cut(area, rect, axis, window)
    low, high = list(rect), list(rect)
    low[axis + 2] = high[axis] = cut
    below = above = None
    if samples is not None:
        is_below = samples[:, axis] < cut
        below, above = samples[is_below], samples[~is_below]
    return [
        *_bisected(area, (low[0], low[1], low[2], low[3]), below, count // 2),
        *_bisected(area, (high[0], high[1], high[2], high[3]), above, count - count // 2),
    ]


def _window(
    rect: Rect, samples: Floats | None, axis: int, share: float
) -> tuple[float, float, float] | None:
    """Return three cuts: the first allowed cut, the wanted cut, and the last allowed cut.

    The wanted cut has the `share` of the weight below it. Return None if no cut is allowed.
    """
    low, high = rect[axis] + MIN_SIDE_M, rect[axis + 2] - MIN_SIDE_M
    shift = _WEIGHT_SHIFT * min(share, 1.0 - share)
    place = _quantile(rect, samples, axis)
    if samples is not None:
        if not len(samples):
            return None
        low = max(low, float(np.nextafter(samples[:, axis].min(), np.inf)))
        high = min(high, float(samples[:, axis].max()))
    if not low <= high:
        return None
    first, cut, last = (
        min(max(place(part), low), high) for part in (share - shift, share, share + shift)
    )
    return first, cut, last


def _quantile(rect: Rect, samples: Floats | None, axis: int) -> Callable[[float], float]:
    """Return a function that maps a share of the weight to the coordinate of that quantile."""
    if samples is None or not len(samples):
        low, high = rect[axis], rect[axis + 2]
        return lambda share: low + share * (high - low)
    order = np.argsort(samples[:, axis], kind="stable")
    places, sums = samples[order, axis], np.cumsum(samples[order, 2])
    last = len(places) - 1

    def place(share: float) -> float:
        rank = min(int(np.searchsorted(sums, share * sums[-1])), last)
        return float(places[rank] + places[min(rank + 1, last)]) / 2.0

    return place


def _quiet_cut(
    area: _Area,
    rect: Rect,  # the part to cut
    axis: int,  # 0: between left and right, 1: between below and above
    window: tuple[float, float, float],  # first allowed, wanted and last allowed cut
) -> float:
    """Return the cut in a window that divides the fewest junctions; on a tie, the nearest cut."""
    first, wanted, last = window
    across = 1 - axis
    boxes = area.junctions
    met = (boxes[:, across] < rect[across + 2]) & (boxes[:, across + 2] >= rect[across])
    lows, highs = boxes[met, axis], boxes[met, axis + 2]
    edges = np.unique(np.clip(np.concatenate([lows, highs, [first, last]]), first, last))
    # All cuts between two adjacent edges divide the same junctions.
    clear = np.minimum(_CLEAR_M, np.diff(edges) / 2.0)
    quiet = np.clip(wanted, edges[:-1] + clear, edges[1:] - clear)
    cuts: list[float] = [wanted, *quiet.tolist()]

    def cost(cut: float) -> tuple[int, float]:
        return int(((lows < cut) & (cut <= highs)).sum()), abs(cut - wanted)

    return min(cuts, key=cost)
