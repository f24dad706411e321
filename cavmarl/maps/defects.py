"""Defects of a map: places that look wrong, each with its kind and position."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.maps.buildings import points_inside, with_buildings
from cavmarl.maps.net_document import NetDocument, points_of
from cavmarl.maps.osm_roads import OsmRoads
from cavmarl.maps.shared_ground import CAR_WIDTH_M, LEVEL_M, touching_roads
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.polylines import clean_shape
from cavmarl.roads.sumo_net.road_corners import find_corners
from cavmarl.roads.sumo_net.shared_strips import Road, Strip, find_strips

STEP_M = 0.1  # a larger difference in height of lanes that lead into each other is a defect
SEARCHES = (
    "crossings", "signals", "lanes", "steps", "parts", "stop lines", "strips", "corners",
    "ground", "buildings",
)  # fmt: skip
_DEEP_M = 1.0  # maximum distance of a stop line inside its junction

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Defect:
    """A place that looks wrong."""

    kind: str
    name: str  # name of the lane, junction, signal or edge
    x_m: float
    y_m: float
    about: str

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def find_defects(
    network: RoadNetwork,
    path: Path,
    buildings: Path | None = None,
    told: Callable[[str], None] = lambda stage: None,
) -> list[Defect]:
    """Return all defects of a map, sorted by kind.

    Args:
        network: the map.
        path: the map's file, for the rules and shapes of junctions.
        buildings: OSM or SUMO polygons; None: buildings are not checked.
        told: called with each of `SEARCHES` as it begins.

    Raises:
        MapError: a file cannot be read, or the buildings belong to another map.
        MissingExtraError: buildings must be projected, and pyproj is not installed.
    """
    document = NetDocument(path)
    searches: list[Callable[[], Iterable[Defect]]] = [
        lambda: _unruled_crossings(network, document),
        lambda: _idle_signals(network),
        lambda: _narrow_lanes(network),
        lambda: _steps(network),
        lambda: _unreachable_parts(network),
        lambda: _stop_lines_inside(network, document),
        lambda: _shared_strips(network, document),
        lambda: _tight_corners(network),
        lambda: _roads_on_shared_ground(network),
    ]
    if buildings is not None:
        searches.append(lambda: _buildings_on_roads(network, document, buildings))
    found: list[Defect] = []
    for name, search in zip(SEARCHES, searches, strict=False):  # the last search may be missing
        told(name)
        found += search()
    return found


def cut_off_edges(network: RoadNetwork) -> list[int]:
    """Return edges for cars (EDGE rows) that neither lead to nor come from the largest part."""
    from cavmarl.maps.components import strong_components

    open_lanes = (network.lanes["permissions"] & CARS != 0) & ~network.lanes["internal"]
    edges = np.unique(network.lanes["edge"][open_lanes])
    links = network.links[
        open_lanes[network.links["from_lane"]] & open_lanes[network.links["to_lane"]]
    ]
    of_lane = network.lanes["edge"]
    arcs = np.stack([of_lane[links["from_lane"]], of_lane[links["to_lane"]]], axis=1)
    part = strong_components(len(network.edges), arcs)
    largest = np.bincount(part[edges]).argmax() if len(edges) else -1
    joined = part == largest
    for one, other in ((0, 1), (1, 0)):
        near = part == largest
        while True:
            fresh = np.zeros(len(near), bool)
            fresh[arcs[near[arcs[:, one]], other]] = True
            if not (fresh & ~near).any():
                break
            near |= fresh
        joined |= near
    return [int(edge) for edge in edges if not joined[edge]]


def _unreachable_parts(network: RoadNetwork) -> Iterator[Defect]:
    for edge in cut_off_edges(network):
        yield Defect("unreachable part", network.edge_ids[edge], *_middle(network, edge), "")


def _middle(network: RoadNetwork, edge: int) -> tuple[float, float]:
    shape = network.lane_polyline(int(network.edges["first_lane"][edge]))
    x, y = shape[len(shape) // 2, :2].tolist()
    return x, y


def _unruled_crossings(network: RoadNetwork, document: NetDocument) -> Iterator[Defect]:
    """Find paths that cross in a junction without a rule or a signal.

    The rules are read from the file, because the reader adds missing rules to the network.
    """
    links = network.links
    rules = {
        junction.get("id", ""): {
            request.get("index", ""): request.get("response", "")[::-1]
            for request in junction.iter("request")
        }
        for junction in document.junctions()
    }
    order = np.argsort(links["junction"], kind="stable")
    bounds = np.searchsorted(links["junction"][order], np.arange(len(network.junctions) + 1))
    paths: dict[int, Points] = {}
    for junction, first in enumerate(bounds[:-1].tolist()):
        rows = order[first : bounds[junction + 1]].tolist()
        rows = [row for row in rows if links["signal"][row] < 0]
        rule = rules.get(network.junction_ids[junction], {})
        for n, one in enumerate(rows):
            for other in rows[n + 1 :]:
                if links["from_lane"][one] == links["from_lane"][other]:
                    continue
                numbers = links["index"][[one, other]].tolist()
                if _yields(rule, *numbers) or _yields(rule, *numbers[::-1]):
                    continue
                for row in (one, other):
                    if row not in paths:
                        paths[row] = _path(network, row)
                place = crossing_of(paths[one], paths[other])
                if place is not None:
                    names = [network.lane_ids[links["from_lane"][row]] for row in (one, other)]
                    yield Defect(
                        "crossing without right of way",
                        network.junction_ids[junction],
                        *place,
                        f"from {names[0]} and from {names[1]}",
                    )


def _yields(rule: dict[str, str], one: int, other: int) -> bool:
    return rule.get(str(one), "")[other : other + 1] == "1"


def _path(network: RoadNetwork, link: int) -> Points:
    parts, lane = [], int(network.links["first_internal"][link])
    while lane >= 0 and network.lanes["internal"][lane]:
        parts.append(network.lane_polyline(lane))
        lane = int(network.lanes["successor"][lane])
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def crossing_of(one: Points, other: Points) -> tuple[float, float] | None:
    """Return the position in the plane where two polylines (n, 3) cross on one level, or None."""
    if len(one) < 2 or len(other) < 2:
        return None
    a, b = one[:-1, None], one[1:, None]
    c, d = other[None, :-1], other[None, 1:]

    def side(p: Points, q: Points, r: Points) -> Points:
        along, across = q - p, r - p
        turn: Points = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
        return turn

    crossed = (side(a, b, c) * side(a, b, d) < 0.0) & (side(c, d, a) * side(c, d, b) < 0.0)
    crossed &= np.abs(a[..., 2] - c[..., 2]) < LEVEL_M
    if not crossed.any():
        return None
    row = int(np.argwhere(crossed)[0, 0])
    x, y = ((one[row] + one[row + 1]) / 2.0)[:2].tolist()
    return x, y


def _idle_signals(network: RoadNetwork) -> Iterator[Defect]:
    place = {name: row for row, name in enumerate(network.junction_ids)}
    for row in np.setdiff1d(np.arange(len(network.signals)), network.links["signal"]).tolist():
        name = network.signal_ids[row]
        at = network.junctions[place[name]] if name in place else {"x": np.nan, "y": np.nan}
        yield Defect("signal without lanes", name, float(at["x"]), float(at["y"]), "")


def _narrow_lanes(network: RoadNetwork) -> Iterator[Defect]:
    cars = (network.lanes["permissions"] & CARS != 0) & ~network.lanes["internal"]
    for lane in np.flatnonzero(cars & (network.lanes["width_m"] < CAR_WIDTH_M)).tolist():
        x, y = network.lane_polyline(lane)[0, :2].tolist()
        width = f"{network.lanes['width_m'][lane]:.2f} m, a car {CAR_WIDTH_M:.2f} m"
        yield Defect("lane narrower than a car", network.lane_ids[lane], x, y, width)


def _steps(network: RoadNetwork) -> Iterator[Defect]:
    lanes = network.lanes
    first = network.points[lanes["first_point"]]
    last = network.points[lanes["first_point"] + lanes["num_points"] - 1]
    inner = np.flatnonzero(lanes["internal"] & (lanes["successor"] >= 0))
    before = np.concatenate([network.links["from_lane"], inner])
    after = np.concatenate([network.links["next_lane"], lanes["successor"][inner]])
    step = np.abs(last["z"][before] - first["z"][after])
    for row in np.flatnonzero(step > STEP_M).tolist():
        at, name = last[before[row]], network.lane_ids[before[row]]
        words = f"{step[row]:.2f} m to {network.lane_ids[after[row]]}"
        yield Defect("step in height", name, float(at["x"]), float(at["y"]), words)


def _stop_lines_inside(network: RoadNetwork, document: NetDocument) -> Iterator[Defect]:
    rims = {junction.get("id", ""): points_of(junction) for junction in document.junctions()}
    for lane in np.flatnonzero(~network.lanes["internal"]).tolist():
        row = network.lanes[lane]
        junction = network.junction_ids[network.edges["to_junction"][row["edge"]]]
        rim = rims.get(junction)
        if rim is None or len(rim) < 3 or not row["num_links"]:
            continue
        end = network.lane_polyline(lane)[-1, :2]
        if _inside(end, rim[:, :2]) and _to_rim(end, rim[:, :2]) > _DEEP_M:
            deep = f"{_to_rim(end, rim[:, :2]):.1f} m inside {junction}"
            x, y = end.tolist()
            yield Defect("stop line inside a junction", network.lane_ids[lane], x, y, deep)


def _shared_strips(network: RoadNetwork, document: NetDocument) -> Iterator[Defect]:
    """Find opposite lanes that the file draws on the same strip; the reader moves them apart."""
    for strip in strips_of(network, document):
        for one, other in strip.lanes:
            x, y = network.lane_polyline(one)[0, :2].tolist()
            words = f"with {network.lane_ids[other]}; cavmarl moves it {strip.apart_m:.1f} m"
            yield Defect("opposite lanes on one strip", network.lane_ids[one], x, y, words)


def strips_of(network: RoadNetwork, document: NetDocument) -> list[Strip]:
    """Return the edges of a network's file that have lanes on the same strip."""
    drawn = {lane.id: lane.points for lane in document.lanes}
    lanes = network.lanes[: np.count_nonzero(~network.lanes["internal"])]
    shapes = [clean_shape(_with_height(drawn[id_])) for id_ in network.lane_ids[: len(lanes)]]
    roads = [
        Road(range(first, first + number), begin, end)
        for first, number, begin, end in network.edges[~network.edges["internal"]][
            ["first_lane", "num_lanes", "from_junction", "to_junction"]
        ].tolist()
    ]
    return find_strips(shapes, lanes["width_m"].tolist(), roads, network.left_hand)


