"""The navigation mesh of walkers: where the client's walkers may walk.

The roads of cavmarl have no sidewalks. The mesh therefore has a strip along the outer side of
each road, a corner between two strips at a junction, and a crosswalk before each junction. The
client reads the mesh with Detour, as one tile. Detour's frame is (x, z, y) of the client's frame.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import CARS, RoadNetwork

GAP_M = 0.3  # gap between a road and its strip
WIDTH_M = 2.0  # width of a strip
CROSSWALK_M = 3.0
_STEP_M = 5.0  # length of a piece of a strip
_FARTHEST_M = 60.0  # a longer corner is left out
_LEAST_AREA_M2 = 0.05
_MOST_VERTICES = 60_000  # limit of a tile, because indices have 16 bits

# Area types and polygon flags of Detour, with the numbers that the client gives them.
_SIDEWALK, _CROSSWALK = (1, 0x02), (2, 0x04)

_FILE_HEAD = struct.Struct("<iii3fffii")
_TILE_HEAD = struct.Struct("<Ii")
_MESH_HEAD = struct.Struct("<iiiiiIiiiiiiiii3f3f3ff")
_FILE_MAGIC = int.from_bytes(b"MSET", "big")
_MESH_MAGIC = int.from_bytes(b"DNAV", "big")
_FILE_VERSION, _MESH_VERSION = 1, 7
_LINK_BYTES = 12
_BODY_M = (1.8, 0.3, 0.4)  # height, radius and climb of a walker

_POLYGON = np.dtype(
    [
        ("first_link", "<u4"),
        ("vertices", "<u2", 6),
        ("neighbours", "<u2", 6),
        ("flags", "<u2"),
        ("num_vertices", "u1"),
        ("area", "u1"),
    ]
)
_DETAIL = np.dtype(
    [
        ("first_vertex", "<u4"),
        ("first_triangle", "<u4"),
        ("num_vertices", "u1"),
        ("num_triangles", "u1"),
        ("padding", "u1", 2),
    ]
)
# A quadrangle as two triangles, four bytes each: three of its corners, and flags of the edges that
# are edges of the quadrangle.
_TRIANGLES = bytes((0, 1, 2, 1 | 4, 0, 2, 3, 4 | 16))


class NavigationMesh(NamedTuple):
    """A mesh as a file. `name` changes with the content, because clients cache files by name."""

    name: str
    content: bytes


class _Strip(NamedTuple):
    """The strip beside a road: vertices along it, and its directions at both ends."""

    inner: NDArray[np.intp]  # (n,) on the side of the road
    outer: NDArray[np.intp]
    start_rad: float
    end_rad: float


def make_navigation_mesh(network: RoadNetwork, name: str) -> NavigationMesh | None:
    """Return the navigation mesh of a map; None: the map has no roads, or is too large."""
    vertices, quadrangles, areas = mesh_shapes(network)
    if not len(quadrangles) or len(vertices) > _MOST_VERTICES:
        return None
    content = _encode(vertices, quadrangles, areas)
    digest = hashlib.sha256(content).hexdigest()[:12]
    return NavigationMesh(f"Cavmarl/{name}-{digest}.bin", content)


def mesh_shapes(
    network: RoadNetwork,
) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Return vertices (n, 3) in Detour's frame, quadrangles (m, 4), and areas and flags (m, 2)."""
    places: list[NDArray[np.float64]] = []
    strips: dict[int, _Strip] = {}
    corners: list[tuple[tuple[int, ...], tuple[int, int]]] = []
    side = -1.0 if network.left_hand else 1.0
    total_m = float(network.edges["length_m"][~network.edges["internal"]].sum())
    step_m = max(_STEP_M, 4.0 * total_m / _MOST_VERTICES)
    count = 0
    for edge, row in enumerate(network.edges):
        first = int(row["first_lane"])
        lanes = network.lanes[first : first + int(row["num_lanes"])]
        if row["internal"] or not (lanes["permissions"] & CARS).any():
            continue
        line, inner, outer = _beside(network, first, side, step_m)
        number = len(line)
        places += [inner, outer]
        indices = np.arange(count, count + number)
        strips[edge] = _Strip(indices, indices + number, line[0, 3], line[-1, 3])
        count += 2 * number
        for k in range(number - 1):
            a, b = count - 2 * number + k, count - number + k
            corners.append(((a, b, b + 1, a + 1), _SIDEWALK))
    if not places:
        return np.zeros((0, 3), np.float32), np.zeros((0, 4), np.intp), np.zeros((0, 2), np.intp)
    points = np.concatenate(places)
    corners += _connections(network, strips, points, side)
    vertices = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1).astype(np.float32)
    quadrangles, is_valid = _oriented(vertices, np.array([shape for shape, _ in corners], np.intp))
    areas = np.array([area for _, area in corners], np.intp)
    return vertices, quadrangles[is_valid], areas[is_valid]


