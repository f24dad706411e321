"""Arrows on the lanes before a junction: where each lane may go."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

Points = NDArray[np.float64]

BEFORE_END_M = 12.0  # from the arrow's foot to the stop line
MIN_LANE_M = 25.0
STROKE_M = 0.22
HEAD_M = 1.1
HEAD_WIDTH_M = 0.75
# Ahead and to the left of the arrow's foot, m: where branches begin and where their heads are.
FORK = (1.1, 0.0)
TIPS = {"s": (3.6, 0.0), "l": (1.9, 0.6), "r": (1.9, -0.6)}
BRANCHES = {"s": "s", "l": "l", "L": "l", "r": "r", "R": "r"}


def lane_arrows(network: RoadNetwork) -> Points:
    """Quadrilaterals (k, 4, 3) in metres, the parts of all arrows; on roads of several lanes."""
    lanes, links = network.lanes, network.links
    parts = [np.zeros((0, 4, 3))]
    wide = network.edges["num_lanes"][lanes["edge"]] > 1
    for lane in np.flatnonzero(wide & (lanes["num_links"] > 0) & (lanes["length_m"] > MIN_LANE_M)):
        row = lanes[lane]
        first = row["first_link"]
        codes = links["direction"][first : first + row["num_links"]]
        branches = {BRANCHES[chr(code)] for code in codes if chr(code) in BRANCHES}
        if not branches:
            continue
        foot, ahead = _place(network, row, row["length_m"] - BEFORE_END_M)
        turn = np.array([[ahead[0], ahead[1], 0.0], [-ahead[1], ahead[0], 0.0]])
        parts.append(foot + _arrow(branches) @ turn)
    return np.concatenate(parts)


def _place(network: RoadNetwork, lane: np.void, s: float) -> tuple[Points, Points]:
    points = network.points[lane["first_point"] : lane["first_point"] + lane["num_points"]]
    start = points[np.searchsorted(points["s"], s) - 1]
    ahead = np.array([start["cos"], start["sin"]])
    rest = s - start["s"]
    foot = [start["x"] + rest * ahead[0], start["y"] + rest * ahead[1], start["z"]]
    return np.array(foot), ahead


def _arrow(branches: set[str]) -> Points:
    """An arrow (k, 4, 2) in metres ahead of and to the left of its foot."""
    parts = [_stroke((0.0, 0.0), FORK)]
    for branch in sorted(branches):
        parts += [_stroke(FORK, TIPS[branch]), _head(FORK, TIPS[branch])]
    return np.array(parts)


def _stroke(start: tuple[float, float], end: tuple[float, float]) -> list[tuple[float, float]]:
    ahead, aside = _unit(start, end)
    half = STROKE_M / 2.0
    return [
        (x + sign * half * -aside, y + sign * half * ahead)
        for (x, y), sign in ((start, 1), (end, 1), (end, -1), (start, -1))
    ]


def _head(start: tuple[float, float], base: tuple[float, float]) -> list[tuple[float, float]]:
    ahead, aside = _unit(start, base)
    half = HEAD_WIDTH_M / 2.0
    left = base[0] - half * aside, base[1] + half * ahead
    right = base[0] + half * aside, base[1] - half * ahead
    tip = base[0] + HEAD_M * ahead, base[1] + HEAD_M * aside
    return [left, tip, tip, right]


def _unit(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    length = math.dist(start, end)
    return (end[0] - start[0]) / length, (end[1] - start[1]) / length
