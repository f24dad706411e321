"""Drapes a flat network over a terrain model; positions in the plane do not change.

On the ground, a lane has the model's height. Bridges and tunnels are straight from abutment to
abutment. If they cross another road, ramps keep them `CLEARANCE_M` above or below it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.maps.heights.height_model import HeightModel
from cavmarl.maps.heights.levels import Levels, crossings, levels_of
from cavmarl.maps.heights.stations import Stations, kept_rows, laid, stations_of
from cavmarl.maps.net_document import HEIGHT_DIGITS, NetDocument, shape_text
from cavmarl.maps.netconvert_process import quoted
from cavmarl.maps.osm_roads import OsmRoads
from cavmarl.maps.projection import unproject

CLEARANCE_M = 5.0  # vertical distance of roads that cross on two levels
RAMP_GRADE = 0.08
STEEP_GRADE = 0.15  # steeper roads are reported
MOST_GRADE = 0.25  # steeper roads are errors

Heights = NDArray[np.float64]


@dataclass(frozen=True)
class HeightReport:
    """A report about draping a map over a terrain model."""

    models: tuple[str, ...]
    cell_m: float  # cell size of the finest model
    heights_m: tuple[float, float]  # lowest and highest point of all lanes
    places: int  # places at which the model was evaluated
    filled_places: int  # places in voids of the model, interpolated
    void_cells: int  # cells of the models around the map without a height
    raised_edges: tuple[str, ...]  # edges partly or completely on bridges or in tunnels
    crossings: int  # crossings of lanes on two levels
    ramp_places: int  # places on the ground that were raised or lowered at crossings
    smoothed_places: int  # places whose height differs from the model's to limit the grade
    most_smoothed_m: float
    max_grade: float  # steepest grade of the result
    steep: tuple[str, ...]  # roads above `STEEP_GRADE`, with their grades

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class HeightOptions:
    """Options for the heights of a build."""

    models: tuple[Path, ...]
    limit_grade: float | None = None  # steeper roads are flattened; None: follow the model
    max_grade: float = MOST_GRADE  # steeper roads are errors


def drape(
    document: NetDocument, options: HeightOptions, roads: OsmRoads | None, source: Path
) -> HeightReport:
    """Set the heights of each lane and junction of a document.

    Args:
        document: a network without heights; changed in place.
        options: the models, and the treatment of steep roads.
        roads: the bridges and tunnels; None: all roads are on the ground.
        source: source of the map, for messages.

    Raises:
        MapError: the map has no projection, or already has heights; the model cannot be used or
            does not cover the map; or a road is too steep.
        MissingExtraError: pyproj or Pillow is not installed.
    """
    if document.geo is None:
        raise MapError(
            f"{source}: the map has no georeference (no projection): heights "
            "need an OpenStreetMap extract, or a network with projParameter in its <location>"
        )
    stations = stations_of(document)
    model = HeightModel(options.models)
    places = np.concatenate([stations.plane_m, stations.hubs_m])
    used = len(stations.plane_m)
    ground = np.zeros(len(places))
    degrees = unproject(places, document.geo)
    ground[:used], coverage = model.at(degrees[:used])
    ground[used:] = _at_hubs(stations, ground)
    levels = np.zeros(len(places), np.int64)
    if roads is not None:
        levels = levels_of(stations, roads, document.geo, source)
    spanned = stations.graph.spanned(ground, levels != 0)
    crossed = crossings(stations, levels)
    ramped = _cleared(stations, spanned, levels, crossed)
    heights = ramped
    if options.limit_grade is not None:
        heights = stations.graph.limited(ramped, options.limit_grade)
    _write(document, stations, heights)
    grades = _grades(stations, heights)
    steep = _steep(grades, roads, stations)
    highest = max(grades.values(), default=0.0)
    if highest > options.max_grade + 1e-3:
        raise MapError(
            f"{source}: roads would climb up to {highest:.0%}, more than {options.max_grade:.0%}:\n"
            f"{quoted(steep)}\nCure: flatten them (--limit-grade {STEEP_GRADE:g}), allow it "
            "(--max-grade), or give a model of the bare ground, in metres"
        )
    moved = np.abs(heights - ramped)[:used]
    on_ground = levels[:used] == 0
    return HeightReport(
        models=tuple(tile.name for tile in model.tiles),
        cell_m=model.cell_m,
        heights_m=(float(heights[:used].min()), float(heights[:used].max())),
        places=coverage.places,
        filled_places=coverage.filled_places,
        void_cells=coverage.void_cells,
        raised_edges=_raised(stations, levels),
        crossings=len(crossed),
        ramp_places=int((on_ground & (np.abs(ramped - spanned)[:used] > 0.01)).sum()),
        smoothed_places=int((moved > 0.01).sum()),
        most_smoothed_m=float(moved.max()),
        max_grade=highest,
        steep=tuple(steep),
    )


def raise_levels(document: NetDocument, roads: OsmRoads, source: Path) -> int:
    """Set the heights that crossings need in a network without a terrain model.

    The ground is at 0. Only bridges and tunnels that cross roads, and their ramps, have heights.

    Args:
        document: a projected network without heights; changed if it has such crossings.
        roads: the bridges and tunnels.
        source: source of the map, for messages.

    Returns:
        The number of crossings of lanes on two levels.

    Raises:
        MapError: an end of a bridge or tunnel cannot be projected.
        MissingExtraError: pyproj is not installed.
    """
    if document.geo is None or not any(way.level for way in roads.ways.values()):
        return 0
    stations = stations_of(document)
    levels = levels_of(stations, roads, document.geo, source)
    crossed = crossings(stations, levels)
    if len(crossed):
        ground = np.zeros(len(stations.plane_m) + len(stations.hubs_m))
        _write(document, stations, _cleared(stations, ground, levels, crossed))
    return len(crossed)


def _at_hubs(stations: Stations, ground: Heights) -> Heights:
    """Return heights of junctions: the mean of the lanes that meet there."""
    base = int(stations.first[-1])
    links = stations.graph.links[stations.graph.links[:, 1] >= base]
    number = len(stations.hubs_m)
    count = np.bincount(links[:, 1] - base, minlength=number)
    total = np.bincount(links[:, 1] - base, ground[links[:, 0]], number)
    mean: Heights = np.where(count > 0, total / np.maximum(count, 1), ground[:base].mean())
    return mean


def _cleared(
    stations: Stations, heights: Heights, levels: Levels, crossed: NDArray[np.int64]
) -> Heights:
    """Lift bridges above crossed roads, lowest first; lower tunnels, highest first."""
    upper, lower = levels[crossed[:, 0]], levels[crossed[:, 1]]
    for level in sorted({*upper[upper > 0].tolist()}):
        pairs = crossed[upper == level]
        floors = np.full(len(heights), -np.inf)
        np.maximum.at(floors, pairs[:, 0], heights[pairs[:, 1]] + CLEARANCE_M)
        floors[floors <= heights] = -np.inf
        heights = stations.graph.lifted(heights, floors, RAMP_GRADE)
    for level in sorted({*lower[(lower < 0) & (upper <= 0)].tolist()}, reverse=True):
        pairs = crossed[(lower == level) & (upper <= 0)]
        caps = np.full(len(heights), np.inf)
        np.minimum.at(caps, pairs[:, 1], heights[pairs[:, 0]] - CLEARANCE_M)
        caps[caps >= heights] = np.inf
        heights = stations.graph.capped(heights, caps, RAMP_GRADE)
    return heights


def _write(document: NetDocument, stations: Stations, heights: Heights) -> None:
    for row, lane in enumerate(stations.lanes):
        rows = stations.rows(row)
        own, z_m = stations.written[rows], heights[rows]
        kept = kept_rows(stations.s_m[rows], z_m, own)
        written = iter(_plane_words(lane.element.get("shape", "")))
        plane = [
            next(written) if own[place] else "{:.2f},{:.2f}".format(*stations.plane_m[rows][place])
            for place in kept.tolist()
        ]
        lane.element.set("shape", shape_text(plane, z_m[kept]))
    hub_of = dict(zip(stations.junction_ids, range(len(stations.hubs_m)), strict=True))
    ends = _lane_ends(stations)
    base = int(stations.first[-1])
    for junction in document.junctions():
        hub = hub_of.get(junction.get("id", ""))
        if hub is None:
            continue
        height = float(heights[base + hub])
        junction.set("z", f"{height:.{HEIGHT_DIGITS}f}")
        plane = _plane_words(junction.get("shape", ""))
        if plane:
            rim = np.array([list(map(float, word.split(","))) for word in plane])
            near = ends.get(hub)
            z_m = np.full(len(rim), height)
            if near is not None:
                apart = rim[:, None] - stations.plane_m[near][None]
                z_m = heights[near][hypot_all(apart[..., 0], apart[..., 1]).argmin(axis=1)]
            junction.set("shape", shape_text(plane, z_m))
    _write_middles(document, stations, heights)


def _write_middles(document: NetDocument, stations: Stations, heights: Heights) -> None:
    """Set the heights of edges' centre lines to those of their first lanes.

    netconvert uses the centre lines for exports.
    """
    node = {
        junction.get("id", ""): f"{junction.get('x')},{junction.get('y')}"
        for junction in document.junctions()
    }
    seen = set()
    for row, lane in enumerate(stations.lanes):
        edge = lane.edge
        ends = [node.get(edge.get(end, ""), "") for end in ("from", "to")]
        if lane.internal or id(edge) in seen or not ("shape" in edge.attrib or all(ends)):
            continue
        seen.add(id(edge))
        plane = _plane_words(edge.get("shape", " ".join(ends)))
        places, s_m, own = laid(np.array([list(map(float, word.split(","))) for word in plane]))
        rows = stations.rows(row)
        apart = places[:, None] - stations.plane_m[rows][None]
        z_m = heights[rows][hypot_all(apart[..., 0], apart[..., 1]).argmin(axis=1)]
        kept = kept_rows(s_m, z_m, own)
        words = iter(plane)
        written = [
            next(words) if own[place] else "{:.2f},{:.2f}".format(*places[place])
            for place in kept.tolist()
        ]
        edge.set("shape", shape_text(written, z_m[kept]))


def _plane_words(shape: str) -> list[str]:
    return [",".join(word.split(",")[:2]) for word in shape.split()]


def _lane_ends(stations: Stations) -> dict[int, NDArray[np.int64]]:
    base = int(stations.first[-1])
    ends: dict[int, list[int]] = {}
    for place, hub in stations.graph.links.tolist():
        if hub >= base:
            ends.setdefault(hub - base, []).append(place)
    return {hub: np.array(rows) for hub, rows in ends.items()}


def _grades(stations: Stations, heights: Heights) -> dict[int, float]:
    """Return the steepest grade of each lane, by its row."""
    step = np.diff(stations.s_m)
    rise = np.abs(np.diff(heights[: len(stations.s_m)]))
    grade = np.where(step > 1e-3, rise / np.maximum(step, 0.1), 0.0)
    grade[stations.first[1:-1] - 1] = 0.0
    return {
        row: float(grade[stations.first[row] : stations.first[row + 1] - 1].max(initial=0.0))
        for row in range(len(stations.lanes))
    }


def _steep(grades: dict[int, float], roads: OsmRoads | None, stations: Stations) -> list[str]:
    """Return roads and junctions above `STEEP_GRADE`, the steepest first."""
    worst: dict[str, float] = {}
    for row, grade in grades.items():
        if grade > STEEP_GRADE + 1e-3:
            name = _named(row, roads, stations)
            worst[name] = max(grade, worst.get(name, 0.0))
    ranked = sorted(worst.items(), key=lambda item: (-item[1], item[0]))
    return [f"{name}: {grade:.1%}" for name, grade in ranked]


def _named(row: int, roads: OsmRoads | None, stations: Stations) -> str:
    lane = stations.lanes[row]
    edge = lane.edge.get("id", "")
    if lane.internal:
        return f"junction {edge[1:].rsplit('_', 1)[0]}"
    for way in lane.ways if roads is not None else ():
        if roads is not None and way in roads.ways and roads.ways[way].name:
            return f"{edge} ({roads.ways[way].name})"
    return edge


def _raised(stations: Stations, levels: Levels) -> tuple[str, ...]:
    rows = np.unique(stations.lane_of[np.flatnonzero(levels[: len(stations.s_m)])])
    lanes = [stations.lanes[row] for row in rows.tolist()]
    return tuple(sorted({lane.edge.get("id", "") for lane in lanes if not lane.internal}))
