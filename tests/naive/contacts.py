"""Find contacts from the common area of each pair of vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.naive.geometry import box_corners, common_area


def find_contacts(rows: NDArray[np.void], margin: float = 0.0) -> list[int]:
    """Return the smallest id that each row touches, or -1; boxes grow by `margin` per side."""
    corners = [
        box_corners(
            v["x"], v["y"], v["heading"], 0.5 * v["length"] + margin, 0.5 * v["width"] + margin
        )
        for v in rows
    ]
    hits = []
    for i, one in enumerate(rows):
        touching = [
            int(other["id"])
            for j, other in enumerate(rows)
            if i != j
            and abs(one["z"] - other["z"]) < (one["height"] + other["height"]) / 2
            and common_area(corners[i], corners[j]) > 0.0
        ]
        hits.append(min(touching, default=-1))
    return hits
