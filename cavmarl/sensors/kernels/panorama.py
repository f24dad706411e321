"""The surroundings of one vehicle in its own frame, for imaging sensors.

The frame has its origin at the vehicle's position on the road; x points ahead, y left, and z up,
perpendicular to the road under the vehicle. The frame turns with heading and pitch. In this frame,
the ground is the plane z = 0, bodies are upright prisms over oriented rectangles, and buildings are
walls on the ground. So a slope of constant gradient is rendered correctly, and the ground never
hides a body. As for every sensor, bodies more than `LEVEL_HEIGHT_M` above or below are not seen.

The result does not depend on a body's row or on the zone that owns it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.records import record
from cavmarl.roads.kernels.backdrop_pieces import Backdrop, gather_quads, gather_walls

NOTHING = 0  # the sky, or nothing in range
GROUND = 1  # off the roads
ROAD = 2  # lanes and junctions
LANE_LINE = 3  # edges of lanes, in the bird's-eye grid only
BUILDING = 4
CAR = 5
TRUCK = 6
BUS = 7
TRAM = 8
MOTORCYCLE = 9
BICYCLE = 10
PEDESTRIAN = 11

SEMANTIC_NAMES = (
    "nothing",
    "ground",
    "road",
    "lane line",
    "building",
    "car",
    "truck",
    "bus",
    "tram",
    "motorcycle",
    "bicycle",
    "pedestrian",
)
NUM_SEMANTICS = len(SEMANTIC_NAMES)

# Semantic class of SUMO's abstract vehicle classes; vehicles of similar shape share a class.
SEMANTIC_OF_CLASS = {
    "passenger": CAR,
    "taxi": CAR,
    "delivery": TRUCK,
    "emergency": TRUCK,
    "truck": TRUCK,
    "bus": BUS,
    "tram": TRAM,
    "motorcycle": MOTORCYCLE,
    "bicycle": BICYCLE,
    "pedestrian": PEDESTRIAN,
}


PRISM = record(
    ("id", np.int64),  # id of the vehicle or pedestrian
    ("semantic", np.int64),  # one of the classes above
    ("x", np.float64),  # centre, m
    ("y", np.float64),
    ("bottom", np.float64),  # z, m
    ("top", np.float64),
    ("cos", np.float64),  # cosine of the heading in the frame
    ("sin", np.float64),
    ("half_length", np.float64),  # m
    ("half_width", np.float64),
    ("radius", np.float64),  # half the diagonal, m
    ("speed", np.float64),  # m/s over the ground, along the heading
)


class Panorama(NamedTuple):
    """Memory for the surroundings of one vehicle; `gather` returns the number of filled rows."""

    prisms: NDArray[np.void]  # PRISM (C,)
    order: NDArray[np.int32]  # (C,) prisms by id
    walls: NDArray[np.void]  # WALL (num_walls,)
    roofs: NDArray[np.float64]  # (num_roofs, 4, 2) corners of buildings' convex parts, m
    roof_height: NDArray[np.float64]  # (num_roofs,) m
    strips: NDArray[np.float64]  # (num_strips, 4, 2) corners of pieces of lanes, m
    lined: NDArray[np.float64]  # (num_strips,) 1 if the strip's sides are lane lines, else 0


class Counts(NamedTuple):
    """The number of objects of each kind in a panorama."""

    prisms: int
    walls: int
    roofs: int
    strips: int


def make_panorama(backdrop: Backdrop, capacity: int) -> Panorama:
    """Allocate a panorama for a backdrop and `capacity` bodies."""
    return Panorama(
        np.zeros(capacity, PRISM),
        np.zeros(capacity, np.int32),
        np.zeros_like(backdrop.walls),
        np.zeros_like(backdrop.roofs),
        np.zeros_like(backdrop.roof_height),
        np.zeros_like(backdrop.strips),
        np.zeros_like(backdrop.lined),
    )


@kernel
def _fill_prism(
    prism: np.void, body: np.void, ego: np.void, axes: tuple[float, float, float, float]
) -> None:
    cos, sin, pitch_cos, pitch_sin = axes
    dx = body["x"] - ego["x"]
    dy = body["y"] - ego["y"]
    dz = body["z"] - ego["z"]
    ahead = dx * cos + dy * sin
    bottom = dz * pitch_cos - ahead * pitch_sin
    prism["id"] = body["id"]
    prism["x"] = ahead * pitch_cos + dz * pitch_sin
    prism["y"] = dy * cos - dx * sin
    prism["bottom"] = bottom
    prism["top"] = bottom + body["height"]
    prism["cos"] = body["cos"] * cos + body["sin"] * sin
    prism["sin"] = body["sin"] * cos - body["cos"] * sin
    prism["half_length"] = body["half_length"]
    prism["half_width"] = body["half_width"]
    prism["radius"] = body["radius"]
    prism["speed"] = body["speed"]


@kernel
def _gather_prisms(
    rows: NDArray[np.void],
    row: int,
    grid: Grid,
    semantics: NDArray[np.uint8],
    reach_m: float,
    out: NDArray[np.void],
) -> int:
    """Collect the bodies around a vehicle, in any order, and return their number.

    `row`: the observing vehicle, which does not see itself. `semantics`: (num_types,) class of each
    type of vehicle. `reach_m`: bodies farther away in the plane are left out. `out`: PRISM (C,),
    overwritten up to the returned number.
    """
    ego = rows[row]
    axes = (
        cosine(ego["heading"]),
        sine(ego["heading"]),
        cosine(ego["pitch"]),
        sine(ego["pitch"]),
    )
    far = reach_m + grid.largest[0]
    first_column, last_column = cell_columns(grid, ego["x"], far)
    first_row, last_row = cell_rows(grid, ego["y"], far)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            dx = body["x"] - ego["x"]
            dy = body["y"] - ego["y"]
            limit = reach_m + body["radius"]
            if (
                dx * dx + dy * dy < limit * limit
                and body["row"] != row
                and abs(body["z"] - ego["z"]) <= LEVEL_HEIGHT_M
            ):
                _fill_prism(out[found], body, ego, axes)
                out[found]["semantic"] = semantics[rows[body["row"]]["vtype"]]
                found += 1
    return found


@kernel
def _sort_by_id(prisms: NDArray[np.void], num: int, order: NDArray[np.int32]) -> None:
    """Write the indices of the first `num` prisms, sorted by id, to `order` (C,)."""
    for k in range(num):
        place = k
        while place > 0 and prisms[k]["id"] < prisms[order[place - 1]]["id"]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k


@kernel
def gather(
    rows: NDArray[np.void],
    row: int,
    grid: Grid,
    backdrop: Backdrop,
    reach_m: float,
    with_faces: bool,
    out: Panorama,
) -> Counts:
    """Collect the surroundings of a vehicle, in its frame.

    `row`: the observing vehicle, which does not see itself. `reach_m`: objects farther away in the
    plane are left out. `with_faces`: also collect roofs and strips, and sort bodies by id.
    """
    ego = rows[row]
    prisms = _gather_prisms(rows, row, grid, backdrop.semantics, reach_m, out.prisms)
    walls = roofs = strips = 0
    if backdrop.walls.size > 0:
        walls = gather_walls(ego, backdrop.walls, backdrop.wall_index, reach_m, out.walls)
    if with_faces:
        _sort_by_id(out.prisms, prisms, out.order)
        strips = gather_quads(
            ego, backdrop.strips, backdrop.lined, backdrop.strip_index, reach_m, out.strips,
            out.lined,
        )  # fmt: skip
        if backdrop.roof_height.size > 0:
            roofs = gather_quads(
                ego, backdrop.roofs, backdrop.roof_height, backdrop.roof_index, reach_m, out.roofs,
                out.roof_height,
            )  # fmt: skip
    return Counts(prisms, walls, roofs, strips)
