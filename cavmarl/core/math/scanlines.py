"""Convex areas of a picture, row by row: which columns of a row lie inside of all edges.

An edge is three numbers (constant, by column, by row): a point lies inside where
constant + by column · u + by row · v >= 0. So an area given by its edges needs no corners, and may
be unbounded or lie partly behind a camera (Olano, Greer: "Triangle scan conversion using 2D
homogeneous coordinates", Graphics Hardware 1997). Column i of row j has its centre at
(u, v) = (i + 0.5, j + 0.5), in pixels from the upper left corner.

Areas that share an edge leave no gap: they find the same place of it, bit by bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def row_span(
    edges: NDArray[np.float64],  # (E, 4) constant, by column, by row, and one over by column
    num: int,  # how many of them count
    row: int,  # row of the picture
    width: int,  # columns of the picture
) -> tuple[int, int]:
    """The columns [first, last) of one row whose centres lie inside."""
    low = 0.5
    high = width - 0.5
    v = row + 0.5
    for k in range(num):
        there = edges[k, 0] + edges[k, 2] * v
        if edges[k, 1] > 0.0:
            low = max(low, -there * edges[k, 3])
        elif edges[k, 1] < 0.0:
            high = min(high, -there * edges[k, 3])
        elif there < 0.0:
            return 0, 0
    if not low <= high:
        return 0, 0
    return math.ceil(low - 0.5), math.floor(high - 0.5) + 1
