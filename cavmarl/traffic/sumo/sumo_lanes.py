"""`SumoLanes`: the lanes of W worlds as SUMO knows them, and changes to send to SUMO."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.traffic.sumo.sumo_history import LANE_CHANGE, MOVED

_EVERY_CLASS = (1 << len(VEHICLE_CLASSES)) - 1  # bits of LANE["permissions"]


class SumoLanes:
    """The closures and the speed limits that the SUMO of each world has received.

    `on_map`: LANE (L,). `now`: LANE (W, L) of each world; (0, L): lanes do not change.
    """

    def __init__(self, on_map: NDArray[np.void], now: NDArray[np.void]) -> None:
        self.now = now
        self._on_map = on_map
        self._bits = np.zeros(now.shape, dtype=np.int64)
        self._limits_mps = np.tile(on_map["speed_mps"], (len(now), 1))

    def begin(self, w: int) -> None:
        """Begin an episode of a world, with the lanes of the map."""
        if len(self.now):
            self._bits[w] = 0
            self._limits_mps[w] = self._on_map["speed_mps"]

    def news(self, w: int) -> NDArray[np.void]:
        """Return MOVED (n,): the lanes that SUMO does not know yet, and mark them as known."""
        if not len(self.now):
            return np.zeros(0, dtype=MOVED)
        now = self.now[w]
        bits = self._on_map["permissions"] & ~now["permissions"] & _EVERY_CLASS
        limits_mps = now["speed_mps"]
        changed = np.flatnonzero((bits != self._bits[w]) | (limits_mps != self._limits_mps[w]))
        found = np.zeros(len(changed), dtype=MOVED)
        found["kind"], found["edge"] = LANE_CHANGE, changed
        found["id"], found["x"] = bits[changed], limits_mps[changed]
        self.learn(w, found)
        return found

    def learn(self, w: int, told: NDArray[np.void]) -> None:
        """Record the lanes that SUMO has received; `told`: MOVED (n,)."""
        lanes = told[told["kind"] == LANE_CHANGE]
        if len(lanes):
            self._bits[w, lanes["edge"]] = lanes["id"]
            self._limits_mps[w, lanes["edge"]] = lanes["x"]

    def has_closed(self, w: int) -> bool:
        """Return whether a lane is closed to a class."""
        return len(self.now) > 0 and bool(self._bits[w].any())
