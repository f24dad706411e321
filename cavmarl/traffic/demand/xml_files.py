"""Reads demand files as streams, one definition at a time, with line numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import DemandError
from cavmarl.roads.sumo_net.xml_source import read_xml
from cavmarl.traffic.demand.element import DemandReport, Element, near

MAX_INCLUDES = 16  # maximum depth of files that include each other
MAX_INSIDE = 100_000  # elements in one definition, at any depth

_ROOTS = frozenset(("routes", "additional", "add", "trips", "flows", "vtypes", "vTypes"))
STOPPING_PLACES = frozenset(
    ("busStop", "trainStop", "containerStop", "chargingStation", "parkingArea")
)
_DEFINITIONS = STOPPING_PLACES | frozenset(
    "vType vTypeDistribution route routeDistribution vehicle trip flow rerouter".split()
)

# Other elements of SUMO's files, which are ignored here.
_SKIPPED = frozenset(
    "person personFlow container containerFlow calibrator variableSpeedSign vTypeProbe "
    "routeProbe e1Detector inductionLoop instantInductionLoop e2Detector laneAreaDetector "
    "e3Detector entryExitDetector edgeData laneData timedEvent tlLogic tlLogics WAUT wautJunction "
    "poly poi polys pois taz tazs location param access overheadWire overheadWireSegment "
    "tractionSubstation parkingSpace calibrators".split()
)


# `sumo_net.signal_plans` reads them.
_PROGRAMS = frozenset(("tlLogic", "WAUT", "wautJunction"))


class _Handler(ContentHandler):
    """Builds the tree of each definition, and passes the tree on at the definition's end tag."""

    def __init__(
        self,
        path: Path,
        report: DemandReport,
        take: Callable[[Element], None],
        including: tuple[Path, ...],
    ) -> None:
        super().__init__()
        self._path = path
        self._name = str(path)
        self._report = report
        self._take = take
        self._including = (*including, path.resolve())
        self._depth = 0  # number of open elements
        self._skipping = 0  # depth of the outermost skipped element
        self._tree: list[Element] = []  # from the definition to the innermost open element
        self._inside = 0  # elements of this definition so far
        self._interval: dict[str, str] = {}
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        self._depth += 1
        if self._skipping:
            return
        element = Element(name, dict(attrs.items()), self._name, self._locator.getLineNumber())
        if self._tree:
            self._add(element)
        elif self._depth == 1:
            self._open_root(element)
        elif name == "interval":
            self._interval = element.attrs
        elif name == "include":
            self._include(element)
        elif name in _DEFINITIONS:
            if name == "flow" and self._interval:
                element.attrs = {**self._interval, **element.attrs}
            self._tree.append(element)
            self._inside = 0
        else:
            self._skip(element)

    def endElement(self, name: str) -> None:
        if self._skipping == self._depth:
            self._skipping = 0
        elif not self._skipping:
            if self._tree:
                element = self._tree.pop()
                if not self._tree:
                    self._report.count(element.name)
                    self._take(element)
            elif name == "interval":
                self._interval = {}
        self._depth -= 1

    def _add(self, element: Element) -> None:
        self._inside += 1
        if self._inside > MAX_INSIDE:
            raise self._tree[0].error(f"contains more than {MAX_INSIDE} elements", "split it")
        self._tree[-1].children.append(element)
        self._tree.append(element)

    def _open_root(self, element: Element) -> None:
        if element.name in _SKIPPED:
            self._skip(element)
        elif element.name not in _ROOTS:
            raise element.error(
                "is not the root of a demand file",
                f"demand files begin with {', '.join(f'<{root}>' for root in sorted(_ROOTS))}; "
                f"{near(element.name, _ROOTS)}",
            )

    def _skip(self, element: Element) -> None:
        self._skipping = self._depth
        if element.name in _PROGRAMS and self._including[-1] in self._report.program_files:
            return
        known = element.name in _SKIPPED
        what = f"<{element.name}> is not read" if known else f"unknown element <{element.name}>"
        if element.name in _PROGRAMS:
            what += " as demand (signal programs: `map.programs`)"
        self._report.tolerate(what, element.place)

    def _include(self, element: Element) -> None:
        path = self._path.parent / element.text("href")
        if path.resolve() in self._including or len(self._including) > MAX_INCLUDES:
            raise element.error(
                f"includes '{path}', which includes it", "files must not include themselves"
            )
        _read(path, self._report, self._take, self._including)
        self._skipping = self._depth


def _read(
    path: Path, report: DemandReport, take: Callable[[Element], None], including: tuple[Path, ...]
) -> None:
    if str(path) not in report.files:
        report.files.append(str(path))
    read_xml(path, _Handler(path, report, take, including), DemandError)


def read_elements(path: Path, report: DemandReport, take: Callable[[Element], None]) -> None:
    """Pass the definitions of a file and of its included files to `take`, in order.

    Flows inside an <interval> get the interval's begin and end. Other elements are counted in
    `report`.

    `path`: a plain or gzipped file. `report`: receives files and counts of elements. `take`: gets
    each <vType>, <route>, <vehicle>, … with its children at its end tag.

    Raises DemandError: the file is missing, is not XML, or has another root.
    """
    _read(path, report, take, ())
