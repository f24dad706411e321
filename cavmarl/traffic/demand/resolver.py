"""`Resolver`: replaces names in collected definitions by rows, and checks them on the map."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RouteError
from cavmarl.driving.vehicle_types import DEFAULT_TYPES
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.traffic.demand.definition_collector import DefinitionCollector
from cavmarl.traffic.demand.demand_records import (
    LANE_CURRENT,
    POS_BASE,
    POS_GIVEN,
    POS_STOP,
    SPEED_GIVEN,
    UNTIL_ABSOLUTE,
    UNTIL_FLOW,
    Choices,
    Options,
)
from cavmarl.traffic.demand.element import Element
from cavmarl.traffic.demand.map_index import MapIndex
from cavmarl.traffic.demand.rerouters import Rerouters, read_rerouters
from cavmarl.traffic.demand.route_records import RouteTable, StopReader
from cavmarl.traffic.demand.type_table import TypeTable
from cavmarl.traffic.trip_ways import TripWays

log = logging.getLogger(__name__)
NAMED = 5  # maximum number of ids in the warning about omitted vehicles

# Classes whose lanes road networks leave out: see `sumo_net.selection`.
_PARTLY_MAPPED = sum(1 << VEHICLE_CLASSES.index(name) for name in ("bicycle", "tram"))


class Resolver:
    """The second stage of reading, after all definitions are known.

    Attributes:
        types: all types.
        routes: all routes and stops.
        ids: ids of the remaining elements, by row.
    """

    def __init__(
        self,
        collector: DefinitionCollector,
        index: MapIndex,
        skip: bool,
        type_defaults: Mapping[str, str],  # default attributes of types
    ) -> None:
        self._index = index
        self._skip = skip
        self._ways = TripWays(index.network)
        self._report = collector.report
        self._named = named = collector.named
        self.types = TypeTable(named, self._report, type_defaults)
        places = named.get("stopping place", {})
        stop_reader = StopReader(index, places, self._report, skip)
        self.routes = RouteTable(index, named, stop_reader, self._report)
        self._type_options = [
            self.types.options(name, user) for name, user in collector.types.items()
        ]
        elements, ids = self._on_roads(collector.elements(), collector.ids)
        self._route_options = self._options_of(elements, list(collector.routes.values()))
        self._bad: set[tuple[int, int]] = set()
        keep = self._check(elements, ids)
        self._warn_left_out([ids[row] for row in np.flatnonzero(~keep)])
        self._elements = elements[keep]
        self.ids = [ids[row] for row in np.flatnonzero(keep)]
        self._check_ids()
        self._place_stops(list(collector.stops.values()))
        self._depart_at_stops()

    def elements(self) -> NDArray[np.void]:
        return self._elements

    def type_choices(self) -> Choices:
        """Return the choices that ELEMENT["types"] refers to."""
        return Choices([options or Options((), ()) for options in self._type_options])

    def route_choices(self) -> Choices:
        """Return the choices that ELEMENT["routes"] refers to."""
        return Choices([options or Options((), ()) for options in self._route_options])

    def rerouters(self) -> Rerouters:
        """Return all <rerouter>s; the routes that they name are added to `routes`."""
        return read_rerouters(
            list(self._named.get("rerouter", {}).values()),
            self._index,
            self.routes,
            self.types.names,
            {*self._named.get("vType", {}), *DEFAULT_TYPES},
            self._report,
        )

    def bad_pairs(self) -> NDArray[np.int64]:
        """Return the keys type * num_routes + route that cannot be driven."""
        num_routes = len(self.routes.names)
        return np.array(sorted(t * num_routes + r for t, r in self._bad), dtype=np.int64)

    def _warn_left_out(self, ids: list[str]) -> None:
        if ids:
            some = ", ".join(ids[:NAMED]) + (", …" if len(ids) > NAMED else "")
            files = ", ".join(self._report.files)
            text = "%s: left out %d vehicles and flows that cannot drive their routes: %s"
            log.warning(text, files, len(ids), some)

    def _stub(self, elements: NDArray[np.void], ids: Sequence[str], row: int) -> Element:
        element = elements[row]
        name = "flow" if element["flow"] else "vehicle"
        path = self._report.files[int(element["file"])]
        return Element(name, {"id": ids[row]}, path, int(element["line"]))

    def _on_roads(
        self, elements: NDArray[np.void], ids: list[str]
    ) -> tuple[NDArray[np.void], list[str]]:
        on_road = np.array([options is not None for options in self._type_options], dtype=bool)
        keep = on_road[elements["types"]] if len(on_road) else np.zeros(0, dtype=bool)
        for row in np.flatnonzero(~keep):
            self._report.tolerate(
                "vehicle of a class that drives on no road is left out",
                self._stub(elements, ids, int(row)).place,
            )
        return elements[keep], [ids[row] for row in np.flatnonzero(keep)]

    def _options_of(
        self, elements: NDArray[np.void], sources: list[Element]
    ) -> list[Options | None]:
        used = set(np.unique(elements["routes"]).tolist())
        return [
            self.routes.options(source) if number in used else None
            for number, source in enumerate(sources)
        ]

    def _check(self, elements: NDArray[np.void], ids: list[str]) -> NDArray[np.bool_]:
        """Return which elements can drive; the others are refused or counted."""
        fields = ["types", "routes", "depart_lane", "arrival_lane"]
        seen, first, which = np.unique(
            np.stack([elements[name] for name in fields], axis=1),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        counts = np.bincount(which.ravel(), minlength=len(seen))
        fits = np.ones(len(seen), dtype=bool)
        # Check in the order of the files, so that the first mistake is reported.
        for case in np.argsort(first):
            types, routes, depart_lane, arrival_lane = (int(value) for value in seen[case])
            user = self._stub(elements, ids, int(first[case]))
            fits[case] = self._drives(types, routes, user) and self._has_lane(
                types, routes, depart_lane, user
            )
            if not fits[case]:
                what = "vehicle or flow that cannot drive its route is left out"
                self._report.tolerate(what, user.place, int(counts[case]))
            elif arrival_lane >= 0 and self._missing_lane(routes, arrival_lane, -1):
                what = "arrivalLane that the edge lacks is treated as any lane"
                self._report.tolerate(what, user.place)
                elements["arrival_lane"][which.ravel() == case] = LANE_CURRENT
        keep: NDArray[np.bool_] = fits[which.ravel()]
        return keep

    def _drives(self, types: int, routes: int, user: Element) -> bool:
        """Return whether any option can be driven; refuse the others unless they are tolerated."""
        some = False
        for vtype in self._options(self._type_options, types).rows:
            permissions = self.types.permissions(vtype)
            for route in self._options(self._route_options, routes).rows:
                gap = self._gap(route, permissions)
                if gap is None:
                    some = True
                elif self._tolerates(vtype, user):
                    self._bad.add((vtype, route))
                else:
                    raise self._index.route_error(user, gap)
        return some

    def _gap(self, route: int, permissions: int) -> str | None:
        """Return why a class cannot drive a route, or None if it can.

        If `_skip` is set, routes are also searched for trips, to find those without a route.
        """
        edges, exact = self.routes.edges(route), self.routes.exact(route)
        gap = self._index.gap(edges, exact, permissions)
        if gap is None and self._skip and not exact:
            try:
                self._ways.edges(np.asarray(edges, dtype=np.int32), permissions)
            except RouteError as error:
                return str(error)
        return gap

    def _tolerates(self, vtype: int, user: Element) -> bool:
        """Return whether vehicles of this type without a route are left out instead of refused."""
        if self.types.permissions(vtype) & ~_PARTLY_MAPPED == 0:
            what = f"type '{self.types.names[vtype]}' has no route: maps lack lanes of its class"
            self._report.tolerate(what, user.place)
            return True
        return self._skip

    def _options(self, table: list[Options | None], choice: int) -> Options:
        options = table[choice]
        assert options is not None
        return options

    def _missing_lane(self, routes: int, lane: int, end: int) -> str:
        """Return a route's first or last edge (end 0 or -1) if it lacks a lane, else ""."""
        table = self._index.lane_table
        for route in self._options(self._route_options, routes).rows:
            edge = self.routes.edges(route)[end]
            if lane >= table.shape[1] or table[edge, lane] < 0:
                return self._index.network.edge_ids[edge]
        return ""

    def _has_lane(self, types: int, routes: int, lane: int, user: Element) -> bool:
        """Return whether all options can enter on a lane, given as SUMO's index or a code."""
        if lane < 0:
            return True
        name = self._missing_lane(routes, lane, 0)
        problem = f"but edge '{name}' has no such lane for road vehicles" if name else ""
        lanes = self._index.network.lanes
        for vtype in self._options(self._type_options, types).rows:
            for route in self._options(self._route_options, routes).rows if not name else ():
                row = self._index.lane_table[self.routes.edges(route)[0], lane]
                if not int(lanes[row]["permissions"]) & self.types.permissions(vtype):
                    problem = f"but the lane is closed to type '{self.types.names[vtype]}'"
            if problem and not self._tolerates(vtype, user):
                raise user.error(
                    f"has departLane='{lane}', {problem}",
                    "write departLane='best', or set traffic.on_bad_route = skip",
                )
        return not problem

    def _check_ids(self) -> None:
        """Refuse vehicles with the name of a flow's vehicle."""
        flows = {name: row for row, name in enumerate(self.ids) if self._elements[row]["flow"]}
        for row, name in enumerate(self.ids):
            stem, _, number = name.rpartition(".")
            if stem in flows and number.isascii() and number.isdigit():
                if (
                    int(number[:18]) < self._elements[flows[stem]]["number"]
                    and not (self._elements[row]["flow"])
                ):
                    raise self._stub(self._elements, self.ids, row).error(
                        f"has the name of a vehicle of the flow '{stem}'", "ids must be unique"
                    )

    def _place_stops(self, lists: list[list[Element]]) -> None:
        """Replace the numbers of lists of stops by STOP rows along each route."""
        placed: dict[tuple[int, int, bool], tuple[int, int]] = {}
        for row in np.flatnonzero(self._elements["first_stop"] >= 0):
            element = self._elements[row]
            stops = lists[int(element["first_stop"])]
            routes = self._options(self._route_options, int(element["routes"])).rows
            if len(routes) > 1:
                what = "stops of a vehicle with a choice of routes are left out"
                self._report.tolerate(what, stops[0].place)
                element["first_stop"] = -1
                continue
            key = (int(element["first_stop"]), routes[0], bool(element["flow"]))
            if key not in placed:
                until_from = UNTIL_FLOW if element["flow"] else UNTIL_ABSOLUTE
                placed[key] = self.routes.stops_with(routes[0], stops, until_from)
            element["first_stop"], element["num_stops"] = placed[key]

    def _depart_at_stops(self) -> None:
        """Replace `departPos="stop"` by the end of the first stop, or by the start of the lane."""
        elements = self._elements
        rows = np.flatnonzero(elements["depart_pos_code"] == POS_STOP)
        if not len(rows):
            return
        routes, route_edges, stops = self.routes.arrays()
        lane_table = self._index.lane_table
        for row in rows:
            element = elements[row]
            element["depart_pos_code"] = POS_BASE
            options = self._options(self._route_options, int(element["routes"])).rows
            source = element if element["first_stop"] >= 0 else routes[options[0]]
            edge = int(route_edges[routes[options[0]]["first_edge"]])
            if len(options) > 1 or source["num_stops"] == 0:
                continue
            stop = stops[source["first_stop"]]
            lane = int(stop["lane"])
            if self._index.network.lanes[lane]["edge"] != edge:
                continue
            element["depart_pos_code"] = POS_GIVEN
            element["depart_pos"] = float(stop["end"]) / self._index.scale(lane)
            element["depart_lane"] = int(np.flatnonzero(lane_table[edge] == lane)[0])
            element["depart_speed_code"], element["depart_speed"] = SPEED_GIVEN, 0.0
