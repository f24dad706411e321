"""`LaneMatcher`: the lanes on which logged vehicles drive."""

from __future__ import annotations

from typing import NamedTuple

from cavmarl.core.math.elementary import cos_sin
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import lane_grid

ON_LANE_M = 2.0  # a vehicle on a lane is at most this far from the middle of the lane
_ASKEW_M = 4.0  # penalty in the ranking: this times 1 - cos of the angle to the lane
_ALONG_COS = 0.7  # cosine of the largest angle to the lane, 45°


class LanePlace(NamedTuple):
    """A place on a lane."""

    lane: int
    s: float
    d: float


class LaneMatcher:
    """Finds the car lanes on which vehicles with given poses drive."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._grid = lane_grid(network)

    def lanes(self, x: float, y: float, heading: float) -> list[LanePlace]:
        """Return the places of a pose on lanes in its direction, the best fit first."""
        network, grid = self._network, self._grid
        column, line = int((x - grid.min_x) // grid.cell_m), int((y - grid.min_y) // grid.cell_m)
        if not (0 <= column < grid.num_x and 0 <= line < grid.num_y):
            return []
        cell = line * grid.num_x + column
        cos_own, sin_own = cos_sin(heading)
        found = []
        for lane in grid.cell_lanes[grid.cell_start[cell] : grid.cell_start[cell + 1]].tolist():
            row = network.lanes[lane]
            if not row["permissions"] & CARS:
                continue
            s, d, cos, sin = network.beside(lane, x, y)
            along = cos * cos_own + sin * sin_own
            if abs(d) > ON_LANE_M or not 0.0 <= s <= row["length_m"] or along < _ALONG_COS:
                continue
            found.append((abs(d) + _ASKEW_M * (1.0 - along), lane, s, d))
        return [LanePlace(lane, s, d) for _, lane, s, d in sorted(found)]

    def place(self, x: float, y: float, heading: float) -> LanePlace | None:
        """Return the best place of a pose; None if the pose is on no lane of its direction."""
        return next(iter(self.lanes(x, y, heading)), None)

    def way(self, start: int, end: int, most: int = 4) -> list[int] | None:
        """Return the edges from a lane's edge to another lane's, over at most `most` junctions.

        If the start is a lane over a junction, the lane before it is used; for the end, the lane
        after it. None: there is no such path.
        """
        first, last = self.edge(start, is_start=True), self.edge(end, is_start=False)
        paths = [[first]]
        for _ in range(most + 1):
            for path in paths:
                if path[-1] == last:
                    return path
            paths = [[*path, edge] for path in paths for edge in self._following(path[-1])]
            paths = list({path[-1]: path for path in reversed(paths)}.values())
        return None

    def edge(self, lane: int, *, is_start: bool) -> int:
        """Return the EDGE row of a lane, or of a lane before or after a path over a junction."""
        lanes, links = self._network.lanes, self._network.links
        if lanes["internal"][lane]:
            lane = links["from_lane" if is_start else "to_lane"][lanes["link"][lane]]
        return int(lanes["edge"][lane])

    def _following(self, edge: int) -> list[int]:
        network = self._network
        row = network.edges[edge]
        found = []
        for lane in network.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]]:
            links = network.links[lane["first_link"] : lane["first_link"] + lane["num_links"]]
            found += network.lanes["edge"][links["to_lane"]].tolist()
        return list(dict.fromkeys(found))
