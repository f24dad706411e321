"""<rerouter>s: rules that give vehicles another route, and temporary closures of edges."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.core.records import record
from cavmarl.driving.vehicle_types import ALL_PERMISSIONS, NEAREST_CLASS, NO_ROAD_CLASSES
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.traffic.demand.demand_records import MAX_WEIGHT, Choices, Options, weighted
from cavmarl.traffic.demand.element import MAX_TIME_MS, DemandReport, Element, near
from cavmarl.traffic.demand.map_index import MapIndex
from cavmarl.traffic.demand.route_records import RouteTable

MAX_INTERVALS = 30_000  # each interval has its own random numbers
MAX_RULES = 300_000  # each pair of an interval and an edge is a rule
KEEP_DESTINATION = -1  # in place of an EDGE row
_ACTED_ON = ("closingReroute", "destProbReroute", "routeProbReroute")
_NOT_MODELLED = ("timeThreshold", "radius", "file")

RULE = record(
    ("begin_s", np.float64),  # time of the simulation
    ("end_s", np.float64),
    ("chance", np.float64),  # probability that a vehicle follows the rule
    ("edge", np.int32),  # EDGE row on which the rule applies
    ("closes", np.bool_),  # whether it applies only to vehicles whose route uses a closed edge
    ("goals", np.int32),  # choice among EDGE rows or KEEP_DESTINATION; -1: none
    ("routes", np.int32),  # choice among ROUTE rows; -1: none
    ("interval", np.int32),  # equal for all edges of an interval, so that vehicles draw once
)

CLOSING = record(
    ("begin_s", np.float64),
    ("end_s", np.float64),
    ("edge", np.int32),  # EDGE row
    ("classes", np.int64),  # bits of the classes that may not use the edge
)


@dataclass(frozen=True, eq=False)
class Rerouters:
    """The rerouters of all files."""

    rules: NDArray[np.void]  # RULE (n,), one per interval and edge, in the order of the files
    types: NDArray[np.bool_]  # (num_intervals, num_types) the VTYPE rows of an interval
    closings: NDArray[np.void]  # CLOSING (m,)
    goals: Choices  # choices of RULE["goals"]
    routes: Choices  # choices of RULE["routes"]

    def __post_init__(self) -> None:
        for array in (self.rules, self.types, self.closings):
            array.setflags(write=False)

    def content(self) -> bytes:
        parts = [self.types, *(self.rules[name] for name in RULE.names or ())]
        parts += [self.closings[name] for name in CLOSING.names or ()]
        for choices in (self.goals, self.routes):
            parts += [choices.start, choices.rows, choices.upper]
        return b"".join(part.tobytes() for part in parts)


def read_rerouters(
    elements: Sequence[Element],
    index: MapIndex,
    routes: RouteTable,
    type_ids: Sequence[str],
    known_types: Collection[str],
    report: DemandReport,
) -> Rerouters:
    """Read the rerouters of files; ignored parts are counted in `report`.

    `elements`: <rerouter>s with their children. `routes`: receives the routes that they name.
    `type_ids`: names by VTYPE row. `known_types`: names of all types, including types that do not
    use roads.

    Raises DemandError: an edge, route, type, time or probability is invalid; CapacityError: there
    are more than `MAX_INTERVALS` intervals, or more than `MAX_RULES` pairs of interval and edge.
    """
    reader = _Reader(index, routes, type_ids, known_types, report)
    for element in elements:
        reader.take(element)
    return reader.rerouters()


class _Reader:
    def __init__(
        self,
        index: MapIndex,
        routes: RouteTable,
        type_ids: Sequence[str],
        known_types: Collection[str],
        report: DemandReport,
    ) -> None:
        self._index = index
        self._table = routes
        self._type_ids = list(type_ids)
        self._known_types = known_types
        self._report = report
        self._rules: list[tuple[float, float, float, int, bool, int, int, int]] = []
        self._types: list[NDArray[np.bool_]] = []
        self._closings: list[tuple[float, float, int, int]] = []
        self._goals: list[Options] = []
        self._routes: list[Options] = []

    def rerouters(self) -> Rerouters:
        types = np.zeros((len(self._types), len(self._type_ids)), dtype=np.bool_)
        for row, mine in enumerate(self._types):
            types[row] = mine
        return Rerouters(
            rules=np.array(self._rules, dtype=RULE),
            types=types,
            closings=np.array(self._closings, dtype=CLOSING),
            goals=Choices(self._goals),
            routes=Choices(self._routes),
        )

    def take(self, element: Element) -> None:
        edges = self._index.edges(element.text("edges").replace(";", " "), element)
        chance = element.number("probability", 1.0, least=0.0, most=1.0)
        types = self._types_of(element)
        for key in _NOT_MODELLED:
            if key in element.attrs:
                what = f"rerouter with {key} is left out"
                self._report.tolerate(what, element.place)
                return
        if element.flag("off", False):
            return
        for child in element.children:
            if child.name == "interval":
                self._interval(child, edges, chance, types)
            elif child.name != "param":
                self._report.tolerate(f"<{child.name}> of rerouter is not read", child.place)

    def _types_of(self, element: Element) -> NDArray[np.bool_]:
        names = element.attrs.get("vTypes", "").split()
        for name in names:
            if name not in self._known_types:
                raise element.error(
                    f"names the unknown type '{name}'", near(name, self._known_types)
                )
        return np.array([not names or name in names for name in self._type_ids], dtype=np.bool_)

    def _interval(
        self, interval: Element, edges: Sequence[int], chance: float, types: NDArray[np.bool_]
    ) -> None:
        begin_ms = interval.time_ms("begin", 0)
        end_ms = interval.time_ms("end", MAX_TIME_MS)
        if end_ms < begin_ms:
            raise interval.error("ends before it begins", "let end be after begin")
        if len(self._types) == MAX_INTERVALS or len(self._rules) + len(edges) > MAX_RULES:
            raise interval.error(
                f"exceeds {MAX_INTERVALS} intervals of all rerouters, or {MAX_RULES} pairs of "
                "interval and edge",
                "use fewer intervals or edges",
                CapacityError,
            )
        span = begin_ms / 1000.0, end_ms / 1000.0
        parts: dict[str, list[Element]] = {name: [] for name in _ACTED_ON}
        for child in interval.children:
            if child.name in parts:
                parts[child.name].append(child)
            else:
                self._report.tolerate(f"<{child.name}> of rerouter has no effect here", child.place)
        for closing in parts["closingReroute"]:
            edge = self._index.edge(closing.text("id"), closing)
            self._closings.append((*span, edge, _closed_classes(closing)))
        goals = self._options(interval, parts["destProbReroute"], self._goals, self._goal)
        routes = self._options(interval, parts["routeProbReroute"], self._routes, self._route)
        closes = bool(parts["closingReroute"])
        if not closes and goals < 0 and routes < 0:
            return
        for edge in edges:
            number = len(self._types)
            self._rules.append((*span, chance, edge, closes, goals, routes, number))
        self._types.append(types)

    def _options(
        self,
        interval: Element,
        children: Sequence[Element],
        lists: list[Options],
        row_of: Callable[[Element], int],
    ) -> int:
        """Add a choice and return its number, or -1 if it would be empty."""
        found = []
        for child in children:
            weight = child.number("probability", 1.0, least=0.0, most=MAX_WEIGHT)
            if child.attrs.get("id") == "terminateRoute":
                what = "destProbReroute terminateRoute is treated as keepDestination"
                self._report.tolerate(what, child.place)
            found.append((row_of(child), weight))
        if not found:
            return -1
        lists.append(weighted(interval, found))
        return len(lists) - 1

    def _goal(self, child: Element) -> int:
        name = child.text("id")
        if name in ("keepDestination", "terminateRoute"):
            return KEEP_DESTINATION
        return self._index.edge(name, child)

    def _route(self, child: Element) -> int:
        named = Element("vehicle", {"route": child.text("id")}, child.path, child.line)
        return self._table.options(named).rows[0]


def _closed_classes(closing: Element) -> int:
    """Return the bits of the classes to which an edge is closed; all classes by default."""
    if "allow" in closing.attrs and "disallow" in closing.attrs:
        raise closing.error("has allow and disallow", "keep only one of them")
    for key in ("allow", "disallow"):
        if key in closing.attrs:
            bits = _classes(closing, closing.attrs[key].split())
            return bits if key == "disallow" else ALL_PERMISSIONS & ~bits
    return ALL_PERMISSIONS


def _classes(closing: Element, names: Sequence[str]) -> int:
    bits = 0
    for name in names:
        if name == "all":
            return ALL_PERMISSIONS
        if name in NEAREST_CLASS:
            bits |= 1 << VEHICLE_CLASSES.index(NEAREST_CLASS[name])
        elif name not in NO_ROAD_CLASSES:
            known = [*NEAREST_CLASS, *NO_ROAD_CLASSES]
            raise closing.error(f"names the unknown class '{name}'", near(name, known))
    return bits
