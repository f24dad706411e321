"""`TripWays`: the ways of trips, which name only some of their edges."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RouteError
from cavmarl.roads.kernels.plans import TURNAROUND, plan_goal
from cavmarl.roads.kernels.route_steps import trace_edges
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN

MAX_EDGES = 100_000  # of one way


class TripWays:
    """The fastest ways at the speed limits; each goal and class is planned for once.

    Vehicles turn round where a road ends. Where nothing else leads to an edge, they do wherever the
    map lets them, as SUMO's do.

    `turned`: (EDGE row of a goal, class) of which that is so.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.turned: set[tuple[int, int]] = set()
        self._network = network
        links = network.arrays.links.copy()
        links["direction"][links["direction"] == TURNAROUND] = ord("s")
        self._turning = network.arrays._replace(links=links)
        self._plans: dict[tuple[int, int, bool], NDArray[np.void]] = {}

    def edges(self, named: NDArray[np.int32], mask: int) -> NDArray[np.int32]:
        """The EDGE rows of a way over those that are named, for bits of a class.

        Raises:
            RouteError: two of them that no way joins: a clause that says which.
        """
        found = [np.array([named[0]], dtype=np.int32)]
        for start, goal in pairwise(named.tolist()):
            way = self._way(start, goal, mask, turning=False)
            if way is None:
                way = self._way(start, goal, mask, turning=True)
                self.turned.add((goal, mask))
            if way is None:
                names = self._network.edge_ids
                raise RouteError(f"no way from edge '{names[start]}' to edge '{names[goal]}'")
            found.append(way)
        return np.concatenate(found)

    def plan(
        self, goal: int, mask: int, change_weight: float, turning: bool, out: NDArray[np.void]
    ) -> None:
        """Fill PLAN (L,) of a goal; `turning`: whether vehicles turn round where they may."""
        roads = self._turning if turning else self._network.arrays
        plan_goal(roads, goal, mask, change_weight, out)

    def _way(self, start: int, goal: int, mask: int, turning: bool) -> NDArray[np.int32] | None:
        """The EDGE rows behind the first one; None: there is no way."""
        key = (goal, mask, turning)
        if key not in self._plans:
            self._plans[key] = np.zeros(len(self._network.lanes), dtype=PLAN)
            self.plan(goal, mask, 1.0, turning, self._plans[key])
        scratch = np.zeros(MAX_EDGES, dtype=np.int32)
        number = trace_edges(self._network.arrays, self._plans[key], start, scratch)
        return scratch[1:number].copy() if number > 0 else None
