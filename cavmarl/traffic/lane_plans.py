"""`LanePlans`: the plans of each world whose lanes differ from the map.

The plans of a world depend only on its lanes. They are renewed when lanes change, and after a state
is loaded, so they are not part of the state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import RoadArrays
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.network import CARS
from cavmarl.traffic.kernels.way_requests import CLOSED_S

# s to drive along a closed contraflow lane: longer than any route over other closed lanes
SHUT_S = 1000.0 * CLOSED_S


class LanePlans:
    """The plans of W worlds to G goals.

    A plan avoids closed lanes wherever there is another route. Otherwise it leads over them:
    vehicles wait before the first closed lane, and leave a closed lane if they are on it.

    Args:
        roads: roads for plans, with the lanes of the map.
        goal_edges: (G,) EDGE rows.
        base: PLAN (G, L) on the lanes of the map.
        own: PLAN (1 + W, G, L) in the world's table of steps: a copy of `base`, then the plans of
            each world, which are written here.
        shifts: (W,) `TripTables.shifts`, written here.
        first: row of `own[0]` in the table of steps.
        follows_limits: whether plans also depend on the present speed limits.

    Attributes:
        tables: `own`, read-only.
    """

    def __init__(
        self,
        roads: RoadArrays,
        goal_edges: NDArray[np.int32],
        base: NDArray[np.void],
        own: NDArray[np.void],
        shifts: NDArray[np.int64],
        first: int,
        follows_limits: bool,
    ) -> None:
        self._roads = roads
        self._goal_edges = goal_edges
        self._base = base
        self._own = own
        self._shifts = shifts
        self._first = first
        self._follows_limits = follows_limits
        self._known: list[bytes] = [b""] * len(shifts)
        self.tables = own[:]
        self.tables.setflags(write=False)

    def renew(self, world: int, lanes: NDArray[np.void]) -> bool:
        """Renew the plans of a world if a change affects them; return whether it does.

        `lanes`: LANE (L,) of the world.
        """
        on_map = self._roads.lanes
        closed = ((on_map["permissions"] & CARS) != 0) & ((lanes["permissions"] & CARS) == 0)
        contraflow = on_map["permissions"] == 0
        opened = contraflow & ((lanes["permissions"] & CARS) != 0)
        differs = closed | opened
        if self._follows_limits:
            differs |= lanes["speed_mps"] != on_map["speed_mps"]
        speed_mps = (lanes if self._follows_limits else on_map)["speed_mps"].copy()
        speed_mps[closed] = on_map["length_m"][closed] / CLOSED_S
        key = speed_mps.tobytes() + opened.tobytes() if differs.any() else b""
        if key == self._known[world]:
            return False
        self._known[world] = key
        own = self._own[1 + world]
        if not key:
            own[:] = self._base
            self._shifts[world] = 0
            return True
        now = on_map.copy()
        now["speed_mps"] = speed_mps
        # Vehicles on contraflow lanes that close need a route out of these lanes.
        now["permissions"][contraflow] = CARS
        shut = contraflow & ~opened
        now["speed_mps"][shut] = on_map["length_m"][shut] / SHUT_S
        # Lanes are immutable like the roads, because kernels are compiled for immutable lanes.
        now.setflags(write=False)
        roads = self._roads._replace(lanes=now)
        for goal, edge in enumerate(self._goal_edges.tolist()):
            plan_goal(roads, edge, CARS, 1.0, own[goal])
        self._shifts[world] = self._first + (1 + world) * self._base.size
        return True
