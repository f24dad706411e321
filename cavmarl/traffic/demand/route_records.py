"""Routes: from edges, trips and distributions to ROUTE records, each stored once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
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
from cavmarl.traffic.demand.stops import Stop, StopReader

MAX_ROUTE_EDGES = 50_000_000  # of all routes together

_PLACES = ("Junction", "Taz", "XY", "LonLat")


class RouteTable:
    """ROUTE, STOP and edge rows as they are found; equal routes share a row.

    Attributes:
        stop_reader: places the stops.
        names: id by ROUTE row, "" for routes without one.
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
        """The routes to choose from that an element says.

        Args:
            source: a <route>, a <routeDistribution>, a trip or flow with `from` and `to`, or a
                vehicle or flow that names a route.

        Raises:
            DemandError: edges, routes or stops that do not exist; nothing to choose from.
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
        """Whether a route is its edges, or a way to be found between them."""
        return self._rows[row][2]

    def stops_with(self, row: int, stops: Sequence[Element], until_from: int) -> tuple[int, int]:
        """STOP rows (first, number) of a vehicle's own stops together with those of its route."""
        own = self.stop_reader.along(stops, self._edges[row], self.exact(row), until_from)
        _, _, exact, first, number = self._rows[row]
        both = self._stops[first : first + number] + own
        if exact:
            both.sort(key=lambda stop: (stop.at_edge, stop.end))
        return self._store_stops(both)

    def arrays(self) -> tuple[NDArray[np.void], NDArray[np.int32], NDArray[np.void]]:
        """ROUTE (R,), the EDGE rows that they point into, STOP (num_stops,)."""
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
        """A trip: the edges to pass through, in order, each named once in a row."""
        for place in _PLACES:
            if f"from{place}" in source.attrs or f"to{place}" in source.attrs:
                raise source.error(
                    f"goes from or to a {place}", "name edges with 'from' and 'to' (duarouter)"
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
