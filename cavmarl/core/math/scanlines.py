"""Convex areas of an image, row by row: the columns of a row that are inside of all edges.

An edge has three numbers (constant, by column, by row): a point is inside if
constant + by column · u + by row · v >= 0. So an area given by its edges needs no corners, and may
be unbounded or partly behind a camera (Olano, Greer: "Triangle scan conversion using 2D homogeneous
coordinates", Graphics Hardware 1997). Column i of row j has its centre at (u, v) =
(i + 0.5, j + 0.5), in pixels from the upper left corner.

Areas that share an edge leave no gap: they compute the same position of the edge, bit for bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def row_span(
    edges: NDArray[np.float64],  # (E, 4) constant, by column, by row, and 1 / by column
    num: int,  # number of valid edges
    row: int,  # row of the image
    width: int,  # columns of the image
) -> tuple[int, int]:
    """Return the columns [first, last) of one row whose centres are inside."""
    low = 0.5
    high = width - 0.5
    v = row + 0.5
    for k in range(num):
        value = edges[k, 0] + edges[k, 2] * v
        if edges[k, 1] > 0.0:
            low = max(low, -value * edges[k, 3])
        elif edges[k, 1] < 0.0:
            high = min(high, -value * edges[k, 3])
        elif value < 0.0:
            return 0, 0
    if not low <= high:
        return 0, 0
    return math.ceil(low - 0.5), math.floor(high - 0.5) + 1
