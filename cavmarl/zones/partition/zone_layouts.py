"""Where to cut a map: into a grid, into strips, or by recursive coordinate bisection.

Bisection halves what there is, lanes or expected vehicles, across its longer side, then each half
again (Berger and Bokhari, IEEE Trans. Computers C-36, 1987); a count that is no power of two is
split as evenly as it goes. Grid and strips have equal sides, whatever is in them.
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
MIN_SIDE_M = 5.0  # of a zone: about a car
# Around the roads, which have a width; a straight road has an area by it.
_RIM_M = 5.0
# How far a cut may be moved to keep junctions whole: of a zone's side, of the lesser part's weight.
_SIDE_SHIFT = 0.25
_WEIGHT_SHIFT = 0.1
# How far beside a junction such a cut lies, where there is room.
_CLEAR_M = 1.0


@dataclass(frozen=True)
class _Area:
    """What is cut: the map's box, what counts in it, and what to keep whole."""

    bounds: Bounds  # the box
    samples: Floats | None  # (n, 3) x, y and weight; none: area counts
    junctions: Floats  # (m, 4) boxes that cuts avoid


def cut_map(
    network: RoadNetwork,
    layout: str,  # `grid`, `strips` or `bisection`
    count: int,  # k
    *,
    # move cuts aside, by at most a quarter of a zone's side (bisection: a tenth of the weight),
    # where that keeps junctions whole
    avoid_junctions: bool = False,
    weight: str = "lane_length",  # what bisection shares out: `lane_length`, or `uniform` for area
    # (n, 3) x and y in m, and a weight: shared out instead, such as expected vehicles
    density: Floats | None = None,
) -> ZonePartition:
    """Divide a map into `count` zones."""
    if layout not in ZONE_LAYOUTS:
        raise ConfigError(f"layout '{layout}': there are {', '.join(ZONE_LAYOUTS)}")
    if weight not in _WEIGHTS:
        raise ConfigError(f"weight '{weight}': there are {', '.join(_WEIGHTS)}")
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
        raise ConfigError("density: must be rows of x, y and weight, finite, no weight below 0")
    return density[density[:, 2] > 0.0]


def _grid_shape(bounds: Bounds, count: int, *, strips: bool) -> tuple[int, int]:
    """(rows, columns): cells as square as can be, strips across the longer side."""
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
            f"sides must be at least {MIN_SIDE_M:g} m: use fewer zones or another layout"
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
    """The `parts` + 1 sides along an axis."""
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
            f"more zones than the map can hold: {count} are left for x {rect[0]:.2f} to "
            f"{rect[2]:.2f}, y {rect[1]:.2f} to {rect[3]:.2f}, where no cut leaves a part of what "
            f"is shared out and {MIN_SIDE_M:g} m on both sides: use fewer zones"
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
    """Where a cut may lie, where it leaves `share` below it, where it may lie; None: nowhere."""
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
    """The coordinate below which a share of all lies, as a function of the share."""
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
    area: _Area,  # whose junctions are kept whole
    rect: Rect,  # what is cut
    axis: int,  # 0: between left and right, 1: between below and above
    # where it may begin, where the cut is wanted, where it may end
    window: tuple[float, float, float],
) -> float:
    """The cut within a window that divides the fewest junctions; of several the nearest."""
    first, wanted, last = window
    across = 1 - axis
    boxes = area.junctions
    met = (boxes[:, across] < rect[across + 2]) & (boxes[:, across + 2] >= rect[across])
    lows, highs = boxes[met, axis], boxes[met, axis + 2]
    edges = np.unique(np.clip(np.concatenate([lows, highs, [first, last]]), first, last))
    # Between two edges all cuts divide the same junctions.
    clear = np.minimum(_CLEAR_M, np.diff(edges) / 2.0)
    quiet = np.clip(wanted, edges[:-1] + clear, edges[1:] - clear)
    cuts: list[float] = [wanted, *quiet.tolist()]

    def cost(cut: float) -> tuple[int, float]:
        return int(((lows < cut) & (cut <= highs)).sum()), abs(cut - wanted)

    return min(cuts, key=cost)
