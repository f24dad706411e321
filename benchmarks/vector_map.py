"""`VectorMap`: the lanelets of a map folder of Autoware, read from its XML."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import ElementTree
from numpy.typing import NDArray

from cavmarl.config.io import read_yaml
from cavmarl.core.errors import MapError

CHANGE_S = 6.0  # cost of a lane change
_POINTS_M = 2.0  # spacing of points for the search of lanelets


@dataclass
class MapLanelet:
    """A lanelet."""

    id: int
    centre: NDArray[np.float64]  # (n, 2) m, in driving direction
    along_m: NDArray[np.float64]  # (n,) distance of each point from the beginning
    speed_mps: float
    is_turn: bool  # whether the lanelet is inside a junction
    lights: tuple[int, ...]  # ids of its traffic lights
    before: list[MapLanelet] = field(default_factory=list)
    after: list[MapLanelet] = field(default_factory=list)
    beside: list[MapLanelet] = field(default_factory=list)  # lanelets to which cars may change
    yields_to: list[MapLanelet] = field(default_factory=list)

    @property
    def length_m(self) -> float:
        return float(self.along_m[-1])

    def project(self, place: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return s, lateral offset (left positive) and heading of the lanelet at a place (2,)."""
        steps = np.diff(self.centre, axis=0)
        lengths = np.maximum(np.hypot(*steps.T), 1e-9)
        offset = place - self.centre[:-1]
        share = np.clip((offset * steps).sum(axis=1) / lengths**2, 0.0, 1.0)
        off = np.hypot(*(offset - share[:, None] * steps).T)
        n = int(np.argmin(off))
        cross = steps[n, 0] * offset[n, 1] - steps[n, 1] * offset[n, 0]
        s = float(self.along_m[n] + share[n] * lengths[n])
        return s, math.copysign(float(off[n]), cross), math.atan2(steps[n, 1], steps[n, 0])


class VectorMap:
    """The lanelets for cars of a map folder.

    Raises:
        MapError: a file is missing, or the projector is not `Local`.
    """

    def __init__(self, folder: Path) -> None:
        projector = read_yaml(folder / "map_projector_info.yaml")
        if projector != {"projector_type": "Local"}:
            raise MapError(f"{folder}: projector {projector}: must be of type Local")
        try:
            text = (folder / "lanelet2_map.osm").read_text(encoding="utf-8")
            root: Element = ElementTree.fromstring(text)
        except (OSError, ElementTree.ParseError) as error:
            raise MapError(f"{folder}: no vector map ({error})") from error
        self.lanelets = _read(root)
        places = [_resampled(one) for one in self.lanelets]
        self._places = np.concatenate(places)
        self._owners = np.repeat(np.arange(len(places)), [len(one) for one in places])

    def near(self, place: NDArray[np.float64], radius_m: float) -> list[MapLanelet]:
        """Return the lanelets around a place (2,)."""
        distance_m = np.hypot(*(self._places - place).T)
        found = np.unique(self._owners[distance_m <= radius_m + _POINTS_M])
        return [self.lanelets[n] for n in found.tolist()]

    def costs_to(self, goal: NDArray[np.float64], heading: float) -> dict[int, float]:
        """Return the seconds from the beginning of each lanelet to a goal (2,), by id.

        Lanelets from which no way leads to the goal are left out.
        """
        ends = []
        for one in self.near(goal, 3.0):
            _, off, direction = one.project(goal)
            if abs(off) < 2.0 and abs(wrapped(direction - heading)) < 0.8 and not one.is_turn:
                ends.append(one)
        costs: dict[int, float] = {}
        heap = [(one.length_m / one.speed_mps, one.id) for one in ends]
        by_id = {one.id: one for one in self.lanelets}
        while heap:
            cost, number = heapq.heappop(heap)
            if number in costs:
                continue
            costs[number] = cost
            one = by_id[number]
            for other in one.before:
                heapq.heappush(heap, (cost + other.length_m / other.speed_mps, other.id))
            for other in one.beside:  # the relation is symmetric
                heapq.heappush(heap, (cost + CHANGE_S, other.id))
        return costs


def wrapped(angle: float) -> float:
    """Return an angle in (-pi, pi]."""
    return math.remainder(angle, 2.0 * math.pi)


