"""Reads SUMO's network files with sumolib, and adds checks that sumolib lacks.

sumolib merges edges of the same name, accepts NaN as a speed, and raises a bare KeyError for
missing attributes. This module checks every element first. Messages state the place and a remedy.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.handler import ContentHandler

from sumolib.net import NetReader

from cavmarl.core.errors import MapError
from cavmarl.roads.sumo_net.programs import ProgramReader, SignalProgram
from cavmarl.roads.sumo_net.xml_source import limit, read_xml

MAX_LANE_POINTS = 100_000
MOST_POINTS = "CAVMARL_MAX_LANE_POINTS"  # environment variable that changes this limit
_MAX_COORDINATE_M = 1e8  # more than twice around the Earth

_REQUIRED = {
    "edge": ("id",),
    "lane": ("id", "speed", "length", "shape"),
    "junction": ("id", "type", "x", "y", "incLanes", "intLanes"),
    "connection": ("from", "to", "fromLane", "toLane", "dir", "state"),
    "request": ("index", "response", "foes"),
}
_FINITE = {"lane": ("speed", "length", "width"), "junction": ("x", "y", "z")}
_POSITIVE = {("lane", "speed"), ("lane", "length"), ("lane", "width")}
_VERSION = re.compile(r"[0-9]+\.[0-9]+(\.[0-9]+)?")
_TRUTH = {"true": True, "1": True, "false": False, "0": False}
_BITS = re.compile(r"[01]+")


class _CheckedReader(ContentHandler):
    """Passes every element to sumolib's own reader after checking it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.reader = NetReader(withInternal=True, withFoes=True)
        self.programs = ProgramReader(path)
        self.left_hand = False
        self.changes: dict[str, tuple[list[str], list[str]]] = {}
        self.stop_offsets_m: dict[str, float] = {}
        self.ignored: Counter[str] = Counter()
        self._path = path
        self._seen: set[tuple[str, str]] = set()
        self._edge = ""
        self._next_lane = 0
        self._lane = ""  # empty: outside of lanes
        self._most_points = limit(MOST_POINTS, MAX_LANE_POINTS)
        self._root = ""
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        if not self._root:
            self._root = name
            if name != "net":
                raise self._error(name, attrs, "is not the root of a SUMO network, which is <net>")
            self._check_version(attrs)
            self.left_hand = self._is_true(name, attrs, "lefthand", "false")
        self._check(name, attrs)
        self._read_rules(name, attrs)
        self.programs.start(name, attrs, self._locator.getLineNumber())
        try:
            self.reader.startElement(name, attrs)
        except (KeyError, ValueError, IndexError, AttributeError, TypeError) as error:
            problem = f"does not fit the elements before it ({type(error).__name__}: {error})"
            raise self._error(name, attrs, problem) from error
        if name == "connection" and not self._is_true(name, attrs, "keepClear", "true"):
            if self.reader._currentConnection is not None:
                self.reader._currentConnection.setParam("keepClear", "false")

    def endElement(self, name: str) -> None:
        if name == "lane":
            self._lane = ""
        self.programs.end(name)
        try:
            self.reader.endElement(name)
        except KeyError as error:
            raise self._error(name, {}, f"refers to an unknown edge {error}") from error

    def _error(self, name: str, attrs: Mapping[str, str], problem: str) -> MapError:
        known = f' id="{attrs["id"]}"' if "id" in attrs else ""
        return MapError(
            f"{self._path}, line {self._locator.getLineNumber()}: <{name}{known}> {problem}: "
            "build the network again with netconvert or repair this element"
        )

    def _check(self, name: str, attrs: Mapping[str, str]) -> None:
        for key in _REQUIRED.get(name, ()):
            if key not in attrs:
                raise self._error(name, attrs, f"has no attribute '{key}'")
        for key in _FINITE.get(name, ()):
            if key in attrs:
                self._check_number(name, key, attrs)
        if name in ("edge", "junction"):
            self._check_unique(name, attrs)
        if name in ("edge", "junction", "lane"):
            self._check_size(name, attrs)
        if name == "edge":
            self._edge, self._next_lane = attrs["id"], 0
        elif name == "lane":
            self._check_lane(attrs)
        elif name == "request":
            for key in ("response", "foes"):
                if not _BITS.fullmatch(attrs[key]):
                    raise self._error(
                        name, attrs, f"has {key}='{attrs[key]}', must contain only 0 and 1"
                    )

    def _read_rules(self, name: str, attrs: Mapping[str, str]) -> None:
        """Read the lane rules that sumolib does not read; count rules that are not simulated."""
        if name == "lane":
            self._lane = attrs["id"]
            changes = tuple(attrs.get(key) or "all" for key in ("changeLeft", "changeRight"))
            if changes != ("all", "all"):
                self.changes[self._lane] = changes[0].split(), changes[1].split()
        elif name == "neigh":
            self.ignored["<neigh> elements (overtaking on the opposite lane)"] += 1
        elif name == "stopOffset":
            self._read_stop_offset(attrs)

    def _read_stop_offset(self, attrs: Mapping[str, str]) -> None:
        if "value" not in attrs:
            raise self._error("stopOffset", attrs, "has no attribute 'value'")
        self._check_number("stopOffset", "value", attrs)
        for_cars = {"all", "passenger"} & set(attrs.get("vClasses", "all").split())
        if not for_cars or {"all", "passenger"} & set(attrs.get("exceptions", "").split()):
            self.ignored["stop offsets that do not hold for passenger cars"] += 1
        elif float(attrs["value"]) > 0.0:
            self.stop_offsets_m[self._lane or self._edge] = float(attrs["value"])

    def _check_version(self, attrs: Mapping[str, str]) -> None:
        if "version" not in attrs:
            raise self._error("net", attrs, "has no version attribute, so it is not a SUMO network")
        if not _VERSION.fullmatch(attrs["version"]):
            raise self._error(
                "net", attrs, f"has version='{attrs['version']}', not a version of SUMO's"
            )

    def _is_true(self, name: str, attrs: Mapping[str, str], key: str, default: str) -> bool:
        text = attrs.get(key, default)
        if text not in _TRUTH:
            raise self._error(name, attrs, f"has {key}='{text}', must be true or false")
        return _TRUTH[text]

    def _check_number(self, name: str, key: str, attrs: Mapping[str, str]) -> None:
        try:
            value = float(attrs[key])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._error(name, attrs, f"has {key}='{attrs[key]}', must be a finite number")
        if (name, key) in _POSITIVE and value <= 0.0:
            raise self._error(name, attrs, f"has {key}='{attrs[key]}', must be positive")

    def _check_unique(self, name: str, attrs: Mapping[str, str]) -> None:
        if (name, attrs["id"]) in self._seen:
            raise self._error(name, attrs, "occurs twice: ids must be unique")
        self._seen.add((name, attrs["id"]))

    def _check_lane(self, attrs: Mapping[str, str]) -> None:
        expected = f"{self._edge}_{self._next_lane}"
        if attrs["id"] != expected:
            raise self._error("lane", attrs, f"must be '{expected}'")
        self._next_lane += 1
        for point in attrs["shape"].split():
            try:
                numbers = [float(part) for part in point.split(",")]
            except ValueError:
                numbers = [math.nan]
            if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
                raise self._error("lane", attrs, f"has the point '{point}', must be finite x,y[,z]")
            if max(map(abs, numbers)) > _MAX_COORDINATE_M:
                problem = f"has the point '{point}', beyond {_MAX_COORDINATE_M:g} m"
                raise self._error("lane", attrs, problem)

    def _check_size(self, name: str, attrs: Mapping[str, str]) -> None:
        if (count := len(attrs.get("shape", "").split())) > self._most_points:
            problem = (
                f"has {count} points, more than {self._most_points} "
                f"(environment variable {MOST_POINTS})"
            )
            raise self._error(name, attrs, problem)


class ParsedNet(NamedTuple):
    """A SUMO network file."""

    net: Any  # a `sumolib.net.Net`
    programs: list[SignalProgram]
    left_hand: bool  # whether the map has left-hand traffic
    # lane id → SUMO's vehicle classes that may change to the left, and to the right; without
    # lanes on which all classes may do both
    changes: dict[str, tuple[list[str], list[str]]]
    stop_offsets_m: dict[str, float]  # distance from stop line to lane end, by edge or lane id
    notes: tuple[str, ...]  # elements that are not simulated, with counts


def parse_net(path: Path) -> ParsedNet:
    """Read a SUMO network (`.net.xml`, `.net.xml.gz`).

    Raises:
        MapError: the XML is malicious or broken, its root is not <net>, an attribute is missing,
            infinite or NaN, a speed, length or width is not positive, an id occurs twice, lanes are
            not in order, or a reference is invalid. The message states the place and a remedy.
    """
    handler = _CheckedReader(path)
    read_xml(path, handler)
    return ParsedNet(
        handler.reader.getNet(),
        handler.programs.programs,
        handler.left_hand,
        handler.changes,
        handler.stop_offsets_m,
        tuple(f"{count} {what} ignored" for what, count in sorted(handler.ignored.items())),
    )
