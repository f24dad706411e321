"""The geometry of a map as plain arrays in metres: surfaces, markings, stop lines.

Shapes are computed once per network; nothing is drawn here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

BEFORE_END_M = 12.0  # distance from an arrow's foot to the stop line
MIN_LANE_M = 25.0
STROKE_M = 0.22
HEAD_M = 1.1
HEAD_WIDTH_M = 0.75
# Metres ahead and left of the arrow's foot: start of the branches, and base of their heads.
FORK = (1.1, 0.0)
TIPS = {"s": (3.6, 0.0), "l": (1.9, 0.6), "r": (1.9, -0.6)}
BRANCHES = {"s": "s", "l": "l", "L": "l", "r": "r", "R": "r"}


def lane_arrows(network: RoadNetwork) -> Points:
    """Return the parts of all arrows (k, 4, 3) in metres, on roads with several lanes."""
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
    """Return an arrow (k, 4, 2) in metres ahead and left of its foot."""
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


Points = NDArray[np.float64]

DASH_M = 3.0
DASH_PERIOD_M = 9.0
# A road that is higher than another one by this much is drawn over it.
LEVEL_M = 4.0
STOP_LINE_M = 0.7
# A hull is not filled if its area is above this multiple of the area of its paths, because it then
# also covers ground beside the roads.
MAX_HULL_SHARE = 1.2
MIN_HULL_M2 = 150.0  # added to that limit, so that smaller hulls are always filled
# SUMO's link directions from left to right: left, half left, straight, half right, right. A U-turn
# comes before them, or after them in left-hand traffic.
DIRECTIONS_FROM_LEFT = "lLsRr"
CAR_BIT = 1  # VEHICLE_CLASSES[0], passenger


@dataclass(frozen=True)
class Patch:
    """The interior of a junction: a convex polygon (n, 2)."""

    outline: Points
    level: int
    for_cars: bool


@dataclass(frozen=True)
class RoadShapes:
    """All shapes of a network, in metres."""

    starts: Points  # (n, 2) start of each straight piece of a lane
    ends: Points  # (n, 2) end of each piece
    half_widths: Points  # (n,) half width of each piece
    # (n,) whether a round joint is drawn at the piece's end: the road continues on the same level
    joined: NDArray[np.bool_]
    levels: NDArray[np.int64]  # (n,) level of each piece, from `level_of`
    for_cars: NDArray[np.bool_]  # (n,) whether the lane is open to cars
    junctions: tuple[Patch, ...]  # interiors of junctions
    junction_boxes: Points  # (num junctions, 2, 2) lower left and upper right corners
    dashes: Points  # (k, 2, 3) ends of lines between lanes of one direction
    centre_lines: Points  # (k, 2, 3) lines between opposite directions
    arrows: Points  # (k, 4, 3) arrows on lanes before junctions
    stop_lines: Points  # (num_links, 4, 2) the link's part of its lane's stop line
    roofs: Points  # (k, 4, 2) parts of buildings


def road_shapes(network: RoadNetwork) -> RoadShapes:
    lanes = network.lanes
    counts = lanes["num_points"]
    lane_of_point = np.repeat(np.arange(len(lanes)), counts)
    order = np.repeat(lanes["first_point"] - (np.cumsum(counts) - counts), counts)
    points = network.points[order + np.arange(len(order))]
    plane = np.stack([points["x"], points["y"]], axis=1)
    pieces = np.flatnonzero(lane_of_point[:-1] == lane_of_point[1:])
    lane = lane_of_point[pieces]
    last = np.append(lane[1:] != lane[:-1], True)
    half_widths = lanes["width_m"][lane] / 2.0
    levels = level_of(points["z"][pieces])
    same_after = np.append(levels[1:] == levels[:-1], False)
    same_before = np.roll(same_after & ~last, 1)
    is_long = np.hypot(*(plane[pieces + 1] - plane[pieces]).T) >= half_widths
    for_cars = (lanes["permissions"] & CAR_BIT).astype(bool)
    patches = _junction_patches(network, for_cars)
    boxes = [(patch.outline.min(axis=0), patch.outline.max(axis=0)) for patch in patches]
    return RoadShapes(
        starts=plane[pieces],
        ends=plane[pieces + 1],
        half_widths=half_widths,
        joined=np.where(last, _goes_on_level(network)[lane], same_after) & (same_before | is_long),
        levels=levels,
        for_cars=for_cars[lane],
        junctions=patches,
        junction_boxes=np.array(boxes).reshape(-1, 2, 2),
        dashes=_dashes(network),
        centre_lines=_centre_lines(network),
        arrows=lane_arrows(network),
        stop_lines=_stop_lines(network),
        roofs=network.roofs,
    )


def level_of(z: Points) -> NDArray[np.int64]:
    """Return the level of each height in m; of two crossing roads, the one above is the bridge."""
    return np.asarray(np.round(z / LEVEL_M).astype(np.int64))


def offset_polyline(polyline: Points, offset_m: float) -> Points:
    """Shift a polyline (n, 2) left by `offset_m`; corners are mitred up to twice that distance."""
    steps = np.diff(polyline, axis=0)
    normals = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
    normals /= np.hypot(normals[:, 0], normals[:, 1])[:, None]
    before = np.vstack([normals[:1], normals])
    after = np.vstack([normals, normals[-1:]])
    cosine = (before * after).sum(axis=1)
    return np.asarray(
        polyline + offset_m * (before + after) / np.maximum(1.0 + cosine, 0.5)[:, None]
    )


def convex_hull(points: Points) -> Points:
    """Return the convex hull (k, 2) of points (n, 2), by Andrew's monotone chain (1979)."""
    unique = sorted(set(map(tuple, points.tolist())))
    if len(unique) < 3:
        return np.array(unique)
    chains = []
    for sequence in (unique, unique[::-1]):
        chain: list[tuple[float, ...]] = []
        for point in sequence:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0.0:
                chain.pop()
            chain.append(point)
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1])