def _resampled(lanelet: MapLanelet) -> NDArray[np.float64]:
    count = max(2, math.ceil(lanelet.length_m / _POINTS_M) + 1)
    at_m = np.linspace(0.0, lanelet.length_m, count)
    return np.stack([np.interp(at_m, lanelet.along_m, axis) for axis in lanelet.centre.T], axis=1)


def _tags(element: Element) -> dict[str, str]:
    return {str(tag.get("k")): str(tag.get("v")) for tag in element.iter("tag")}


def _members(relation: Element) -> Iterator[tuple[str, int]]:
    for member in relation.iter("member"):
        yield str(member.get("role")), int(str(member.get("ref")))


def _read(root: Element) -> list[MapLanelet]:
    nodes = {}
    for node in root.iter("node"):
        tags = _tags(node)
        nodes[int(str(node.get("id")))] = float(tags["local_x"]), float(tags["local_y"])
    ways = {
        int(str(way.get("id"))): ([int(str(nd.get("ref"))) for nd in way.iter("nd")], _tags(way))
        for way in root.iter("way")
    }
    found: dict[int, MapLanelet] = {}
    bounds: dict[int, tuple[int, int]] = {}
    rights: list[dict[str, list[int]]] = []
    lights = set()
    relations = [(int(str(one.get("id"))), _tags(one), one) for one in root.iter("relation")]
    for number, tags, relation in relations:
        if tags.get("subtype") == "traffic_light":
            lights.add(number)
        elif tags.get("subtype") == "right_of_way":
            roles: dict[str, list[int]] = defaultdict(list)
            for role, ref in _members(relation):
                roles[role].append(ref)
            rights.append(roles)
    for number, tags, relation in relations:
        if tags.get("type") != "lanelet" or tags.get("participant:vehicle") != "yes":
            continue
        members = list(_members(relation))
        sides = dict(members)
        left, right = sides["left"], sides["right"]
        centre = _middle(*(np.array([nodes[n] for n in ways[way][0]]) for way in (left, right)))
        steps = np.hypot(*np.diff(centre, axis=0).T)
        own = tuple(ref for role, ref in members if ref in lights)
        bounds[number] = left, right
        found[number] = MapLanelet(
            number,
            centre,
            np.concatenate([[0.0], np.cumsum(steps)]),
            float(tags["speed_limit"].split()[0]) / 3.6,
            "turn_direction" in tags,
            own,
        )
    _connect(found, bounds, ways)
    for roles in rights:
        for number in roles["yield"]:
            if number in found:
                foes = [found[ref] for ref in roles["right_of_way"] if ref in found]
                found[number].yields_to += foes
    return list(found.values())


def _connect(
    lanelets: dict[int, MapLanelet],
    bounds: dict[int, tuple[int, int]],
    ways: dict[int, tuple[list[int], dict[str, str]]],
) -> None:
    """Link lanelets with common end points, and neighbours with a dashed border."""
    begins = defaultdict(list)
    right_of = {}
    for number, (left, right) in bounds.items():
        begins[ways[left][0][0], ways[right][0][0]].append(number)
        right_of[right] = number
    for number, (left, right) in bounds.items():
        one = lanelets[number]
        for ref in begins[ways[left][0][-1], ways[right][0][-1]]:
            one.after.append(lanelets[ref])
            lanelets[ref].before.append(one)
        if left in right_of and ways[left][1].get("subtype") == "dashed":
            other = lanelets[right_of[left]]
            one.beside.append(other)
            other.beside.append(one)


def _middle(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the line between two borders."""
    count = max(len(left), len(right), 2)
    sides = []
    for side in (left, right):
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(side, axis=0).T))])
        along /= max(along[-1], 1e-9)
        if len(side) == count:
            sides.append(side)
            continue
        at = np.linspace(0.0, 1.0, count)
        sides.append(np.stack([np.interp(at, along, axis) for axis in side.T], axis=1))
    middle: NDArray[np.float64] = 0.5 * (sides[0] + sides[1])
    keep = np.concatenate([[True], np.hypot(*np.diff(middle, axis=0).T) > 1e-6])
    if keep.sum() < 2:  # a lanelet without a length
        middle[-1, 0] += 1e-3
        keep[-1] = True
    return np.asarray(middle[keep], dtype=np.float64)
