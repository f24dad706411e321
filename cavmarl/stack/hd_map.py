"""`HdMap`: the road network as a stack asks for it: which lanes are near, and where on them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

__all__ = ["HdMap", "OnLane", "wrap"]


def wrap(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.atan2(math.sin(angle), math.cos(angle))


class OnLane(NamedTuple):
    """A place beside a lane.

    Attributes:
        lane: LANE row.
        s_m: along it.
        d_m: from its centre, positive to the left.
        heading_rad: of the lane there.
    """

    lane: int
    s_m: float
    d_m: float
    heading_rad: float


class HdMap:
    """Lanes by place.

    Args:
        network: the roads.
    """

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

    def near(self, x_m: float, y_m: float, within_m: float) -> list[OnLane]:
        """Lanes whose centre is at most that far away, nearest first."""
        from_x, from_y = x_m - self._x, y_m - self._y
        along = np.clip(from_x * self._cos + from_y * self._sin, 0.0, self._length)
        off = np.hypot(from_x - along * self._cos, from_y - along * self._sin)
        found: dict[int, OnLane] = {}
        (close,) = np.nonzero(off <= within_m)
        for k in close[np.argsort(off[close], kind="stable")].tolist():
            lane = int(self._lane[k])
            if lane not in found:
                cos, sin = float(self._cos[k]), float(self._sin[k])
                found[lane] = OnLane(
                    lane,
                    float(self._s[k] + along[k]),
                    float(from_y[k] * cos - from_x[k] * sin),
                    math.atan2(sin, cos),
                )
        return list(found.values())

    def on_lane(self, lane: int, x_m: float, y_m: float) -> OnLane:
        """A place beside one lane, however far away."""
        (rows,) = np.nonzero(self._lane == lane)
        from_x, from_y = x_m - self._x[rows], y_m - self._y[rows]
        cos, sin = self._cos[rows], self._sin[rows]
        along = np.clip(from_x * cos + from_y * sin, 0.0, self._length[rows])
        off = np.hypot(from_x - along * cos, from_y - along * sin)
        k = int(np.argmin(off))
        return OnLane(
            lane,
            float(self._s[rows[k]] + along[k]),
            float(from_y[k] * cos[k] - from_x[k] * sin[k]),
            math.atan2(float(sin[k]), float(cos[k])),
        )

    def polyline(self, lane: int, from_m: float) -> NDArray[np.float64]:
        """(n, 2) the centre of a lane from a place on to its end."""
        row = self.network.lanes[lane]
        points = self.network.points[row["first_point"] : row["first_point"] + row["num_points"]]
        s = np.concatenate([[from_m], points["s"][points["s"] > from_m + 1e-6]])
        return np.stack(
            [np.interp(s, points["s"], points["x"]), np.interp(s, points["s"], points["y"])], axis=1
        )
