"""Repairs the curves of netconvert's OpenDRIVE for the rules of ASAM's checker.

netconvert writes lengths of cubic curves with errors up to a decimetre, and repeats elevations that
do not change. It starts some roads for U-turns at the wrong side of a lane, or turns them about a
point. The directions of lines over junctions differ from those of roads by some milliradians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from cavmarl.maps.exports.opendrive_lanes import LANES, part_roads

_SEALED_M = 1e-3  # maximum gap between lanes that lead into each other
_SAME_RAD = 1e-4  # tolerance of directions: 2 mm at a distance of 20 m from the reference line
_PIVOT_M = 0.5  # a shorter line for a U-turn is moved to the other side of its lane
_SAME_GRADE = 1e-6
_PARTS = 64  # a length is the sum over this many parts: some curves nearly have a cusp
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_U, _V = ("aU", "bU", "cU", "dU"), ("aV", "bV", "cV", "dV")

Coefficients = NDArray[np.float64]


@dataclass(frozen=True)
class RoadEnd:
    """The start or end of a road's reference line."""

    x_m: float
    y_m: float
    heading_rad: float

    def beside(self, left_m: float) -> NDArray[np.float64]:
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return np.array([self.x_m - left_m * sin, self.y_m + left_m * cos])

    @property
    def direction(self) -> NDArray[np.float64]:
        return np.array([math.cos(self.heading_rad), math.sin(self.heading_rad)])


def mend_curves(root: Element) -> int:
    """Repair all roads of a document; return how many roads over junctions were redrawn."""
    part_roads(root)
    roads = {road.get("id", ""): road for road in root.iter("road")}
    drawn = sum(_seal(road, roads) for road in roads.values() if road.get("junction", "-1") != "-1")
    for road in roads.values():
        _state_lengths(road)
        if road.get("junction", "-1") != "-1":
            _taper(road, roads)
        _join_lines(road)
        _drop_repeated(road.find("elevationProfile"))
    return drawn


def _coefficients(curve: Element) -> Coefficients:
    """Return the coefficients (2, 4) of u and v in the curve's parameter p."""
    return np.array([[float(curve.get(key, "0")) for key in keys] for keys in (_U, _V)])


def _geometries(road: Element) -> list[Element]:
    return list(road.iterfind("planView/geometry"))


def _end(road: Element, at_start: bool) -> RoadEnd:
    geometry = _geometries(road)[0 if at_start else -1]
    x, y, heading = (float(geometry.get(key, "0")) for key in ("x", "y", "hdg"))
    if at_start:
        return RoadEnd(x, y, heading)
    cos, sin = math.cos(heading), math.sin(heading)
    curve = geometry.find("paramPoly3")
    if curve is None:
        along, across, turn = float(geometry.get("length", "0")), 0.0, 0.0
    else:
        found = _coefficients(curve)
        along, across = found.sum(axis=1).tolist()
        slope = found[:, 1:] @ (1.0, 2.0, 3.0)
        turn = math.atan2(slope[1], slope[0])
    return RoadEnd(x + along * cos - across * sin, y + along * sin + across * cos, heading + turn)


