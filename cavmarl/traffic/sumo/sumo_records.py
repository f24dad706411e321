"""What goes between a world and the process of its SUMO: fixed records, no objects."""

from __future__ import annotations

import numpy as np

# A vehicle of SUMO's, in its own conventions: the middle of the front bumper, degrees clockwise
# from north, the place on the lane in the lane's own length. Where SUMO moves no vehicles here,
# what follows `signals` is 0 but for `pos`.
SEEN = np.dtype(
    [
        ("number", np.int32),  # in the order in which they have come
        ("vtype", np.int32),  # VTYPE row
        ("lane", np.int32),  # LANE row of the front
        ("route", np.int32),  # number of its route; of a path, once it is known here
        ("at", np.int32),  # which edge of its route it is on
        ("signals", np.int32),  # SUMO's bits: 1 right, 2 left, 8 brake
        ("x", np.float64),  # m
        ("y", np.float64),
        ("z", np.float64),
        ("angle", np.float64),  # degrees
        ("speed", np.float64),  # m/s
        ("pos", np.float64),  # m, of the front
        ("lat", np.float64),  # m to the left of the lane's centre
    ]
)

# A vehicle of ours, in SUMO's conventions.
MOVED = np.dtype(
    [
        ("id", np.int64),  # VEHICLE["id"]
        ("x", np.float64),  # m, of the front
        ("y", np.float64),
        ("angle", np.float64),  # degrees
        ("edge", np.int32),  # EDGE row outside junctions, near it
        ("kind", np.int32),  # VTYPE row
    ]
)
