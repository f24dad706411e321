"""The vehicles that a station sees and reports to others in a CPM."""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.neighbors import nearest_bodies
from cavmarl.core.math.walls import Walls, behind_body, is_cut
from cavmarl.v2x.kernels.v2x_records import MAX_NEAR, V2xScratch


@kernel
def visible(
    scratch: V2xScratch,
    own: int,
    x: float,
    y: float,
    z: float,
    range_m: float,
    most: int,
    walls: Walls,
    over_bodies: bool,
) -> int:
    """Find the nearest vehicles whose centres a station sees, in the plane.

    A vehicle is hidden if a nearer body or a wall blocks the straight line to its centre.

    Args:
        scratch: `bodies` must be filled; `seen` gets rows of `vehicles`, nearest first.
        own: row of the station; -1: the station is not a vehicle.
        x: position of the station, m.
        y: position of the station, m.
        z: height of the station, m; vehicles on another level are not seen.
        range_m: sensing range.
        most: largest number of vehicles.
        walls: walls of buildings.
        over_bodies: whether the station sees over bodies, as from a mast.

    Returns:
        The number of vehicles.
    """
    bodies = scratch.bodies.bodies
    near = nearest_bodies(
        scratch.bodies, own, x, y, z, range_m, MAX_NEAR, scratch.near, scratch.near_squared
    )
    found = 0
    for i in range(near):
        if found == most:
            break
        body = bodies[scratch.near[i]]
        far = math.sqrt(scratch.near_squared[i])
        is_hidden = is_cut(walls, x, y, body["x"], body["y"])
        if not over_bodies and far > 0.0:
            cos = (body["x"] - x) / far
            sin = (body["y"] - y) / far
            for k in range(i):
                if is_hidden:
                    break
                is_hidden = behind_body(bodies[scratch.near[k]], x, y, cos, sin, far) > 0.0
        if not is_hidden:
            scratch.seen[found] = body["row"]
            found += 1
    return found