def _seal(road: Element, roads: dict[str, Element]) -> bool:
    """Redraw a road over a junction if it misses the lanes that it joins; return whether it did."""
    before, after = (
        roads.get(link.get("elementId", "")) if link is not None else None
        for link in (road.find("link/predecessor"), road.find("link/successor"))
    )
    lanes = road.findall(LANES)
    if before is None or after is None or not lanes or len(_geometries(road)) != 1:
        return False
    first = lanes[0]  # the innermost lane
    ids = [
        0 if link is None else int(link.get("id", "0"))
        for link in (first.find("link/predecessor"), first.find("link/successor"))
    ]
    offset_m = _offset_m(road)
    leaves, arrives = _end(before, at_start=False), _end(after, at_start=True)
    start = leaves.beside(_inner_m(before, ids[0]) - offset_m)
    end = arrives.beside(_inner_m(after, ids[1]) - offset_m)
    if math.dist(start, end) < _PIVOT_M and leaves.direction @ arrives.direction < 0.0:
        offset_m = _set_offset(road, sum(_width_m(road, -k - 1) or 0.0 for k in range(len(lanes))))
        start = leaves.beside(_inner_m(before, ids[0]) - offset_m)
        end = arrives.beside(_inner_m(after, ids[1]) - offset_m)
    drawn = (_end(road, at_start=True), _end(road, at_start=False))
    sealed = all(
        math.dist(one.beside(0.0), place) < _SEALED_M
        and abs(math.remainder(one.heading_rad - other.heading_rad, math.tau)) < _SAME_RAD
        for one, place, other in zip(drawn, (start, end), (leaves, arrives), strict=True)
    )
    if not sealed:
        _draw(_geometries(road)[0], start, end, leaves, arrives)
    return not sealed


def _taper(road: Element, roads: dict[str, Element]) -> None:
    """Change the widths of lanes over a junction to those of the lanes that they join."""
    length_m = float(road.get("length", "0"))
    for lane in road.iterfind(LANES):
        widths = []
        for kind in ("predecessor", "successor"):
            link, other = lane.find(f"link/{kind}"), road.find(f"link/{kind}")
            if link is not None and other is not None:
                joined = roads.get(other.get("elementId", ""))
                widths.append(_width_m(joined, int(link.get("id", "0"))))
        width = lane.find("width")
        if width is None or len(widths) < 2 or None in widths or length_m < _SEALED_M:
            continue
        first, last = (float(one or 0.0) for one in widths)
        if abs(last - first) < _SEALED_M and abs(float(width.get("a", "0")) - first) < _SEALED_M:
            continue
        step = last - first  # with zero slope at both ends
        for key, value in zip(
            "abcd", (first, 0.0, 3.0 * step / length_m**2, -2.0 * step / length_m**3), strict=True
        ):
            width.set(key, f"{value:.8f}")


def _width_m(road: Element | None, lane: int) -> float | None:
    for one in road.iterfind(LANES) if road is not None else ():
        width = one.find("width")
        if int(one.get("id", "0")) == lane and width is not None:
            return float(width.get("a", "0"))
    return None


def _offset_m(road: Element) -> float:
    """Return the distance to the left of the reference line at which lanes begin."""
    offset = road.find("lanes/laneOffset")
    return 0.0 if offset is None else float(offset.get("a", "0"))


def _set_offset(road: Element, offset_m: float) -> float:
    lanes, offset = road.find("lanes"), road.find("lanes/laneOffset")
    if offset is None and lanes is not None:
        offset = Element("laneOffset", s="0", b="0", c="0", d="0")
        lanes.insert(0, offset)
    if offset is not None:
        offset.set("a", f"{offset_m:.2f}")
    return offset_m


def _inner_m(road: Element, lane: int) -> float:
    """Return the offset of a lane's border towards the reference line, positive to the left."""
    inner_m = _offset_m(road)
    for one in road.iterfind(LANES):
        width = one.find("width")
        if int(one.get("id", "0")) > lane and width is not None:
            inner_m -= float(width.get("a", "0"))
    return inner_m


