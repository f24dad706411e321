"""Positions of the lanes and junctions of a map, for partitioning."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.roads.network import RoadNetwork

Floats = NDArray[np.float64]

_SAMPLE_M = 2.0  # maximum distance of two adjacent samples on a lane


def lane_segments(network: RoadNetwork) -> Floats:
    """Return the straight segments (n, 4) of all lanes outside of junctions: x, y, x, y in m."""
    lanes = network.lanes[~network.lanes["internal"]]
    steps = lanes["num_points"] - 1
    before = np.repeat(np.cumsum(steps) - steps, steps)
    first = np.repeat(lanes["first_point"], steps) + np.arange(steps.sum()) - before
    x, y = network.points["x"], network.points["y"]
    return np.stack([x[first], y[first], x[first + 1], y[first + 1]], axis=1)


def lane_samples(network: RoadNetwork) -> Floats:
    """Return samples (n, 3) along all lanes: x and y in m, and the length that each represents."""
    segments = lane_segments(network)
    lengths = hypot_all(*(segments[:, 2:] - segments[:, :2]).T)
    pieces = np.maximum(np.ceil(lengths / _SAMPLE_M), 1.0).astype(np.int64)
    which = np.repeat(np.arange(len(segments)), pieces)
    rank = np.arange(len(which)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = ((rank + 0.5) / pieces[which])[:, None]
    places = segments[which, :2] + share * (segments[which, 2:] - segments[which, :2])
    return np.column_stack([places, lengths[which] / pieces[which]])


def junction_boxes(network: RoadNetwork) -> Floats:
    """Return bounding boxes (n, 4) of the junctions where lanes cross or merge.

    A box is min_x, min_y, max_x, max_y in metres, and includes the widths of the lanes. Boxes are
    in the order of the JUNCTION rows.
    """
    crossing = np.unique(network.links["junction"][network.links["num_conflicts"] > 0])
    inside = network.lanes[network.lanes["internal"]]
    junction = network.links["junction"][inside["link"]]
    boxes = np.full((len(network.junctions), 4), (np.inf, np.inf, -np.inf, -np.inf))
    half = 0.5 * inside["width_m"]
    for column, name in enumerate(("min_x", "min_y")):
        np.minimum.at(boxes[:, column], junction, inside[name] - half)
    for column, name in enumerate(("max_x", "max_y")):
        np.maximum.at(boxes[:, column + 2], junction, inside[name] + half)
    found = boxes[crossing]
    return np.asarray(found[np.isfinite(found).all(axis=1)])
