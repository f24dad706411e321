"""Writes the global state of a world as one vector of fixed shape."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.engine.spaces import STATE_FEATURES
from cavmarl.roads.network import RoadNetwork

SPEED_SCALE_MPS = 40.0


def global_state(
    network: RoadNetwork, vehicles: NDArray[np.void], space: spaces.Box
) -> NDArray[np.float32]:
    """All vehicles in the order of their ids: present, x, y, cos, sin of the heading, speed.

    x and y go from -1 to 1 over the map's extent, speed is over 40 m/s; places without a vehicle
    are 0.
    """
    state = np.zeros((space.shape[0] // STATE_FEATURES, STATE_FEATURES), dtype=np.float32)
    rows = vehicles[np.argsort(vehicles["id"])]
    min_x, min_y, max_x, max_y = network.extent_m
    live = state[: len(rows)]
    live[:, 0] = 1.0
    live[:, 1] = 2.0 * (rows["x"] - min_x) / max(max_x - min_x, 1.0) - 1.0
    live[:, 2] = 2.0 * (rows["y"] - min_y) / max(max_y - min_y, 1.0) - 1.0
    live[:, 3] = np.cos(rows["heading"])
    live[:, 4] = np.sin(rows["heading"])
    live[:, 5] = rows["speed"] / SPEED_SCALE_MPS
    return np.clip(state, -1.0, 1.0).ravel()
