"""Find the nearest vehicles by a search over all vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def k_nearest(
    rows: NDArray[np.void], row: int, x: float, y: float, z: float, radius_m: float, k: int
) -> list[tuple[float, int]]:
    """Return (squared distance, row) of the k nearest vehicles on the level; ids break ties."""
    found = [
        (_square(other["x"] - x) + _square(other["y"] - y), other["id"], i)
        for i, other in enumerate(rows)
        if i != row and abs(other["z"] - z) <= 4.0
    ]
    near = sorted(entry for entry in found if entry[0] <= radius_m * radius_m)
    return [(float(squared), i) for squared, _, i in near[:k]]


def _square(value: float) -> float:
    # `value ** 2` calls pow, which may differ in the last bit.
    return value * value
