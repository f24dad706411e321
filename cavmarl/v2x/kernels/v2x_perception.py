"""Which vehicles a station sees, to tell others of them: what a CPM is made of."""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.math.neighbors import nearest_bodies
from cavmarl.core.math.walls import Walls, is_cut
from cavmarl.v2x.kernels.v2x_records import MAX_NEAR, V2xScratch


@kernel
def _stands_between(body: np.void, x: float, y: float, cos: float, sin: float, far: float) -> bool:
    """Whether a body stands on the line of length `far` from (x, y) in direction (cos, sin)."""
    dx = body["x"] - x
    dy = body["y"] - y
    along = dx * cos + dy * sin
    if along <= 0.0 or along >= far:
        return False
    across = abs(dy * cos - dx * sin)
    turned_cos = body["cos"] * cos + body["sin"] * sin
    turned_sin = body["sin"] * cos - body["cos"] * sin
    half = body["half_length"] * abs(turned_sin) + body["half_width"] * abs(turned_cos)
    return bool(across < half)


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
    """The nearest vehicles whose centres a station sees, in the plane.

    One is hidden if the body of a nearer one or a wall stands on the straight line to its centre.

    Args:
        scratch: `bodies` filled; `seen` gets rows of `everybody`, nearest first.
        own: row of the station itself; -1: it is no vehicle.
        x: m, its place.
        y: likewise.
        z: likewise; vehicles on another level are not seen.
        range_m: how far it sees.
        most: how many at most.
        walls: of buildings.
        over_bodies: whether bodies do not hide others: it stands on a mast.

    Returns:
        how many.
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
                is_hidden = _stands_between(bodies[scratch.near[k]], x, y, cos, sin, far)
        if not is_hidden:
            scratch.seen[found] = body["row"]
            found += 1
    return found
