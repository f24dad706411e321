"""Routes: edges, trips and distributions converted to ROUTE records, each stored once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError, CavmarlError
from cavmarl.traffic.demand.demand_records import (
    MAX_WEIGHT,
    ROUTE,
    STOP,
    UNTIL_DEPARTURE,
    Options,
    listed,
    weighted,
)
from cavmarl.traffic.demand.element import DemandReport, Element, near
from cavmarl.traffic.demand.map_index import MapIndex
from cavmarl.traffic.demand.xml_files import STOPPING_PLACES

_NOT_MODELLED = ("triggered", "containerTriggered", "expected", "speed", "split", "join", "jump")


class Stop(NamedTuple):
    """The fields of STOP, in its order."""

    lane: int
    at_edge: int
    start: float
    end: float
    duration: float
    until: float
    until_from: int
    parking: bool


class StopReader:
    """Finds the lanes of stops and their places in routes.

    Attributes:
        places: elements of bus stops, parking areas, … by id.
        skip: whether stops off the route are left out and counted, instead of refused.
    """

    def __init__(
        self, index: MapIndex, places: dict[str, Element], report: DemandReport, skip: bool
    ) -> None:
        self.places = places
        self.skip = skip
        self._index = index
        self._report = report

    def edges(self, stops: Sequence[Element]) -> list[int]:
        """Return the EDGE rows of stops, over which a trip with these stops has to drive."""
        lanes = self._index.network.lanes
        return [int(lanes[self._lane(stop)]["edge"]) for stop in stops]

    def along(
        self, stops: Sequence[Element], edges: Sequence[int], exact: bool, until_from: int
    ) -> list[Stop]:
        """Return stops in the order in which a route reaches them.

        `stops`: the <stop> elements in the order of the file. `edges`: EDGE rows of the route.
        `exact`: whether the edges are the whole route, or waypoints.

        Raises DemandError: a stop is not on the route beyond the previous stop.
        """
        found: list[Stop] = []
        at, end = 0, -1.0
        lanes = self._index.network.lanes
        for element in stops:
            stop = self._stop(element, until_from)
            if stop is None:
                continue
            if exact:
                edge = int(lanes[stop.lane]["edge"])
                first = at + 1 if at < len(edges) and edges[at] == edge and stop.end < end else at
                place = next((k for k in range(first, len(edges)) if edges[k] == edge), -1)
                if place < 0:
                    self._refuse(element, edge)
                    continue
                at, end = place, stop.end
                stop = stop._replace(at_edge=place)
            found.append(stop)
        return found

    def _refuse(self, element: Element, edge: int) -> None:
        if not self.skip:
            name = self._index.network.edge_ids[edge]
            raise element.error(
                f"on edge '{name}' is off the route, or before the previous stop",
                "put stops in the order of the route, or set traffic.on_bad_route = skip",
            )
        self._report.tolerate("stop off its route is left out", element.place)

    def _source(self, stop: Element) -> Element:
        """Return the element that has lane and positions: the stop, or its stopping place."""
        for kind in sorted(STOPPING_PLACES & stop.attrs.keys()):
            name = stop.attrs[kind]
            place = self.places.get(name)
            if place is None or place.name != kind:
                known = [name for name, place in self.places.items() if place.name == kind]
                raise stop.error(f"names the unknown {kind} '{name}'", near(name, known))
            return place
        return stop

    def _lane(self, stop: Element) -> int:
        source = self._source(stop)
        if "lane" not in source.attrs and "edge" in source.attrs:
            edge = self._index.edge(source.text("edge"), source)
            return self._index.open_lane(edge, 1)
        return self._index.lane(source.text("lane"), source)

    def _stop(self, stop: Element, until_from: int) -> Stop | None:
        for key in _NOT_MODELLED:
            if key in stop.attrs:
                self._report.tolerate(f"attribute {key} of stop is not modelled", stop.place)
        duration = stop.time_ms("duration", -1)
        until = stop.time_ms("until", -1)
        if duration < 0 and until < 0:
            self._report.tolerate("stop without duration and until is left out", stop.place)
            return None
        lane = self._lane(stop)
        start, end = self._span(self._source(stop), lane)
        scale = self._index.scale(lane)
        parks = stop.attrs.get("parking", "") == "opportunistic" or stop.flag("parking", False)
        return Stop(
            lane=lane,
            at_edge=-1,
            start=start * scale,
            end=end * scale,
            duration=max(duration, 0) / 1000.0,
            until=until / 1000.0 if until >= 0 else -1.0,
            until_from=until_from,
            parking=parks or "parkingArea" in stop.attrs,
        )

    def _span(self, source: Element, lane: int) -> tuple[float, float]:
        """Return start and end in m on SUMO's lane; negative positions are from the lane's end."""
        network = self._index.network
        length = float(network.edges[network.lanes[lane]["edge"]]["length_m"])
        end = source.number("endPos", length)
        end = end + length if end < 0.0 else end
        start = source.number("startPos", max(0.0, end - 0.2))
        start = start + length if start < 0.0 else start
        if source.flag("friendlyPos", False):
            end = min(max(end, 0.0), length)
            start = min(max(start, 0.0), end)
        # Allow for rounding: SUMO writes positions with two decimals.
        if not 0.0 <= start <= end <= length + 0.01:
            raise self._bad_span(source, length)
        return start, min(end, length)

    def _bad_span(self, source: Element, length: float) -> CavmarlError:
        return source.error(
            f"has startPos='{source.attrs.get('startPos', '')}' and "
            f"endPos='{source.attrs.get('endPos', '')}' on a lane of {length:g} m",
            "let 0 <= startPos <= endPos <= the lane's length, or set friendlyPos='true'",
        )


MAX_ROUTE_EDGES = 50_000_000  # maximum total number of edges of all routes

# Attributes that name a place, not an edge. As in SUMO, `from` and `to` override the attributes in
# the first tuple.
_REPLACED_BY_EDGES = ("Junction", "Taz")
_COORDINATES = ("XY", "LonLat")


class RouteTable:
    """ROUTE, STOP and edge rows, added one by one; equal routes share a row.

    Attributes:
        stop_reader: finds the places of stops.
        names: id by ROUTE row, "" for routes without an id.
    """

    def __init__(
        self,
        index: MapIndex,
        named: dict[str, dict[str, Element]],
        stop_reader: StopReader,
        report: DemandReport,
    ) -> None:
        self.stop_reader = stop_reader
        self.names: list[str] = []
        self._index = index
        self._routes = named.get("route", {})
        self._distributions = named.get("routeDistribution", {})
        self._report = report
        self._row: dict[tuple[object, ...], int] = {}
        self._rows: list[tuple[int, int, bool, int, int]] = []
        self._edges: list[tuple[int, ...]] = []
        self._num_edges = 0
        self._stops: list[Stop] = []

    def options(self, source: Element) -> Options:
        """Return the routes that an element defines or names, as a choice.

        Args:
            source: a <route>, a <routeDistribution>, a trip or flow with `from` and `to`, or a
                vehicle or flow that names a route.

        Raises:
            DemandError: an edge, route or stop does not exist, or the choice is empty.
        """
        if source.name == "route":
            return Options((self._route(source),), (1.0,))
        if source.name == "routeDistribution":
            return self._distribution(source)
        if "route" not in source.attrs or source.name == "trip":
            return Options((self._way(source),), (1.0,))
        name = source.text("route")
        if name in self._routes:
            return Options((self._route(self._routes[name]),), (1.0,))
        if name in self._distributions:
            return self._distribution(self._distributions[name])
        known = [*self._routes, *self._distributions]
        raise source.error(f"names the unknown route '{name}'", near(name, known))

    def edges(self, row: int) -> tuple[int, ...]:
        return self._edges[row]

    def exact(self, row: int) -> bool:
        """Return whether a route is given by all its edges, and not only by waypoints."""
        return self._rows[row][2]

    def stops_with(self, row: int, stops: Sequence[Element], until_from: int) -> tuple[int, int]:
        """Return STOP rows (first, number) of a vehicle's own stops and the stops of its route."""
        own = self.stop_reader.along(stops, self._edges[row], self.exact(row), until_from)
        _, _, exact, first, number = self._rows[row]
        both = self._stops[first : first + number] + own
        if exact:
            both.sort(key=lambda stop: (stop.at_edge, stop.end))
        return self._store_stops(both)

    def arrays(self) -> tuple[NDArray[np.void], NDArray[np.int32], NDArray[np.void]]:
        """Return ROUTE (R,), their EDGE rows, and STOP (num_stops,)."""
        edges = np.fromiter((edge for edges in self._edges for edge in edges), dtype=np.int32)
        routes = np.array(self._rows, dtype=ROUTE)
        return routes, edges, np.array(self._stops, dtype=STOP)

    def _store_stops(self, stops: list[Stop]) -> tuple[int, int]:
        first = len(self._stops)
        self._stops.extend(stops)
        return first, len(stops)

    def _store(self, edges: tuple[int, ...], exact: bool, stops: list[Stop], name: str) -> int:
        key = (edges, exact, tuple(stops))
        row = self._row.get(key)
        if row is None:
            row = self._row[key] = len(self._rows)
            self._rows.append((self._num_edges, len(edges), exact, *self._store_stops(stops)))
            self._edges.append(edges)
            self._num_edges += len(edges)
            self.names.append(name)
        return row

    def _route(self, source: Element) -> int:
        edges = self._index.edges(source.text("edges"), source)
        repeat = source.whole("repeat", 0, least=0)
        if self._num_edges + len(edges) * (repeat + 1) > MAX_ROUTE_EDGES:
            raise source.error("is too long", "lower 'repeat'", CapacityError)
        stops = [child for child in source.children if child.name == "stop"]
        edges *= repeat + 1
        placed = self.stop_reader.along(stops * (repeat + 1), edges, True, UNTIL_DEPARTURE)
        return self._store(edges, True, placed, source.attrs.get("id", ""))

    def _way(self, source: Element) -> int:
        """Store a trip: the edges to drive over in order, without immediate repetitions."""
        used = [f"{end}{place}" for end in ("from", "to", "via") for place in _COORDINATES]
        used += [
            f"{end}{place}"
            for end in ("from", "to")
            for place in _REPLACED_BY_EDGES
            if end not in source.attrs
        ]
        for key in (*used, "viaJunctions"):
            if key in source.attrs:
                raise source.error(
                    f"has the attribute {key}",
                    "name edges with 'from', 'via' and 'to' (duarouter converts places to edges)",
                )
        stops = [child for child in source.children if child.name == "stop"]
        at_stops = self.stop_reader.edges(stops)
        via = source.attrs.get("via", "")
        between = list(self._index.edges(via, source)) if via.strip() else at_stops
        ends = {
            key: self._index.edge(source.text(key), source)
            for key in ("from", "to")
            if key in source.attrs or not at_stops
        }
        start = [ends["from"]] if "from" in ends else at_stops[:1]
        goal = [ends["to"]] if "to" in ends else at_stops[-1:]
        passed = [*start, *between, *goal]
        edges = (passed[0], *(b for a, b in pairwise(passed) if a != b))
        return self._store(edges, False, [], "")

    def _distribution(self, source: Element) -> Options:
        found: list[tuple[int, float]] = []
        for child in source.children:
            if child.name != "route":
                continue
            member = child
            if "refId" in child.attrs:
                member = self._named_route(child.text("refId"), child)
            found.append(
                (self._route(member), child.number("probability", 1.0, least=0.0, most=MAX_WEIGHT))
            )
        for name, weight in listed(source, "routes"):
            member = self._named_route(name, source)
            own = member.number("probability", 1.0, least=0.0, most=MAX_WEIGHT)
            found.append((self._route(member), own if weight is None else weight))
        return weighted(source, found)

    def _named_route(self, name: str, source: Element) -> Element:
        if name not in self._routes:
            raise source.error(f"names the unknown route '{name}'", near(name, self._routes))
        return self._routes[name]
