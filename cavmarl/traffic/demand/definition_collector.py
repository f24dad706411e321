"""`DefinitionCollector`: collects the definitions of demand files in compact form.

Names are resolved after all files have been read, so unlike in SUMO, definitions may follow their
use. Equal content is stored once: routes, types and lists of stops become numbers, and each vehicle
becomes one row of numbers.

Departure times of flows follow SUMO's rules.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.traffic.demand.demand_records import (
    CODES,
    ELEMENT,
    FLOW_EXPONENTIAL,
    FLOW_PROBABILITY,
    FLOW_REGULAR,
    LANE_BEST,
    LANE_CURRENT,
    MAX_NUMBER,
    POS_BASE,
    POS_GIVEN,
    POS_MAX,
    SPEED_AVERAGE,
    SPEED_CURRENT,
)
from cavmarl.traffic.demand.element import MAX_TIME_MS, DemandReport, Element
from cavmarl.traffic.demand.rerouting_device import device
from cavmarl.traffic.demand.xml_files import STOPPING_PLACES

DAY_MS = 86_400_000  # duration of a flow without an end, as in SUMO
MIN_RATE = 1e-12  # 1/s, lower limit of rates

_EXPONENTIAL = re.compile(r"exp\(([^()]*)\)")
_PER_HOUR = ("vehsPerHour", "perHour")
_RATES = ("period", *_PER_HOUR, "probability")


class Timing(NamedTuple):
    """Fields of ELEMENT, in its order."""

    pattern: int
    begin_ms: int
    end_ms: int
    period_ms: int
    number: int
    rate: float

    def expected(self, begin_ms: int, end_ms: int) -> float:
        """Return the mean number of vehicles that depart in a span of time."""
        span = max(min(self.end_ms, end_ms) - max(self.begin_ms, begin_ms), 0)
        if self.pattern != FLOW_REGULAR:
            return min(span / 1000.0 * self.rate, float(self.number))
        if self.period_ms == 0:
            return float(self.number)
        return float(min(-(-span // self.period_ms), self.number))


def single_timing(depart_ms: int) -> Timing:
    return Timing(FLOW_REGULAR, depart_ms, depart_ms + 1, 1, 1, 0.0)


def flow_timing(element: Element, horizon_ms: int) -> Timing:
    """Return the timing of a <flow>.

    `horizon_ms`: end of a flow without an `end`; -1: one day after its begin.

    Raises DemandError: there is not exactly one rate, the rate is not positive, or the flow ends
    before it begins.
    """
    rates = [key for key in _RATES if key in element.attrs]
    if len(rates) > 1:
        raise element.error(f"has {' and '.join(rates)}", "keep only one of them")
    if not rates and "number" not in element.attrs:
        raise element.error("has no rate", f"give it one of {', '.join(_RATES)} or number")
    if rates and "number" in element.attrs and "end" in element.attrs:
        raise element.error(f"has {rates[0]}, number and end", "keep only two of them")
    begin = element.time_ms("begin", 0)
    default_end = begin + DAY_MS if horizon_ms < 0 else max(horizon_ms, begin)
    end = element.time_ms("end", default_end)
    if end < begin:
        raise element.error("ends before it begins", "let end be after begin")
    number = element.whole("number", MAX_NUMBER, least=0)
    if not rates:
        period = (end - begin) // max(number, 1)
        # The last vehicle departs before the end despite rounding.
        return Timing(FLOW_REGULAR, begin, max(end, begin + 1), period, number, 0.0)
    if "number" in element.attrs:
        end = MAX_TIME_MS
    return Timing(*_rate(element, rates[0], begin, end, number))


def _rate(
    element: Element, key: str, begin: int, end: int, number: int
) -> tuple[int, int, int, int, int, float]:
    exponential = _EXPONENTIAL.fullmatch(element.attrs[key].strip()) if key == "period" else None
    if exponential:
        rate = element.with_attrs(period=exponential[1]).number("period", 0.0, above=MIN_RATE)
        return FLOW_EXPONENTIAL, begin, end, 0, number, rate
    if key == "probability":
        chance = element.number(key, 0.0, above=MIN_RATE, most=1.0)
        return FLOW_PROBABILITY, begin, end, 0, number, chance
    if key == "period":
        period = element.time_ms(key)
    else:
        period = int(min(3_600_000.0 / element.number(key, 0.0, above=0.0) + 0.5, MAX_TIME_MS))
    if period <= 0:
        raise element.error(
            f"has {key}='{element.attrs[key]}'", "the maximum is one vehicle per millisecond"
        )
    return FLOW_REGULAR, begin, end, period, number, 0.0


_NO_DEPARTURE = ("triggered", "containerTriggered", "split", "now")
_WAY = ("from", "to", "via", "fromJunction", "toJunction", "viaJunctions", "fromTaz", "toTaz")
_OFF_MAP = ("fromXY", "toXY", "viaXY", "fromLonLat", "toLonLat", "viaLonLat")
_UNUSED = ("departEdge", "arrivalEdge", "departPosLat", "arrivalPosLat", "insertionChecks")
# These attributes are checked but have no effect: a trip ends near the end of its last edge. The
# values are defaults.
_ARRIVAL = {"arrivalLane": "current", "arrivalPos": "max", "arrivalSpeed": "current"}
# Attributes of routes and stops that do not change the route.
_LOOKS = frozenset(("color", "cost", "savings", "exitTimes", "routeLength", "reason"))
# SUMO's old names, which files of SUMO still contain.
_RENAMED = {"beginLane": "departLane", "beginPos": "departPos", "beginSpeed": "departSpeed"}


class DefinitionCollector:
    """Definitions by id, and one row for each vehicle, trip and flow.

    Attributes:
        named: elements by kind and id: vType, route, their distributions, stopping places,
            rerouters.
        routes: elements that define a route, one per definition: a <route>, or a trip.
        types: the names of used types, in order of first use.
        stops: lists of <stop> elements; equal lists are stored once.
        ids: of vehicles, trips and flows, by row.
    """

    def __init__(
        self,
        report: DemandReport,
        begin_ms: int,
        end_ms: int,
        max_departures: int,
        departs: Mapping[str, str],  # default attributes of departures
        scale: float = 1.0,  # number of vehicles per departure
    ) -> None:
        self.report = report
        self.named: dict[str, dict[str, Element]] = {}
        self.routes: dict[tuple[object, ...], Element] = {}
        self.types: dict[str, Element] = {}
        self.stops: dict[tuple[object, ...], list[Element]] = {}
        self.ids: list[str] = []
        self._route_number: dict[tuple[object, ...], int] = {}
        self._stops_number: dict[tuple[object, ...], int] = {}
        self._type_number: dict[str, int] = {}
        self._seen: set[tuple[bool, str]] = set()
        self._rows = array("d")
        self._begin_ms, self._end_ms = begin_ms, end_ms
        self._max_departures = max_departures
        self._departs = departs
        self._scale = scale
        self._departures = 0.0
        self._latest_ms: dict[str, int] = {}  # latest departure by file

    def take(self, element: Element) -> None:
        """Store one definition.

        Raises DemandError: an attribute is missing or wrong, or an id occurs twice; CapacityError:
        there are more departures than the cap.
        """
        if element.name in ("vehicle", "trip", "flow"):
            self._take_vehicles(element)
            return
        kind = "stopping place" if element.name in STOPPING_PLACES else element.name
        self._name(kind, element)
        if element.name == "vTypeDistribution":
            for child in element.children:
                if child.name == "vType" and "refId" not in child.attrs:
                    self._name("vType", child)
        elif element.name == "routeDistribution":
            for child in element.children:
                if child.name == "route" and "id" in child.attrs:
                    self._name("route", child)

    def elements(self) -> NDArray[np.void]:
        """Return ELEMENT (num_elements,); types, routes and first_stop index the lists here."""
        table = np.frombuffer(self._rows, dtype=np.float64).reshape(-1, len(ELEMENT.names or ()))
        elements = np.zeros(len(self.ids), dtype=ELEMENT)
        for column, name in enumerate(ELEMENT.names or ()):
            elements[name] = table[:, column]
        return elements

    def _name(self, kind: str, element: Element) -> None:
        name = element.text("id")
        # An id may name either a type or a type distribution; the same applies to routes.
        for other in (kind, f"{kind}Distribution", kind.removesuffix("Distribution")):
            known = self.named.get(other, {}).get(name)
            if known is not None:
                raise element.error(
                    f"has the id of the <{known.name}> in {known.place}", "ids must be unique"
                )
        self.named.setdefault(kind, {})[name] = element

    def _take_vehicles(self, element: Element) -> None:
        name = element.text("id")
        flow = element.name == "flow"
        if (flow, name) in self._seen:
            raise element.error("occurs twice", "ids must be unique")
        self._seen.add((flow, name))
        start = element.attrs.get("begin" if flow else "depart", "").strip()
        if start in _NO_DEPARTURE:
            what = f"{element.name} that departs '{start}' is left out"
            self.report.tolerate(what, element.place)
            return
        for old, new in _RENAMED.items():
            if old in element.attrs:
                element.attrs.setdefault(new, element.attrs.pop(old))
        if self._departs:
            element.attrs = {**self._departs, **element.attrs}
        for key in _UNUSED:
            if key in element.attrs:
                what = f"attribute {key} of {element.name} is not modelled"
                self.report.tolerate(what, element.place)
        for key, default in _ARRIVAL.items():
            if element.attrs.get(key, default) != default:
                what = f"{key} of {element.name} has no effect: trips end near the last edge's end"
                self.report.tolerate(what, element.place)
        timing = self._timing(element, flow, start)
        self._check_room(element, timing)
        chance, period_ms = device(element)
        if _has_no_route(element):
            chance = 1.0  # as in SUMO, its route is searched with the speeds at its departure
        row: Iterable[float] = (
            self.report.files.index(element.path),
            element.line,
            flow,
            *timing,
            self._type(element),
            self._route(element),
            self._stops(element),
            0,
            chance,
            period_ms,
            *_entry_and_exit(element),
        )
        self.ids.append(name)
        self._rows.extend(row)

    def _timing(self, element: Element, flow: bool, start: str) -> Timing:
        if flow:
            return flow_timing(element, self._end_ms)
        depart = self._begin_ms if start == "begin" else element.time_ms("depart")
        latest = self._latest_ms.get(element.path, 0)
        if depart < latest:
            what = "vehicle departs before one that precedes it in the file: sorted (SUMO drops it)"
            self.report.tolerate(what, element.place)
        self._latest_ms[element.path] = max(latest, depart)
        return single_timing(depart)

    def _check_room(self, element: Element, timing: Timing) -> None:
        end = self._end_ms if self._end_ms >= 0 else timing.end_ms
        self._departures += self._scale * timing.expected(self._begin_ms, end)
        if self._departures > self._max_departures:
            raise element.error(
                f"makes more than {self._max_departures} departures, including earlier elements",
                "cut the demand, or raise max_departures if there is memory for it",
                CapacityError,
            )

    def _type(self, element: Element) -> int:
        name = element.attrs.get("type", "DEFAULT_VEHTYPE").strip()
        if name not in self._type_number:
            self._type_number[name] = len(self.types)
            self.types[name] = Element(element.name, element.attrs, element.path, element.line)
        return self._type_number[name]

    def _route(self, element: Element) -> int:
        inside = _routes_inside(element)
        if len(inside) > 1:
            raise element.error("holds two routes", "put both into a <routeDistribution>")
        if inside:
            source = inside[0]
            key: tuple[object, ...] = _key(source)
        elif "route" in element.attrs and element.name != "trip":
            source = Element(element.name, element.attrs, element.path, element.line)
            key = ("named", element.text("route"))
        elif element.name == "vehicle":
            raise element.error("has no route", "give it the attribute 'route' or a <route> inside")
        else:
            source = element
            stops = self._stops(element) if "via" not in element.attrs else -1
            key = ("way", stops, *(element.attrs.get(k) for k in (*_WAY, *_OFF_MAP)))
        if key not in self._route_number:
            self._route_number[key] = len(self.routes)
            self.routes[key] = source
        return self._route_number[key]

    def _stops(self, element: Element) -> int:
        stops = [child for child in element.children if child.name == "stop"]
        if not stops:
            return -1
        key = tuple(_key(stop) for stop in stops)
        if key not in self._stops_number:
            self._stops_number[key] = len(self.stops)
            self.stops[key] = stops
        return self._stops_number[key]


def _routes_inside(element: Element) -> list[Element]:
    return [child for child in element.children if child.name in ("route", "routeDistribution")]


def _has_no_route(element: Element) -> bool:
    """Return whether a <trip> or <flow> has only places, so that its route must be searched."""
    named = "route" in element.attrs and element.name != "trip"
    return not named and not _routes_inside(element)


def _key(element: Element) -> tuple[object, ...]:
    """Return the content of an element that defines a route, without its place in the file."""
    items = (item for item in element.attrs.items() if item[0] not in _LOOKS)
    return (element.name, *items, *(_key(child) for child in element.children))


def _entry_and_exit(element: Element) -> tuple[float, ...]:
    """Return the fields of ELEMENT for entering and leaving, with SUMO 1.28's defaults."""
    return (
        _lane(element, "departLane", LANE_BEST),
        *_coded(element, "departPos", POS_BASE),
        *_coded(element, "departSpeed", SPEED_AVERAGE, least=0.0),
        _lane(element, "arrivalLane", LANE_CURRENT),
        *_coded(element, "arrivalPos", POS_MAX),
        *_coded(element, "arrivalSpeed", SPEED_CURRENT, least=0.0),
        element.number("speedFactor", math.nan, above=0.0),
    )


def _lane(element: Element, key: str, default: int) -> int:
    code = CODES[key].get(element.attrs.get(key, ""))
    return element.whole(key, default, least=0, words=CODES[key]) if code is None else code


def _coded(element: Element, key: str, default: int, least: float = -math.inf) -> tuple[int, float]:
    """Return the code of a keyword, or the code for a number together with the number."""
    if key not in element.attrs:
        return default, 0.0
    code = CODES[key].get(element.attrs[key])
    if code is not None:
        return code, 0.0
    # POS_GIVEN and SPEED_GIVEN have the same value.
    return POS_GIVEN, element.number(key, 0.0, least=least, words=CODES[key])
