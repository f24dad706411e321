"""Prepares OpenDRIVE for netconvert, which ignores left-hand traffic and road speed limits."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, SubElement, tostring
from xml.sax.handler import ContentHandler

from defusedxml.common import DefusedXmlException

from cavmarl.core.errors import MapError
from cavmarl.maps.provenance import RoadDefaults
from cavmarl.maps.traffic_sides import Side
from cavmarl.roads.sumo_net.xml_source import limit, read_tree, read_xml

NO_LIMIT_MPS = 142.0 / 3.6  # netconvert's value for `maxspeed=none` of OSM
WALKING_MPS = 5.0 / 3.6  # lower limits are more likely a wrong unit
MAX_GEOMETRY_M = 100_000
LENGTH_LIMIT = "CAVMARL_MAX_GEOMETRY_M"  # environment variable that changes this limit
LEAST_PART_M = 1.0  # shortest part with its own limit, as netconvert makes an edge of each part

_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6, "mph": 0.44704}
# Lane types that vehicles drive on, with the speed of netconvert's type map in m/s.
_TRAVELLED = {
    "driving": 13.89, "entry": 22.22, "exit": 22.22, "onRamp": 22.22, "offRamp": 22.22,
    "mwyEntry": 22.22, "mwyExit": 22.22, "bus": 13.89, "taxi": 13.89,
}  # fmt: skip
# Lane types that netconvert leaves out silently, with the type that replaces them.
_READ_AS = {"slipLane": "driving", "shared": "driving", "connectingRamp": "offRamp"}
# netconvert would open these lanes to through traffic, or close them silently.
_NOT_TRAVELLED = frozenset(("parking", "stop", "HOV", "bidirectional"))
# netconvert's type map leaves these out, or closes them to road vehicles, as intended.
_NO_LANES = frozenset(
    "none shoulder border median curb sidewalk walking biking restricted special1 special2 "
    "special3 rail tram roadWorks".split()
)
# Entries in addition to netconvert's type map.
TYPE_MAP = b"""<types>
  <type id="bus" priority="1" speed="13.89" width="3.65" allow="bus taxi emergency"/>
  <type id="taxi" priority="1" speed="13.89" width="3.65" allow="taxi emergency"/>