def _with_height(points: Points) -> list[tuple[float, float, float]]:
    return [(x, y, z[0] if z else 0.0) for x, y, *z in points.tolist()]


def _tight_corners(network: RoadNetwork) -> Iterator[Defect]:
    """Find corners inside roads that the reader cannot round for lack of room."""
    cars = (network.lanes["permissions"] & CARS != 0) & ~network.lanes["internal"]
    for lane in np.flatnonzero(cars).tolist():
        shape = network.lane_polyline(lane)
        for corner in find_corners(shape):
            x, y = shape[(corner.first + corner.last) // 2, :2].tolist()
            angle = f"{abs(np.degrees(corner.turn)):.0f} degrees"
            yield Defect("corner too tight for a car", network.lane_ids[lane], x, y, angle)


def _roads_on_shared_ground(network: RoadNetwork) -> Iterator[Defect]:
    """Find roads that touch at one height although no junction connects them."""
    for one, other in touching_roads(network):
        place = crossing_of(network.lane_polyline(one), network.lane_polyline(other))
        x, y = place or network.lane_polyline(one)[0, :2].tolist()
        words = f"with {network.lane_ids[other]}, at the same height"
        yield Defect("roads on shared ground", network.lane_ids[one], x, y, words)


def _inside(place: Points, rim: Points) -> bool:
    one, other = rim, np.roll(rim, -1, axis=0)
    spans = (one[:, 1] > place[1]) != (other[:, 1] > place[1])
    rise = np.where(spans, other[:, 1] - one[:, 1], 1.0)
    at = one[:, 0] + (place[1] - one[:, 1]) / rise * (other[:, 0] - one[:, 0])
    return bool((spans & (place[0] < at)).sum() % 2)


def _to_rim(place: Points, rim: Points) -> float:
    along = np.roll(rim, -1, axis=0) - rim
    square = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((place - rim) * along).sum(axis=1) / square, 0.0, 1.0)
    return float(hypot_all(*(rim + share[:, None] * along - place).T).min())


def _buildings_on_roads(
    network: RoadNetwork, document: NetDocument, buildings: Path
) -> Iterator[Defect]:
    """Find lanes inside buildings, except tunnels, passages and covered roads."""
    # A file of SUMO's polygons has no ways, so nothing is covered.
    covered = {name for name, way in OsmRoads(buildings).ways.items() if way.is_covered}
    passages = {lane.id for lane in document.lanes if covered.intersection(lane.ways)}
    is_passage = np.array([id_ in passages for id_ in network.lane_ids], dtype=np.bool_)
    inner = np.flatnonzero(network.lanes["internal"] & (network.lanes["link"] >= 0))
    links = network.links[network.lanes["link"][inner]]
    is_passage[inner] = is_passage[links["from_lane"]] & is_passage[links["to_lane"]]
    lane_of = np.repeat(np.arange(len(network.lanes)), network.lanes["num_points"])
    rows = points_inside(network, with_buildings(network, buildings).roofs)
    rows = rows[~is_passage[lane_of[rows]]]
    for row in rows[np.unique(lane_of[rows], return_index=True)[1]].tolist():
        x, y = network.points[["x", "y"]][row].tolist()
        yield Defect("building on a road", network.lane_ids[lane_of[row]], x, y, "")