def _beside(
    network: RoadNetwork, lane: int, side: float, step_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return x, y, z and heading along a lane, and the edges (n, 3) of the strip beside it."""
    length_m = float(network.lanes["length_m"][lane])
    end_m = min(CROSSWALK_M, length_m / 3.0)
    middle = np.linspace(end_m, length_m - end_m, 1 + max(1, math.ceil(length_m / step_m)))
    line = []
    for s in (0.0, *middle.tolist(), length_m):
        x, y, z, cos, sin, _ = network.pose_on(lane, s)
        line.append((x, y, z, math.atan2(sin, cos)))
    found = np.array(line)
    to_side = side * np.stack([np.sin(found[:, 3]), -np.cos(found[:, 3])], axis=1)
    half_m = 0.5 * float(network.lanes["width_m"][lane])
    edges = []
    for off_m in (half_m + GAP_M, half_m + GAP_M + WIDTH_M):
        edge = found[:, :3].copy()
        edge[:, :2] += off_m * to_side
        edges.append(edge)
    return found, edges[0], edges[1]


def _connections(
    network: RoadNetwork, strips: dict[int, _Strip], points: NDArray[np.float64], side: float
) -> Iterator[tuple[tuple[int, ...], tuple[int, int]]]:
    """Yield the corners that join strips, and the crosswalks: four vertices, area and flags."""
    edges = network.edges
    leaving: dict[int, list[int]] = {}
    neighbours: dict[int, set[int]] = {}
    for edge in strips:
        start, end = int(edges["from_junction"][edge]), int(edges["to_junction"][edge])
        leaving.setdefault(start, []).append(edge)
        neighbours.setdefault(start, set()).add(end)
        neighbours.setdefault(end, set()).add(start)
    for edge, strip in strips.items():
        start, junction = int(edges["from_junction"][edge]), int(edges["to_junction"][edge])
        turns = []
        for other in leaving.get(junction, []):
            then = strips[other]
            if int(edges["to_junction"][other]) == start:
                if len(neighbours[junction]) > 2:
                    across = strip.inner[-2], strip.inner[-1], then.inner[0], then.inner[1]
                    yield tuple(map(int, across)), _CROSSWALK
                continue
            turn = (strip.end_rad - then.start_rad + math.pi) % (2.0 * math.pi) - math.pi
            turns.append((side * turn, then))
        if turns:
            then = max(turns, key=lambda one: one[0])[1]
            apart = points[strip.inner[-1]] - points[then.inner[0]]
            if math.hypot(*apart[:2]) < _FARTHEST_M:
                corner = strip.inner[-1], strip.outer[-1], then.outer[0], then.inner[0]
                yield tuple(map(int, corner)), _SIDEWALK


def _oriented(
    vertices: NDArray[np.float32], quadrangles: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return quadrangles (m, 4) in Detour's winding order, and whether each is convex."""
    corners = vertices[quadrangles][:, :, [0, 2]].astype(np.float64)
    before = corners - np.roll(corners, 1, axis=1)
    after = np.roll(before, -1, axis=1)
    turns = before[..., 1] * after[..., 0] - before[..., 0] * after[..., 1]
    least, most = turns.min(axis=1), turns.max(axis=1)
    found = quadrangles.copy()
    found[most < 0.0] = found[most < 0.0, ::-1]
    return found, (least > _LEAST_AREA_M2) | (most < -_LEAST_AREA_M2)


def _encode(
    vertices: NDArray[np.float32], quadrangles: NDArray[np.intp], areas: NDArray[np.intp]
) -> bytes:
    """Return the file of a mesh with one tile."""
    number = len(quadrangles)
    polygons = np.zeros(number, _POLYGON)
    polygons["vertices"][:, :4] = quadrangles
    polygons["num_vertices"] = 4
    polygons["area"], polygons["flags"] = areas.T
    sides: dict[tuple[int, int], tuple[int, int]] = {}
    for polygon, shape in enumerate(quadrangles.tolist()):
        for k in range(4):
            ends = shape[k], shape[(k + 1) % 4]
            key = min(ends), max(ends)
            other = sides.pop(key, None)
            if other is None:
                sides[key] = polygon, k
                continue
            polygons["neighbours"][polygon, k] = other[0] + 1
            polygons["neighbours"][other] = polygon + 1
    details = np.zeros(number, _DETAIL)
    details["first_triangle"] = 2 * np.arange(number)
    details["num_triangles"] = 2
    low, high = vertices.min(axis=0) - 1.0, vertices.max(axis=0) + 1.0
    num_links = 4 * number
    head = _MESH_HEAD.pack(
        _MESH_MAGIC, _MESH_VERSION, 0, 0, 0, 0, number, len(vertices), num_links, number, 0,
        2 * number, 0, 0, number, *_BODY_M, *low.tolist(), *high.tolist(), 0.0,
    )  # fmt: skip
    tile = b"".join(
        (
            head,
            vertices.tobytes(),
            polygons.tobytes(),
            bytes(num_links * _LINK_BYTES),
            details.tobytes(),
            _TRIANGLES * number,
        )
    )
    bits = max(number - 1, 1).bit_length()
    size = (high - low).tolist()
    whole = _FILE_HEAD.pack(
        _FILE_MAGIC, _FILE_VERSION, 1, *low.tolist(), size[0], size[2], 1, 1 << bits
    )
    first_tile = 1 << bits  # salt 1, tile 0, polygon 0
    return whole + _TILE_HEAD.pack(first_tile, len(tile)) + tile
