"""Stops of vehicles and routes: from <stop> elements to STOP records along a route."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cavmarl.core.errors import CavmarlError
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
    """Finds the lanes of stops, and their places in routes.

    Attributes:
        places: elements of bus stops, parking areas, … by id.
        skip: whether stops off the route are counted and left out, or refused.
    """

    def __init__(
        self, index: MapIndex, places: dict[str, Element], report: DemandReport, skip: bool
    ) -> None:
        self.places = places
        self.skip = skip
        self._index = index
        self._report = report

    def edges(self, stops: Sequence[Element]) -> list[int]:
        """The EDGE rows of stops: where a trip with stops has to pass."""
        lanes = self._index.network.lanes
        return [int(lanes[self._lane(stop)]["edge"]) for stop in stops]

    def along(
        self, stops: Sequence[Element], edges: Sequence[int], exact: bool, until_from: int
    ) -> list[Stop]:
        """Stops in the order in which a route reaches them.

        `stops`: the <stop> elements in the order of the file. `edges`: EDGE rows of the route.
        `exact`: whether the route is those edges, or a way between them.

        Raises DemandError: a stop is not on the route after the one before it.
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
                f"on edge '{name}' lies off the route, or before the stop above it",
                "put stops in the order of the route, or skip it (traffic.on_bad_route = skip)",
            )
        self._report.tolerate("stop off its route is left out", element.place)

    def _source(self, stop: Element) -> Element:
        """What holds lane and positions: the stop itself or the stopping place it names."""
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
        """Start and end on SUMO's lane, m; negative ones count from its end."""
        network = self._index.network
        length = float(network.edges[network.lanes[lane]["edge"]]["length_m"])
        end = source.number("endPos", length)
        end = end + length if end < 0.0 else end
        start = source.number("startPos", max(0.0, end - 0.2))
        start = start + length if start < 0.0 else start
        if source.flag("friendlyPos", False):
            end = min(max(end, 0.0), length)
            start = min(max(start, 0.0), end)
        # SUMO's own files are written with two decimals.
        if not 0.0 <= start <= end <= length + 0.01:
            raise self._bad_span(source, length)
        return start, min(end, length)

    def _bad_span(self, source: Element, length: float) -> CavmarlError:
        return source.error(
            f"has startPos='{source.attrs.get('startPos', '')}' and "
            f"endPos='{source.attrs.get('endPos', '')}' on a lane of {length:g} m",
            "let 0 <= startPos <= endPos <= the lane's length, or set friendlyPos='true'",
        )
