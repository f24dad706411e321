"""A map as one compact binary message, which the page draws below the vehicles.

The message consists of a byte `MAP_MESSAGE`, three bytes of padding, the length of a JSON head as
uint32, the head padded with spaces to a multiple of four, and the sections that the head lists.
Sections are little-endian, in metres from the origin in the head. Names in the head are data; the
page shows them as text only.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.render.canvas import SIGNALS, ZONES
from cavmarl.render.shapes import Points, RoadShapes, level_of, road_shapes
from cavmarl.roads.network import RoadNetwork

MAP_MESSAGE = 1

# Kinds of surface; the page has a colour for each.
ROAD, PATH_SURFACE, KERB_SURFACE, MARK, MIDDLE_LINE, BUILDING = range(6)

LINE_M = 0.2  # width of lines on the road
WAITING_LINE_M = 0.35
LEVELS = 30  # levels are clipped to [-30, 30]
RULED_STATES = b"sw"  # states of links with a mandatory stop

# A straight piece with a flat start; its end is round if it is joined to the next piece.
PIECE = np.dtype(
    [
        ("start", "<f4", 2),
        ("end", "<f4", 2),
        ("half_width", "<f4"),
        ("style", "u1"),
        ("level", "i1"),
        ("joined", "u1"),
        ("unused", "u1"),
    ]
)
CORNER = np.dtype([("place", "<f4", 2), ("style", "u1"), ("level", "i1"), ("unused", "<u2")])
# One link's part of a stop line: two corners, and the direction back along the lane.
STOP_LINE = np.dtype(
    [
        ("near", "<f4", 2),
        ("far", "<f4", 2),
        ("back", "<f4", 2),
        ("signal", "<u4"),
        ("letter", "<u2"),
        ("level", "<i2"),
    ]
)


def map_origin(network: RoadNetwork) -> NDArray[np.float64]:
    """Return the origin (2,) of positions in all messages about a map, in m."""
    origin: NDArray[np.float64] = np.floor(np.array(network.extent_m[:2]))
    return origin


def map_message(network: RoadNetwork) -> bytes:
    """Encode a map for the page.

    Sections: `roads` and `lines` (PIECE), `surfaces`, `marks` and `buildings` (CORNER, three per
    triangle), `stop_lines` (STOP_LINE), `stop_links` (uint32, the link of each stop line),
    `phase_states` (uint8 positions in `SIGNAL_STATES`) and `phase_first` (uint32). A stop line
    shows `phase_states[phase_first[phase] + letter]`. If a program has set another state for its
    link, the frame contains this state, and the stop line shows it.
    """
    shapes = road_shapes(network)
    origin = map_origin(network)
    marks, surfaces = _surfaces(network, shapes, origin)
    sections = {
        "roads": np.concatenate([_roads(shapes, origin), _outlines(shapes, origin)]),
        "lines": np.concatenate(
            [
                _lines(shapes.dashes, MARK, origin),
                _lines(shapes.centre_lines, MIDDLE_LINE, origin),
            ]
        ),
        "surfaces": surfaces,
        "marks": marks,
        "buildings": _quads(network.roofs, BUILDING, np.zeros(len(network.roofs)), origin),
        "stop_lines": _stop_lines(network, shapes, origin),
        "stop_links": np.flatnonzero(network.links["signal"] >= 0).astype("<u4"),
        "phase_first": network.phases["first_state"].astype("<u4"),
        "phase_states": network.phase_states.astype("u1"),
    }
    min_x, min_y, max_x, max_y = network.extent_m
    head = {
        "name": network.name,
        "origin": origin.tolist(),
        "extent": [min_x - origin[0], min_y - origin[1], max_x - origin[0], max_y - origin[1]],
        "left_hand": network.left_hand,
        "signals": len(network.signals),
        "signal_colors": SIGNALS,
        "zone_colors": ZONES,
    }
    return pack(head, sections)


def pack(head: dict[str, Any], sections: dict[str, NDArray[Any]]) -> bytes:
    """Encode a message from a head and arrays; each array begins at a multiple of four bytes."""
    places, blocks, at = {}, [], 0
    for name, rows in sections.items():
        block = rows.tobytes()
        places[name] = [at, len(rows)]
        blocks.append(block + bytes(-len(block) % 4))
        at += len(blocks[-1])
    text = json.dumps({**head, "sections": places}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<BxxxI", MAP_MESSAGE, len(text)) + text + b"".join(blocks)


def unpack(message: bytes) -> tuple[dict[str, Any], memoryview]:
    """Return the head of a message of `pack`, and the bytes of its sections."""
    kind, length = struct.unpack_from("<BxxxI", message)
    if kind != MAP_MESSAGE:
        raise ValueError(f"message {kind}: not a map (expected {MAP_MESSAGE})")
    return json.loads(message[8 : 8 + length]), memoryview(message)[8 + length :]


def _clipped(levels: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.clip(levels, -LEVELS, LEVELS))


def _pieces(
    starts: Points, ends: Points, half_widths: Points | float, style: Any, levels: NDArray[Any]
) -> NDArray[np.void]:
    rows = np.zeros(len(starts), PIECE)
    rows["start"], rows["end"] = starts, ends
    rows["half_width"], rows["style"], rows["level"] = half_widths, style, _clipped(levels)
    return rows


def _roads(shapes: RoadShapes, origin: Points) -> NDArray[np.void]:
    styles = np.where(shapes.for_cars, ROAD, PATH_SURFACE)
    starts, ends = shapes.starts - origin, shapes.ends - origin
    rows = _pieces(starts, ends, shapes.half_widths, styles, shapes.levels)
    rows["joined"] = shapes.joined
    return rows


def _outlines(shapes: RoadShapes, origin: Points) -> NDArray[np.void]:
    """Return the kerbs around the insides of junctions."""
    parts = [np.zeros(0, PIECE)]
    for patch in shapes.junctions:
        corners = patch.outline - origin
        ends = np.roll(corners, -1, axis=0)
        levels = np.full(len(corners), patch.level)
        rows = _pieces(corners, ends, 0.0, KERB_SURFACE, levels)
        rows["joined"] = 1
        parts.append(rows)
    return np.concatenate(parts)


def _lines(pieces: Points, style: int, origin: Points) -> NDArray[np.void]:
    places = pieces[:, :, :2] - origin
    levels = level_of(pieces[:, 0, 2])
    return _pieces(places[:, 0], places[:, 1], LINE_M / 2.0, style, levels)


def _corners(places: Points, style: int, level: Any) -> NDArray[np.void]:
    rows = np.zeros(len(places), CORNER)
    rows["place"], rows["style"], rows["level"] = places, style, _clipped(np.asarray(level))
    return rows


def _quads(quads: Points, style: int, levels: NDArray[Any], origin: Points) -> NDArray[np.void]:
    """Return two triangles for each quadrilateral (n, 4, 2)."""
    places = (quads[:, [0, 1, 2, 0, 2, 3]] - origin).reshape(-1, 2)
    return _corners(places, style, np.repeat(levels, 6))


def _surfaces(
    network: RoadNetwork, shapes: RoadShapes, origin: Points
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return arrows and waiting lines, and the insides of junctions."""
    insides = [np.zeros(0, CORNER)]
    for patch in shapes.junctions:
        hull = patch.outline - origin
        fan = np.arange(1, len(hull) - 1)
        order = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1).ravel()
        style = ROAD if patch.for_cars else PATH_SURFACE
        insides.append(_corners(hull[order], style, patch.level))
    arrows = shapes.arrows
    marks = [_quads(arrows[:, :, :2], MARK, level_of(arrows[:, 0, 2]), origin)]
    links = network.links
    waiting = np.isin(links["state"], list(RULED_STATES)) & (links["signal"] < 0)
    lines = shapes.stop_lines[waiting].copy()
    depth = np.hypot(*(lines[:, 3] - lines[:, 0]).T)[:, None]
    share = WAITING_LINE_M / np.maximum(depth, WAITING_LINE_M)
    lines[:, 2] = lines[:, 1] + (lines[:, 2] - lines[:, 1]) * share
    lines[:, 3] = lines[:, 0] + (lines[:, 3] - lines[:, 0]) * share
    levels = _levels_of_ends(network)[links["from_lane"][waiting]]
    marks.append(_quads(lines, MARK, levels, origin))
    return np.concatenate(marks), np.concatenate(insides)


def _levels_of_ends(network: RoadNetwork) -> NDArray[np.int64]:
    """Return the level of each lane's end."""
    last = network.lanes["first_point"] + network.lanes["num_points"] - 1
    return level_of(network.points["z"][last])


def _stop_lines(network: RoadNetwork, shapes: RoadShapes, origin: Points) -> NDArray[np.void]:
    signalled = np.flatnonzero(network.links["signal"] >= 0)
    links = network.links[signalled]
    quads = shapes.stop_lines[signalled]
    rows = np.zeros(len(links), STOP_LINE)
    rows["near"], rows["far"] = quads[:, 0] - origin, quads[:, 1] - origin
    rows["back"] = quads[:, 3] - quads[:, 0]
    rows["signal"], rows["letter"] = links["signal"], links["signal_index"]
    rows["level"] = _clipped(_levels_of_ends(network)[links["from_lane"]])
    return rows
