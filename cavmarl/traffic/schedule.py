"""`Schedule`: a demand file prepared for kernels: types, steps of all routes, departures."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError, RouteError
from cavmarl.core.records.codes import LANE_GIVEN, SPEED_GIVEN
from cavmarl.roads.kernels.route_steps import plan_route
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.demand.drawing import speed_factors
from cavmarl.traffic.departure_queue import DEPARTURE
from cavmarl.traffic.trip_ways import TripWays

MAX_STEPS = 50_000_000
MAX_DETOUR_STEPS = 8_000_000
DETOUR_CHANGE_WEIGHT = 100.0

MAX_COUNTS = 4096  # number of episodes whose number of departures is cached


class Schedule:
    """The departures of a demand file as records, and the steps of their routes.

    The routes of trips are searched once, when the world is made: the fastest routes at the speed
    limits, over the edges that the trip names.

    `demand`: the demand of the files. `first_type`: VTYPE row of the file's first type in the
    world's table. `first_step`: PLAN row of the first route's first step in the world's table.

    Raises RouteError: no route exists for a trip; CapacityError: the routes have too many steps.
    """

    def __init__(self, demand: DemandFile, first_type: int, first_step: int) -> None:
        self.demand = demand
        # number of departures by (key, horizon); it is needed twice when a state is checked and
        # then loaded
        self._counts: dict[tuple[int, float], int] = {}
        self._network: RoadNetwork = demand.network
        self._first_type = first_type
        ways = TripWays(self._network)
        permissions = demand.types["permissions"].astype(np.int64)
        self._class_of_type = np.unique(permissions, return_inverse=True)[1]
        masks = np.unique(permissions)
        self._way = np.full((len(demand.routes), len(masks)), -1, dtype=np.int64)
        self.first_edge = np.zeros(len(demand.routes), dtype=np.int32)
        parts: list[NDArray[np.void]] = []
        begin = first_step
        lanes = [np.zeros(0, dtype=np.int32)]
        loops: list[int] = []
        self._longest = 0
        for route, mask_row in sorted(self._driven()):
            edges = self._edges(route, int(masks[mask_row]), ways)
            if self._passes_twice(edges) and route not in loops:
                loops.append(route)
            steps = self._steps(edges, int(masks[mask_row]))
            first_lane = int(self._network.edges[edges[0]]["first_lane"])
            self._way[route, mask_row] = begin - first_lane
            parts.append(steps)
            lanes.append(self._lanes(edges))
            self._longest = max(self._longest, len(steps))
            begin += len(steps)
            if begin > MAX_STEPS:
                raise CapacityError(
                    f"the routes of the demand have more than {MAX_STEPS} steps; "
                    "use fewer or shorter routes"
                )
        self._report_loops(loops)
        self.first_detour = begin - first_step
        self.step_lanes = np.concatenate(lanes)  # LANE row of each step before the first detour
        parts.append(self._detours(masks, ways))
        self.steps = np.concatenate(parts)

    def _passes_twice(self, edges: NDArray[np.int32]) -> bool:
        """Return whether a route leads over a junction more than once."""
        passed = self._network.edges["to_junction"][edges[:-1]]
        return len(np.unique(passed)) < len(passed)

    def _report_loops(self, routes: list[int]) -> None:
        """Add these routes to the report of the demand, once for all worlds with this demand."""
        what, report = "route passes a junction twice", self.demand.report
        if routes and what not in report.tolerated:
            report.tolerate(what, self._place(routes[0]), len(routes))

    def _detours(self, masks: NDArray[np.int64], ways: TripWays) -> NDArray[np.void]:
        """Return steps from every lane to the last edges of the routes, with few lane changes.

        A vehicle that misses a lane change of its route continues on these steps. If they would
        need more than `MAX_DETOUR_STEPS` steps, there are no detours, and such vehicles wait.
        """
        routes = self.demand.routes
        last = self.demand.route_edges[routes["first_edge"] + routes["num_edges"] - 1]
        goals = {
            (int(last[route]), int(mask_row))
            for route, mask_row in zip(*np.nonzero(self._way >= 0), strict=True)
        }
        num_lanes = len(self._network.lanes)
        self._goal = np.full(self._way.shape, -1, dtype=np.int32)
        if len(goals) * num_lanes > MAX_DETOUR_STEPS:
            return np.zeros(0, dtype=PLAN)
        plans = np.zeros((len(goals), num_lanes), dtype=PLAN)
        for row, (edge, mask_row) in enumerate(sorted(goals)):
            mask = int(masks[mask_row])
            turning = (edge, mask) in ways.turned
            ways.plan(edge, mask, DETOUR_CHANGE_WEIGHT, turning, plans[row])
            self._goal[last == edge, mask_row] = row
        return plans.reshape(-1)

    def _driven(self) -> Iterable[tuple[int, int]]:
        """Return pairs of ROUTE row and vehicle class that a vehicle of the files may have."""
        demand = self.demand
        choices = np.unique(demand.elements[["types", "routes"]])
        pairs = {
            (int(route), int(self._class_of_type[vtype]))
            for choice in choices
            for route in demand.route_choices.options(choice["routes"])
            for vtype in demand.type_choices.options(choice["types"])
            if vtype * len(demand.routes) + route not in demand.bad_pairs
        }
        classes = range(self._way.shape[1])
        return pairs | {(int(route), c) for route in demand.rerouters.routes.rows for c in classes}

    @property
    def longest(self) -> int:
        return self._longest

    def orders(self, key: int, horizon_s: float) -> NDArray[np.void]:
        """Return ORDER (n,) of one episode, see `draw`."""
        return self.demand.draw(key, self.demand.begin_ms / 1000.0 + horizon_s)

    def last_edges(self, routes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the last EDGE row (n,) of each ROUTE row (n,)."""
        rows = self.demand.routes[routes]
        last: NDArray[np.int32] = self.demand.route_edges[
            rows["first_edge"] + rows["num_edges"] - 1
        ]
        return last

    def way_on(self, route: int, vtype: int, edge: int) -> int:
        """Return VEHICLE["way"] on this <route> from one of the route's edges, or -1.

        `route`: ROUTE row with all edges. `vtype`: VTYPE row of the file.
        """
        row = self.demand.routes[route]
        begin = self._way[route, self._class_of_type[vtype]]
        edges = self.demand.route_edges[row["first_edge"] : row["first_edge"] + row["num_edges"]]
        if begin < 0 or edge not in edges:
            return -1
        before = edges[: int(np.argmax(edges == edge))]
        network = self._network.edges
        first_step = int(begin) + int(network["first_lane"][edges[0]])
        return (
            first_step + int(network["num_lanes"][before].sum()) - int(network["first_lane"][edge])
        )

    def detour_goal(self, route: int, vtype: int) -> int:
        return int(self._goal[route, self._class_of_type[vtype]])

    def _edges(self, route: int, mask: int, ways: TripWays) -> NDArray[np.int32]:
        """Return the EDGE rows of a route; gaps between named edges are filled."""
        row = self.demand.routes[route]
        named = self.demand.route_edges[row["first_edge"] : row["first_edge"] + row["num_edges"]]
        if row["exact"]:
            return named
        try:
            return ways.edges(named, mask)
        except RouteError as error:
            raise RouteError(
                f"{self._place(route)}: {error} of the map '{self._network.name}' for the vehicle "
                "class of a trip; change the trip, or set traffic.on_bad_route = skip"
            ) from None

    def _place(self, route: int) -> str:
        """Return the file and line of the first element that may use a route."""
        demand = self.demand
        choices = range(len(demand.route_choices))
        having = [c for c in choices if route in demand.route_choices.options(c)]
        return demand.place(int(np.isin(demand.elements["routes"], having).argmax()))

    def _lanes(self, edges: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the LANE rows of the steps of a route."""
        rows = self._network.edges[edges]
        ends = np.cumsum(rows["num_lanes"])
        firsts = np.repeat(rows["first_lane"] - (ends - rows["num_lanes"]), rows["num_lanes"])
        return (firsts + np.arange(len(firsts))).astype(np.int32)

    def _steps(self, edges: NDArray[np.int32], mask: int) -> NDArray[np.void]:
        number = int(self._network.edges["num_lanes"][edges].sum())
        steps = np.zeros(number, dtype=PLAN)
        plan_route(self._network.arrays, edges, mask, 0, steps, np.zeros(number))
        return steps

    def count(self, key: int, horizon_s: float) -> int:
        """Return how many departures `draw` returns for an episode."""
        known = self._counts.get((key, horizon_s))
        return len(self.orders(key, horizon_s)) if known is None else known

    def draw(self, key: int, horizon_s: float, dt: float) -> NDArray[np.void]:
        """Draw the departures of an episode: DEPARTURE (n,), sorted by `due`.

        `horizon_s`: length of an episode in s; later departures are left out.
        """
        demand = self.demand
        orders = self.orders(key, horizon_s)
        self._counts[key, horizon_s] = len(orders)
        while len(self._counts) > MAX_COUNTS:
            del self._counts[next(iter(self._counts))]
        departures = np.zeros(len(orders), dtype=DEPARTURE)
        begin_s = demand.begin_ms / 1000.0
        departures["due"] = np.ceil((orders["depart"] - begin_s) / dt - 1e-6)
        departures["agent"] = -1
        departures["goal"] = self._goal[orders["route"], self._class_of_type[orders["vtype"]]]
        departures["order"] = np.arange(len(orders))
        departures["vtype"] = self._first_type + orders["vtype"]
        departures["way"] = self._way[orders["route"], self._class_of_type[orders["vtype"]]]
        routes = demand.routes[orders["route"]]
        first_edge = demand.route_edges[routes["first_edge"]]
        lanes, edges = self._network.lanes, self._network.edges
        given = orders["depart_lane"] >= 0
        departures["lane"] = np.where(given, orders["depart_lane"], edges["first_lane"][first_edge])
        departures["lane_code"] = np.where(given, LANE_GIVEN, orders["depart_lane"])
        departures["pos_code"] = orders["depart_pos_code"]
        scale = lanes["length_m"][departures["lane"]] / edges["length_m"][first_edge]
        departures["pos"] = orders["depart_pos"] * scale
        departures["speed_code"] = orders["depart_speed_code"]
        departures["speed"] = np.where(
            orders["depart_speed_code"] == SPEED_GIVEN, orders["depart_speed"], 0.0
        )
        departures["speed_factor"] = speed_factors(demand.types, orders, key)
        departures["stop"] = np.where(orders["num_stops"] > 0, orders["first_stop"], -1)
        departures["stops_end"] = departures["stop"] + orders["num_stops"]
        departures["stops_end"][orders["num_stops"] == 0] = -1
        return departures