def _draw(
    geometry: Element,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    leaves: RoadEnd,
    arrives: RoadEnd,
) -> None:
    """Draw a cubic curve; it is a circular arc if both ends lie on an arc."""
    chord = math.dist(start, end)
    turn = math.remainder(arrives.heading_rad - leaves.heading_rad, math.tau)
    handle = chord * 2.0 / (3.0 * (1.0 + abs(math.cos(0.5 * turn))))
    points = np.stack(
        [start, start + handle * leaves.direction, end - handle * arrives.direction, end]
    )
    cos, sin = math.cos(leaves.heading_rad), math.sin(leaves.heading_rad)
    p0, p1, p2, p3 = (points - start) @ np.array([[cos, -sin], [sin, cos]])
    found = np.stack([p0, 3 * (p1 - p0), 3 * (p2 - 2 * p1 + p0), p3 - 3 * (p2 - p1) - p0])
    for key, value in (("x", start[0]), ("y", start[1]), ("hdg", leaves.heading_rad)):
        geometry.set(key, f"{value:.8f}")
    for child in list(geometry):
        geometry.remove(child)
    curve = Element("paramPoly3")
    for axis, keys in enumerate((_U, _V)):
        for power, key in enumerate(keys):
            curve.set(key, f"{found[power, axis]:.8f}")
    curve.set("pRange", "normalized")
    geometry.append(curve)


def curve_length_m(found: Coefficients) -> float:
    """Return the length of a cubic curve with coefficients (2, 4), by Gaussian quadrature."""
    p = ((np.arange(_PARTS)[:, None] + 0.5 * (_NODES + 1.0)) / _PARTS).ravel()
    slope = found[:, 1, None] + 2.0 * found[:, 2, None] * p + 3.0 * found[:, 3, None] * p * p
    return float(np.tile(_WEIGHTS, _PARTS) @ np.hypot(slope[0], slope[1]) / (2.0 * _PARTS))


def _state_lengths(road: Element) -> None:
    """Write the length of each curve, and move all records along the road accordingly."""
    old, new = [0.0], [0.0]
    for geometry in _geometries(road):
        curve = geometry.find("paramPoly3")
        stated = float(geometry.get("length", "0"))
        length = stated if curve is None else curve_length_m(_coefficients(curve))
        geometry.set("s", f"{new[-1]:.8f}")
        geometry.set("length", f"{length:.8f}")
        old.append(old[-1] + stated)
        new.append(new[-1] + length)
    road.set("length", f"{new[-1]:.8f}")

    def moved(s: float) -> float:
        return float(np.interp(s, old, new))

    for record in road.iterfind("elevationProfile/elevation"):
        s = float(record.get("s", "0"))
        piece = min(max(int(np.searchsorted(old, s + 1e-6)) - 1, 0), len(old) - 2)
        ratio = (old[piece + 1] - old[piece]) / max(new[piece + 1] - new[piece], 1e-9)
        for power, key in enumerate("bcd", start=1):
            value = float(record.get(key, "0"))
            if value:
                record.set(key, f"{value * ratio**power:.8f}")
        record.set("s", f"{moved(s):.8f}")
    for kind in ("objects/object", "signals/signal", "signals/signalReference"):
        for record in road.iterfind(kind):
            record.set("s", f"{moved(float(record.get('s', '0'))):.8f}")


def _join_lines(road: Element) -> None:
    """Merge straight geometries that continue the previous one."""
    view, before = road.find("planView"), None
    for geometry in _geometries(road):
        if geometry.find("line") is None or view is None:
            before = None
            continue
        if before is not None:
            turn = float(geometry.get("hdg", "0")) - float(before.get("hdg", "0"))
            if abs(turn) < _SAME_GRADE:
                lengths = [float(one.get("length", "0")) for one in (before, geometry)]
                before.set("length", f"{sum(lengths):.8f}")
                view.remove(geometry)
                continue
        before = geometry


def _drop_repeated(profile: Element | None) -> None:
    """Remove straight elevations that continue the previous one."""
    before: tuple[float, float, float] | None = None
    for record in profile.findall("elevation") if profile is not None else ():
        s, a, b, c, d = (float(record.get(key, "0")) for key in ("s", *"abcd"))
        straight = c == d == 0.0
        if straight and before is not None and profile is not None:
            s0, a0, b0 = before
            if abs(b - b0) < _SAME_GRADE and abs(a0 + b0 * (s - s0) - a) < _SEALED_M:
                profile.remove(record)
                continue
        before = (s, a, b) if straight else None
