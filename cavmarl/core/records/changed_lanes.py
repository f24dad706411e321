"""Lanes that differ from the map: the caller's changes, and the resulting table of lanes.

A change is a row of three numbers, see `LANE_CHANGE`; rows whose first number is 0 are unused.
Lanes without permissions on the map are contraflow lanes (`maps.contraflow`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Columns of LANE_CHANGE (N, 3), float64.
CHANGED = 0  # 1 + LANE row; 0: the row is unused
LIMIT_MPS = 1  # speed limit in m/s, at most the map's limit
# Bits of the vehicle classes that may not use the lane, see LANE["permissions"]. For contraflow
# lanes: classes that may use them.
CLASSES = 2


def wrong_changes(told: NDArray[np.float64], lanes: NDArray[np.void]) -> str:
    """Return what is wrong with changes of the caller; empty if nothing.

    `told`: (W, N, 3) LANE_CHANGE. `lanes`: LANE (L,) of the map.
    """
    if not np.isfinite(told).all() or (told < 0.0).any():
        return "a changed lane has a number that is negative or not finite"
    used = told[told[..., CHANGED] > 0.0]
    if (told[told[..., CHANGED] == 0.0] != 0.0).any():
        return "an unused row of changed lanes has a number other than 0"
    row = used[:, CHANGED] - 1.0
    if (row != np.floor(row)).any() or (row >= len(lanes)).any():
        return "a changed lane does not exist"
    lane = row.astype(np.int64)
    if (used[:, LIMIT_MPS] <= 0.0).any() or (used[:, LIMIT_MPS] > lanes["speed_mps"][lane]).any():
        return "a speed limit is 0 or above the map's limit"
    classes = used[:, CLASSES]
    if (classes != np.floor(classes)).any() or (classes >= 1 << 32).any():
        return "a lane is closed to an unknown class"
    world = np.broadcast_to(np.arange(len(told))[:, np.newaxis], told.shape[:2])
    pairs = np.stack([world[told[..., CHANGED] > 0.0], lane])
    return "a lane has two changes" if len(np.unique(pairs, axis=1).T) < len(lane) else ""


def apply_changes(
    told: NDArray[np.float64],
    lanes: NDArray[np.void],
    speed_mps: NDArray[np.float64],
    permissions: NDArray[np.uint32],
) -> None:
    """Write the limits and permissions of W worlds.

    `told`: (W, N, 3) LANE_CHANGE, valid. `lanes`: LANE (L,) of the map. `speed_mps`, `permissions`:
    (W, L), written.
    """
    speed_mps[:] = lanes["speed_mps"]
    permissions[:] = lanes["permissions"]
    world, place = np.nonzero(told[..., CHANGED])
    lane = told[world, place, CHANGED].astype(np.int64) - 1
    speed_mps[world, lane] = told[world, place, LIMIT_MPS]
    classes = told[world, place, CLASSES].astype(np.uint32)
    on_map = lanes["permissions"][lane]
    permissions[world, lane] = np.where(on_map == 0, classes, on_map & ~classes)
