"""`HdMap`: the road network for a stack, with searches for nearby lanes and places on lanes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

_CELL_M = 20.0


class OnLane(NamedTuple):
    """A place relative to a lane."""

    lane: int
    s_m: float  # position along the lane
    d_m: float  # distance from the centre of the lane, positive to the left
    heading_rad: float  # direction of the lane there


class HdMap:
    """Lanes indexed by place."""

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        lanes, points = network.lanes, network.points
        starts = np.concatenate(
            [
                np.arange(lane["first_point"], lane["first_point"] + lane["num_points"] - 1)
                for lane in lanes
            ]
        )
        self._lane = np.repeat(np.arange(len(lanes)), lanes["num_points"] - 1)
        self._x, self._y, self._s = (points[name][starts] for name in ("x", "y", "s"))
        self._cos, self._sin = points["cos"][starts], points["sin"][starts]
        self._length = points["s"][starts + 1] - self._s
        self._first = np.searchsorted(self._lane, np.arange(len(lanes) + 1))
        self._cells = self._by_cell()

    def _by_cell(self) -> dict[tuple[int, int], NDArray[np.intp]]:
        """Return segments by the cells of the map that they may be near."""
        members: dict[tuple[int, int], list[int]] = {}
        for k, length in enumerate(self._length.tolist()):
            at = np.arange(0.0, length + _CELL_M, 0.5 * _CELL_M).clip(max=length)
            xs = self._x[k] + at * self._cos[k]
            ys = self._y[k] + at * self._sin[k]
            around = {
                (int(x // _CELL_M) + i, int(y // _CELL_M) + j)
                for x, y in zip(xs, ys, strict=True)
                for i in (-1, 0, 1)
                for j in (-1, 0, 1)
            }
            for cell in around:
                members.setdefault(cell, []).append(k)
        return {cell: np.array(found) for cell, found in members.items()}

    def near(self, x_m: float, y_m: float, within_m: float) -> list[OnLane]:
        """Return lanes whose centre is at most `within_m` away (up to 20 m), nearest first."""
        rows = self._cells.get((int(x_m // _CELL_M), int(y_m // _CELL_M)))
        if rows is None:
            return []
        places, off = self._project(rows, x_m, y_m)
        found: dict[int, OnLane] = {}
        for k in np.argsort(off, kind="stable").tolist():
            if off[k] > within_m:
                break
            found.setdefault(int(self._lane[rows[k]]), places(k))
        return list(found.values())

    def on_lane(self, lane: int, x_m: float, y_m: float) -> OnLane:
        """Return a place relative to one lane, at any distance."""
        rows = np.arange(self._first[lane], self._first[lane + 1])
        places, off = self._project(rows, x_m, y_m)
        return places(int(np.argmin(off)))

    def _project(
        self, rows: NDArray[np.intp], x_m: float, y_m: float
    ) -> tuple[Callable[[int], OnLane], NDArray[np.float64]]:
        """Return a function from the index of a segment to the place on it, and all distances."""
        from_x, from_y = x_m - self._x[rows], y_m - self._y[rows]
        cos, sin = self._cos[rows], self._sin[rows]
        along = np.clip(from_x * cos + from_y * sin, 0.0, self._length[rows])
        off = np.hypot(from_x - along * cos, from_y - along * sin)

        def place(k: int) -> OnLane:
            return OnLane(
                int(self._lane[rows[k]]),
                float(self._s[rows[k]] + along[k]),
                float(from_y[k] * cos[k] - from_x[k] * sin[k]),
                math.atan2(float(sin[k]), float(cos[k])),
            )

        return place, off

    def polyline(self, lane: int, from_m: float) -> NDArray[np.float64]:
        """Return (n, 2) the centre line of a lane from a place to its end."""
        points = self.network.lane_points(lane)
        s = np.concatenate([[from_m], points["s"][points["s"] > from_m + 1e-6]])
        return np.stack(
            [np.interp(s, points["s"], points["x"]), np.interp(s, points["s"], points["y"])], axis=1
        )
