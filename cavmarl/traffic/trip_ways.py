"""`TripWays`: finds complete routes for trips, which name only some of their edges."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RouteError
from cavmarl.roads.kernels.plans import TURNAROUND, plan_goal
from cavmarl.roads.kernels.route_steps import trace_edges
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN

MAX_EDGES = 100_000  # maximum number per route
# A lane change costs almost nothing, so it decides only between routes of equal time. On lanes that
# are too short for a change, `change_cost` returns the full cost.
CHANGE_WEIGHT = 1e-6


class TripWays:
    """The fastest routes at the speed limits; each pair of goal and class is planned once.

    Like SUMO's vehicles, trips make U-turns wherever the map permits them.

    `turned`: pairs (EDGE row of a goal, class) with routes that make U-turns.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.turned: set[tuple[int, int]] = set()
        self._network = network
        links = network.arrays.links.copy()
        turns = links["direction"] == TURNAROUND
        edge = network.lanes["edge"]
        ends = (edge[links[end][turns]].tolist() for end in ("from_lane", "to_lane"))
        self._turns = set(zip(*ends, strict=True))
        links["direction"][turns] = ord("s")
        self._turning = network.arrays._replace(links=links)
        self._plans: dict[tuple[int, int], NDArray[np.void]] = {}

    def edges(self, named: NDArray[np.int32], mask: int) -> NDArray[np.int32]:
        """Return the EDGE rows of a route over the `named` edges for the classes in `mask`.

        Raises:
            RouteError: no route joins two consecutive edges; the message names them.
        """
        found = [np.array([named[0]], dtype=np.int32)]
        for start, goal in pairwise(named.tolist()):
            way = self._way(start, goal, mask)
            if way is None:
                names = self._network.edge_ids
                raise RouteError(f"no route from edge '{names[start]}' to edge '{names[goal]}'")
            if not self._turns.isdisjoint(pairwise([start, *way.tolist()])):
                self.turned.add((goal, mask))
            found.append(way)
        return np.concatenate(found)

    def plan(
        self, goal: int, mask: int, change_weight: float, turning: bool, out: NDArray[np.void]
    ) -> None:
        """Fill `out`, PLAN (L,), for a goal; `turning`: whether all permitted U-turns are used."""
        roads = self._turning if turning else self._network.arrays
        plan_goal(roads, goal, mask, change_weight, out)

    def _way(self, start: int, goal: int, mask: int) -> NDArray[np.int32] | None:
        """Return the EDGE rows after the first edge; None if there is no route."""
        key = (goal, mask)
        if key not in self._plans:
            self._plans[key] = np.zeros(len(self._network.lanes), dtype=PLAN)
            self.plan(goal, mask, CHANGE_WEIGHT, True, self._plans[key])
        scratch = np.zeros(MAX_EDGES, dtype=np.int32)
        number = trace_edges(self._network.arrays, self._plans[key], start, scratch)
        return scratch[1:number].copy() if number > 0 else None