</types>
"""
_SIDES: dict[str, Side] = {"RHT": "right", "LHT": "left"}
_INVALID = "speed limits whose max or unit is invalid"

Limits = list[tuple[float, float | None]]  # position in m, and the limit in m/s from there on


@dataclass
class OpenDriveSource:
    """The roads of an OpenDRIVE file, changed so that netconvert reads them correctly.

    Attributes:
        root: the changed document.
        changed: whether it differs from the file.
        defaults: roads without a speed limit, by type of road.
        counts: numbers of ignored and suspicious elements.
    """

    path: Path
    tolerant: bool  # count invalid elements instead of raising an error
    root: Element = field(init=False)
    changed: bool = False
    defaults: tuple[RoadDefaults, ...] = ()
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        """Read the file; raises MapError if it is broken, or a speed limit is invalid."""
        try:
            self.root = read_tree(self.path)
        except (ParseError, DefusedXmlException, ValueError, OSError) as error:
            raise MapError(f"{self.path}: cannot be read ({error}): export it again") from error
        self._refuse_endless()
        self._set_lane_types()
        self._set_limits()

    def notes(self) -> tuple[str, ...]:
        """Return notes on ignored and suspicious elements, with counts."""
        return tuple(f"{count} {what}" for what, count in sorted(self.counts.items()))

    def content(self) -> bytes:
        text: bytes = tostring(self.root, "utf-8")
        return text

    def use_side(self, given: Side | None) -> Side:
        """Return the traffic side, and change the roads for it.

        `given`: None: decide by the `rule` of the roads.

        Raises MapError: a rule is invalid, or the rules differ and no side is given.
        """
        rules = Counter(road.get("rule", "RHT") for road in self.root.iter("road"))
        if not rules.keys() <= _SIDES.keys():
            unknown = ", ".join(repr(rule) for rule in sorted(rules.keys() - _SIDES.keys()))
            raise MapError(f"{self.path}: roads with rule={unknown}: must be RHT or LHT; repair it")
        if given is None and len(rules) > 1:
            raise MapError(
                f"{self.path}: {rules['RHT']} roads have rule RHT (the default) and {rules['LHT']} "
                "LHT: a network has one side; split the map, or choose the side: cavmarl map build "
                f"{self.path} --traffic-side left or right"
            )
        side = given or (_SIDES[next(iter(rules))] if rules else "right")
        for rule, number in rules.items():
            if _SIDES[rule] != side:
                self.counts[f"roads with rule {rule} are built for {side}-hand traffic"] += number
        if side == "left":
            self._swap_sides()
            self.changed = True
        return side

    def _swap_sides(self) -> None:
        """Exchange the lanes on the left and on the right of all reference lines.

        In left-hand traffic, lanes on the left of the line lead along it. netconvert reads the
        lanes on the right, and places them on the left if it has `--lefthand`.
        """
        for section in self.root.iter("laneSection"):
            for side in [*section.iterfind("left"), *section.iterfind("right")]:
                side.tag = "right" if side.tag == "left" else "left"
                side[:] = reversed(side[:])
                for lane in side.iterfind("lane"):
                    _negate(lane, "id")
                    for link in (
                        *lane.iterfind("link/predecessor"),
                        *lane.iterfind("link/successor"),
                    ):
                        _negate(link, "id")
        for link in self.root.iter("laneLink"):
            _negate(link, "from")
            _negate(link, "to")
        for validity in self.root.iter("validity"):
            _negate(validity, "fromLane")
            _negate(validity, "toLane")

    def _refuse_endless(self) -> None:
        """Raise MapError for a geometry that is so long that netconvert would run out of memory."""
        most_m = limit(LENGTH_LIMIT, MAX_GEOMETRY_M)
        number = 0
        for road in self.root.iter("road"):
            for geometry in road.iterfind("planView/geometry"):
                length_m = self._number(geometry, "length", math.inf)
                if abs(length_m) > most_m:
                    lines = _GeometryLines()
                    read_xml(self.path, lines)
                    raise MapError(
                        f"{self.path}:{lines.found[number]}: road '{road.get('id')}' has a "
                        f"geometry of {geometry.get('length')} m: at most {most_m} m are allowed: "
                        f"repair its length, or set {LENGTH_LIMIT}"
                    )
                number += 1

    def _roads(self) -> Iterator[Element]:
        """Yield the roads outside of junctions; in junctions, netconvert makes its own paths."""
        return (road for road in self.root.iter("road") if road.get("junction", "-1") == "-1")

    def _set_lane_types(self) -> None:
        """Replace lane types that netconvert does not know, and close lanes to through traffic."""
        for lane in self.root.iter("lane"):
            kind = lane.get("type", "none")
            if kind in _READ_AS:
                lane.set("type", _READ_AS[kind])
                self.counts[f"lanes of type {kind} are read as {_READ_AS[kind]}"] += 1
            elif kind not in _TRAVELLED and kind not in _NO_LANES:
                lane.set("type", "none")
                what = "are left out" if kind in _NOT_TRAVELLED else "are unknown and left out"
                self.counts[f"lanes of type {kind} {what}"] += 1
            else:
                continue
            self.changed = True

    def _set_limits(self) -> None:
        """Write the limits of roads to their lanes, and count the roads without a limit."""
        kinds: Counter[str] = Counter()
        without: dict[str, Counter[str]] = {}
        for road in self._roads():
            types = sorted(road.iterfind("type"), key=lambda kind: self._number(kind, "s"))
            kind = types[0].get("type", "unknown") if types else "unknown"
            kinds[kind] += 1
            limits: Limits = []
            for entry in types:
                speed = entry.find("speed")
                limit = None if speed is None else self._limit(speed, road)
                limits.append((self._number(entry, "s"), limit))
            used = self._set_limits_of_lanes(road, limits)
            if used:
                speed_mps = min(used, key=lambda value: (-used[value], value))
                without.setdefault(kind, Counter())[f"{speed_mps:g}"] += 1
            slowest = min((limit for _, limit in limits if limit is not None), default=math.inf)
            if slowest < WALKING_MPS:
                self.counts[f"roads with a speed limit below {WALKING_MPS:.2f} m/s (5 km/h)"] += 1
        self.defaults = tuple(
            RoadDefaults(kind, kinds[kind], "maxspeed", used.most_common(1)[0][0], used.total())
            for kind, used in sorted(without.items())
        )

    def _set_limits_of_lanes(self, road: Element, of_road: Limits) -> Counter[float]:
        """Write the limits of a road's lanes; count the default speeds in m/s that lanes get."""
        used: Counter[float] = Counter()
        sections = sorted(
            road.iterfind("lanes/laneSection"), key=lambda one: self._number(one, "s")
        )
        ends = [*(self._number(one, "s") for one in sections[1:]), self._number(road, "length")]
        for section, end in zip(sections, ends, strict=True):
            begin = self._number(section, "s")
            for lane in (*section.iterfind("left/lane"), *section.iterfind("right/lane")):
                usual = _TRAVELLED.get(lane.get("type", ""))
                if usual is None:
                    continue
                records = lane.findall("speed")
                of_lane = [
                    (begin + self._number(speed, "sOffset"), self._limit(speed, road))
                    for speed in records
                ]
                parts = _parts(begin, end, of_road, sorted(of_lane, key=lambda part: part[0]))
                if any(limit is None for _, limit in parts):
                    used[usual] += 1
                if all(limit is None for _, limit in parts) and not records:
                    continue
                for speed in records:
                    lane.remove(speed)
                for at, given in parts:
                    value = usual if given is None else given
                    words = {"sOffset": f"{at - begin:.6g}", "max": f"{value:.6g}", "unit": "m/s"}
                    SubElement(lane, "speed", words)
                self.changed = True
        return used

    def _limit(self, speed: Element, road: Element) -> float | None:
        """Return a limit in m/s; None if the file leaves it undefined."""
        text, unit = speed.get("max", "").strip(), speed.get("unit", "").strip() or "m/s"
        if text in ("no limit", "none"):
            return NO_LIMIT_MPS
        if text in ("undefined", ""):
            return None
        try:
            limit = float(text) * _UNITS[unit]
        except (ValueError, KeyError):
            limit = math.nan
        if limit == 0.0:
            return None
        if math.isfinite(limit) and limit > 0.0:
            return limit
        if not self.tolerant:
            raise MapError(
                f"{self.path}: road '{road.get('id')}': <speed max='{text}' unit='{unit}'/>: must "
                f"be a number of at least 0, 'no limit' or 'undefined', in {', '.join(_UNITS)}: "
                f"repair it, or ignore such limits: cavmarl map build {self.path} --tolerant"
            )
        self.counts[_INVALID] += 1
        return None

    def _number(self, element: Element, key: str, endless: float = 0.0) -> float:
        """Return a position or length in m; 0 for invalid text, which netconvert reports.

        `endless`: returned for numbers that are not finite.
        """
        try:
            value = float(element.get(key, "0"))
        except ValueError:
            return 0.0
        return value if math.isfinite(value) else endless