def _turn(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _side(network: RoadNetwork, lane: int | np.integer[Any], offset_m: float) -> Points:
    """Return the line `offset_m` to the left of a lane's centre, (n, 3)."""
    centre = network.lane_polyline(int(lane))
    return np.column_stack([offset_polyline(centre[:, :2], offset_m), centre[:, 2]])


def _goes_on_level(network: RoadNetwork) -> NDArray[np.bool_]:
    """Return whether a road continues from the end of each lane on the same level."""
    lanes, z = network.lanes, network.points["z"]
    link = np.where(lanes["num_links"] > 0, lanes["first_link"], -1)
    after = np.where(link >= 0, network.links["next_lane"][link], lanes["successor"])
    last_piece = lanes["first_point"] + lanes["num_points"] - 2
    same = level_of(z[last_piece]) == level_of(z[lanes["first_point"][after]])
    return np.asarray((after >= 0) & same)


def _junction_patches(network: RoadNetwork, for_cars: NDArray[np.bool_]) -> tuple[Patch, ...]:
    """Return the hull of the lane ends at each junction and of the paths between them."""
    corners: dict[tuple[int, bool], list[Points]] = {}
    areas: dict[tuple[int, bool], float] = {}
    lanes, links = network.lanes, network.links
    for link, mouth in zip(links, _mouths(network), strict=True):
        key = int(link["junction"]), bool(for_cars[link["from_lane"]])
        corners.setdefault(key, []).append(mouth)
    for lane in np.flatnonzero(lanes["internal"] & (lanes["link"] >= 0)):
        link = links[lanes[lane]["link"]]
        half = lanes[lane]["width_m"] / 2.0
        key = int(link["junction"]), bool(for_cars[link["from_lane"]])
        corners[key].extend(_side(network, lane, side)[:, :2] for side in (half, -half))
        areas[key] = areas.get(key, 0.0) + 2.0 * half * float(lanes[lane]["length_m"])
    patches = []
    for (junction, cars), shapes in corners.items():
        outline = convex_hull(np.vstack(shapes))
        room = MAX_HULL_SHARE * areas.get((junction, cars), 0.0) + MIN_HULL_M2
        if len(outline) > 2 and _area(outline) <= room:
            level = int(level_of(network.junctions["z"][junction]))
            patches.append(Patch(outline, level, cars))
    return tuple(patches)


def _mouths(network: RoadNetwork) -> Points:
    """Return both sides of the ends of each link, (num_links, 4, 2)."""
    lanes, links = network.lanes, network.links
    start, reached = lanes[links["from_lane"]], lanes[links["to_lane"]]
    last = network.points[start["first_point"] + start["num_points"] - 1]
    first = network.points[reached["first_point"]]
    corners = []
    for point, lane in ((last, start), (first, reached)):
        place = np.stack([point["x"], point["y"]], axis=1)
        left = np.stack([-point["sin"], point["cos"]], axis=1) * (lane["width_m"] / 2.0)[:, None]
        corners += [place + left, place - left]
    return np.stack(corners, axis=1)


def _area(polygon: Points) -> float:
    """Return the area of a polygon (n, 2), by the shoelace formula."""
    x, y = polygon[:, 0], polygon[:, 1]
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2.0


def _dashes(network: RoadNetwork) -> Points:
    dashes = [np.zeros((0, 2, 3))]
    lanes = network.lanes
    for lane in np.flatnonzero((lanes["left"] >= 0) & ~lanes["internal"]):
        line = _side(network, lane, lanes[lane]["width_m"] / 2.0)
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
        begins = np.arange(DASH_PERIOD_M / 3.0, s[-1] - DASH_M, DASH_PERIOD_M)
        at = np.stack([begins, begins + DASH_M], axis=1)
        dashes.append(np.stack([np.interp(at, s, line[:, k]) for k in range(3)], axis=2))
    return np.concatenate(dashes)


def _centre_lines(network: RoadNetwork) -> Points:
    """Return one line per pair of opposite roads, along the inner side."""
    edges, lanes = network.edges, network.lanes
    roads = edges[~edges["internal"]]
    ways = set(zip(roads["from_junction"].tolist(), roads["to_junction"].tolist(), strict=True))
    pieces = [np.zeros((0, 2, 3))]
    for edge in roads:
        inner = edge["first_lane"] + edge["num_lanes"] - 1
        way = int(edge["from_junction"]), int(edge["to_junction"])
        if way < way[::-1] and way[::-1] in ways and lanes[inner]["permissions"] & CAR_BIT:
            half = lanes[inner]["width_m"] / 2.0
            line = _side(network, inner, -half if network.left_hand else half)
            pieces.append(np.stack([line[:-1], line[1:]], axis=1))
    return np.concatenate(pieces)


def _stop_lines(network: RoadNetwork) -> Points:
    """Return each link's part of its lane's stop line; the part of the left turn is at the left."""
    links, lanes = network.links, network.lanes
    order = DIRECTIONS_FROM_LEFT + "t" if network.left_hand else "t" + DIRECTIONS_FROM_LEFT
    quads = np.zeros((len(links), 4, 2))
    for lane in np.flatnonzero(lanes["num_links"] > 0):
        row = lanes[lane]
        rows = np.arange(row["first_link"], row["first_link"] + row["num_links"])
        rank = [order.find(chr(links[link]["direction"])) for link in rows]
        end = network.points[row["first_point"] + row["num_points"] - 1]
        forward = np.array([end["cos"], end["sin"]])
        left = np.array([-end["sin"], end["cos"]])
        corner = np.array([end["x"], end["y"]]) + left * (row["width_m"] / 2.0 - 0.1)
        share = (row["width_m"] - 0.2) / len(rows)
        for place, link in enumerate(rows[np.argsort(rank, kind="stable")]):
            near = corner - left * share * place
            far = near - left * share
            back = -forward * STOP_LINE_M
            quads[link] = near, far, far + back, near + back
    return quads
