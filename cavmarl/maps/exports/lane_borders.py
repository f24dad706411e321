"""`LaneBorders`: the borders of all lanes, with common end points where lanes lead into each other.

In Lanelet2, a route continues where lanes have common end points, and changes lanes where they have
a common border.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

LEFT, RIGHT = 0, 1
START, END = 0, 1


class LaneBorders:
    """The borders of all lanes of a map.

    Attributes:
        places: by lane and side: (n, 3) x, y and z in m, in driving direction.
        joints: (lanes, 2, 2) by lane, side and end: index of the end point.
        shared: by lane: the left neighbour, if its right border is the left border of the lane.
    """

    def __init__(self, network: RoadNetwork) -> None:
        lanes = network.lanes
        self.places = [
            [_beside(network, lane, side) for side in (0.5, -0.5)] for lane in range(len(lanes))
        ]
        self._parents = np.arange(4 * len(lanes))
        for before, after in _sequences(network):
            for side in (LEFT, RIGHT):
                self._join(_index(before, side, END), _index(after, side, START))
        self.shared: dict[int, int] = {}
        for lane in np.flatnonzero(~lanes["internal"] & (lanes["left"] >= 0)).tolist():
            if self._share(lane, int(lanes["left"][lane])):
                self.shared[lane] = int(lanes["left"][lane])
        roots = np.array([self._root(index) for index in range(len(self._parents))])
        self.joints = roots.reshape(-1, 2, 2)
        self._meet(lanes["internal"])

    def _root(self, index: int) -> int:
        while self._parents[index] != index:
            self._parents[index] = self._parents[self._parents[index]]
            index = int(self._parents[index])
        return index

    def _join(self, one: int, other: int) -> None:
        self._parents[self._root(one)] = self._root(other)

    def _share(self, lane: int, left: int) -> bool:
        """Join the ends of a border, unless a lane would get the same end on both sides."""
        for end in (START, END):
            own, others = _index(lane, LEFT, end), _index(left, RIGHT, end)
            roots = {self._root(own), self._root(others)}
            if roots & {self._root(_index(lane, RIGHT, end)), self._root(_index(left, LEFT, end))}:
                return False
        for end in (START, END):
            self._join(_index(lane, LEFT, end), _index(left, RIGHT, end))
        return True

    def _meet(self, internal: NDArray[np.bool_]) -> None:
        """Move joined ends to their mean; ends inside junctions count only if all are inside."""
        ends = np.array(
            [[[border[0], border[-1]] for border in borders] for borders in self.places]
        ).reshape(-1, 3)
        weights = np.repeat(np.where(internal, 1e-9, 1.0), 4)
        joints = self.joints.ravel()
        sums = np.zeros((len(joints), 3))
        np.add.at(sums, joints, ends * weights[:, np.newaxis])
        totals = np.bincount(joints, weights, minlength=len(joints))
        for index, joint in enumerate(joints.tolist()):
            lane, side, end = index // 4, index // 2 % 2, index % 2
            self.places[lane][side][-end] = sums[joint] / totals[joint]


def _index(lane: int, side: int, end: int) -> int:
    return 4 * lane + 2 * side + end


def _sequences(network: RoadNetwork) -> Iterator[tuple[int, int]]:
    """Yield each lane with a lane that follows it."""
    for link in network.links:
        yield int(link["from_lane"]), int(link["next_lane"])
    for lane in np.flatnonzero(network.lanes["internal"]).tolist():
        after = int(network.lanes["successor"][lane])
        if after >= 0:
            yield lane, after


def _beside(network: RoadNetwork, lane: int, side: float) -> NDArray[np.float64]:
    """Return the border of a lane, `side` widths to the left of its centre line."""
    shape = network.lane_polyline(lane)
    along = np.gradient(shape[:, :2], axis=0)
    length = np.maximum(np.hypot(*along.T), 1e-9)
    shift = side * float(network.lanes["width_m"][lane]) / length
    border = shape.copy()
    border[:, 0] -= along[:, 1] * shift
    border[:, 1] += along[:, 0] * shift
    return border