class _GeometryLines(ContentHandler):
    """Finds the line of each geometry of a road's reference line.

    Attributes:
        found: the lines, in the order of the document.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[int] = []
        self._open: list[str] = []

    def startElement(self, name: str, attrs: object) -> None:
        if [*self._open[-2:], name] == ["road", "planView", "geometry"]:
            self.found.append(self._locator.getLineNumber())  # type: ignore[attr-defined]
        self._open.append(name)

    def endElement(self, name: str) -> None:
        self._open.pop()


def _negate(element: Element, key: str) -> None:
    text = element.get(key, "").strip()
    if text not in ("", "0"):
        element.set(key, text[1:] if text[0] == "-" else f"-{text.removeprefix('+')}")


def _parts(begin: float, end: float, of_road: Limits, of_lane: Limits) -> Limits:
    """Return the limits along a lane between two positions in m: the lane's own, else the road's.

    Parts shorter than `LEAST_PART_M` at either end are merged into the adjacent parts.
    """
    at = {place for place, _ in (*of_road, *of_lane)}
    last = end - LEAST_PART_M
    starts = [begin, *sorted(s for s in at if begin + LEAST_PART_M < s < last)]
    parts: Limits = []
    for start in starts:
        seen = start + LEAST_PART_M if start == begin else start
        limit = _last_before(of_lane, seen)
        if limit is None:
            limit = _last_before(of_road, seen)
        if not parts or limit != parts[-1][1]:
            parts.append((start, limit))
    return parts


def _last_before(limits: Limits, place: float) -> float | None:
    row = bisect_right(limits, place, key=lambda part: part[0]) - 1
    return limits[row][1] if row >= 0 else None
