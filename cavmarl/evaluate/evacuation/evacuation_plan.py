"""`EvacuationPlan`: the areas that vehicles leave, the exits, and changes of roads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import Section, Whole, Within, check, check_ranges
from cavmarl.config.io import read_yaml, validate
from cavmarl.config.road_events import RoadEvent, check_events
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import CARS, RoadNetwork

SHORTEST_M = 15.0  # on a shorter lane, no vehicle begins its trip
MOST_EXITS = 8  # number of exits that are chosen if the plan names none
FAR_SHARE = 0.6  # least distance of chosen exits, as a share of the largest distance
RADIUS_SHARE = 0.4  # default area: share of the radius that contains 90 % of the roads
AREA = "area"  # name of the default area


@dataclass(frozen=True, kw_only=True)
class Area:
    """An area that vehicles leave, as a polygon or as a list of roads.

    Attributes:
        polygon: corners x, y in m of the map's frame; all roads whose middle is inside belong to
            the area.
        edges: ids of roads.
        vehicles: number of vehicles.
        per_km: vehicles for each km of lane, instead of `vehicles`.
    """

    polygon: tuple[tuple[float, float], ...] = ()
    edges: tuple[str, ...] = ()
    vehicles: Annotated[int, Whole(0, 1_000_000)] | None = None
    per_km: Annotated[float, Within(0.0, 10_000.0)] | None = None


@dataclass(frozen=True, kw_only=True)
class EvacuationPlan(Section, key=""):
    """An evacuation.

    Attributes:
        map: map file, relative to the plan, or the name of an environment.
        areas: the areas by name; the results are listed for each.
        exits: ids of the roads over which vehicles leave; empty: dead ends far from the areas.
        contraflow: ids of roads that are reversed from `start_s` on.
        start_s: time of the order to leave.
        within_s: vehicles depart evenly within this time after the order.
        horizon_s: simulated time.
        background: vehicles of the generator, which drive to their own goals.
        reroute_s: time between two searches of a vehicle for a faster route; a search considers
            the speeds of the last minutes. 0: a single search, after the departure.
        events: roads that close, open, or slow down; see `map.events`.
    """

    map: str
    areas: dict[str, Area]
    exits: tuple[str, ...] = ()
    contraflow: tuple[str, ...] = ()
    start_s: Annotated[float, Within(0.0, 1e5)] = 0.0
    within_s: Annotated[float, Within(0.0, 1e5)] = 600.0
    horizon_s: Annotated[float, Within(1.0, 1e5)] = 3600.0
    background: Annotated[int, Whole(0, 100_000)] = 0
    reroute_s: Annotated[float, Within(0.0, 3600.0)] = 30.0
    events: tuple[RoadEvent, ...] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need("areas", bool(self.areas), "must name an area")
        for name, area in self.areas.items():
            key = f"areas.{name}"
            check_ranges(key, area)
            is_one = bool(area.polygon) != bool(area.edges)
            check(is_one, key, area, "must have either a polygon or edges")
            is_closed = not area.polygon or len(area.polygon) >= 3
            check(is_closed, f"{key}.polygon", area.polygon, "must have three corners or more")
            is_finite = all(math.isfinite(value) for corner in area.polygon for value in corner)
            check(is_finite, f"{key}.polygon", area.polygon, "must consist of finite numbers")
            is_one = (area.vehicles is None) != (area.per_km is None)
            check(is_one, key, area, "must have either vehicles or per_km")
        check_events(self.events, self.contraflow)
        self.need("horizon_s", self.horizon_s % 1.0 == 0.0, "must be a whole number of seconds")
        late = [event.at_s for event in self.events if event.at_s >= self.horizon_s]
        self.need(
            "horizon_s",
            not late,
            f"must be above {max(late, default=0.0):g}, the time of the last event",
        )
        self.need(
            "horizon_s",
            self.start_s + self.within_s < self.horizon_s,
            f"must be above start_s + within_s = {self.start_s + self.within_s:g}, when the last "
            "vehicle departs",
        )


def load_plan(path: Path) -> EvacuationPlan:
    """Read a plan from a YAML file. Raises ConfigError."""
    return validate(EvacuationPlan, read_yaml(path), str(path))


def roads_of(area: Area, name: str, network: RoadNetwork) -> NDArray[np.intp]:
    """Return the EDGE rows of the roads of an area on which cars may drive.

    Raises ConfigError: an edge is unknown, or the area has no such road.
    """
    usable = car_roads(network)
    if area.edges:
        rows = edge_rows(area.edges, f"areas.{name}.edges", network)
        found = rows[usable[rows]]
    else:
        x, y = _middles(network)
        found = np.flatnonzero(usable & _inside(np.array(area.polygon, dtype=np.float64), x, y))
    if not len(found):
        raise ConfigError(
            f"areas.{name}: no road for cars is in the area; give a larger one, in m of the map's "
            "frame (`cavmarl map check MAP` shows its extent)"
        )
    return found


def edge_rows(names: Sequence[str], key: str, network: RoadNetwork) -> NDArray[np.intp]:
    """Return the EDGE rows of some roads. Raises ConfigError for an unknown road."""
    known = {name: row for row, name in enumerate(network.edge_ids)}
    for name in names:
        if name not in known or network.edges["internal"][known[name]]:
            raise ConfigError(f"{key}: the map has no road {name!r}; give ids of roads")
    return np.array([known[name] for name in dict.fromkeys(names)], dtype=np.intp)


def car_roads(network: RoadNetwork) -> NDArray[np.bool_]:
    """Return (num_edges,) whether an edge is a road on which cars may drive."""
    lanes = network.lanes
    usable = np.zeros(len(network.edges), dtype=np.bool_)
    usable[lanes["edge"][~lanes["internal"] & (lanes["permissions"] & CARS != 0)]] = True
    return usable


def middle_of(network: RoadNetwork) -> tuple[float, float, float]:
    """Return x and y of the middle of the roads in m, and the default radius of an area."""
    x, y = _middles(network)
    usable = car_roads(network)
    at = float(np.median(x[usable])), float(np.median(y[usable]))
    away_m = np.hypot(x - at[0], y - at[1])[usable]
    return *at, RADIUS_SHARE * float(np.percentile(away_m, 90))


def circle(x: float, y: float, radius_m: float, vehicles: int) -> Area:
    """Return an area around a place, as a polygon with 24 corners."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    corners = zip(x + radius_m * np.cos(angles), y + radius_m * np.sin(angles), strict=True)
    return Area(polygon=tuple((round(a, 3), round(b, 3)) for a, b in corners), vehicles=vehicles)


def default_exits(plan: EvacuationPlan, network: RoadNetwork) -> tuple[str, ...]:
    """Return dead ends that are far from the areas, the widest ones first.

    Raises ConfigError: the map has no such road.
    """
    x, y = _middles(network)
    areas = np.concatenate([roads_of(area, name, network) for name, area in plan.areas.items()])
    away_m = np.hypot(x - x[areas].mean(), y - y[areas].mean())
    lanes, links, edges = network.lanes, network.links, network.edges
    goes_on = np.zeros(len(edges), dtype=np.bool_)
    for_cars = (lanes["permissions"] & CARS) != 0
    ahead = for_cars[links["from_lane"]] & for_cars[links["to_lane"]]
    ahead &= ~np.isin(links["direction"], (ord("t"), ord("T")))
    goes_on[lanes["edge"][links["from_lane"][ahead]]] = True
    reached = np.zeros(len(edges), dtype=np.bool_)
    reached[lanes["edge"][links["to_lane"][ahead]]] = True
    ends = car_roads(network) & ~goes_on & reached
    ends[areas] = False
    ends &= away_m >= FAR_SHARE * away_m[ends].max(initial=0.0)
    found = np.flatnonzero(ends)
    if not len(found):
        raise ConfigError(
            "exits: no road of the map ends outside of the areas; name the roads over which "
            "vehicles leave"
        )
    width = edges["num_lanes"][found] * edges["speed_mps"][found]
    best = found[np.lexsort((found, -away_m[found], -width))][:MOST_EXITS]
    return tuple(network.edge_ids[edge] for edge in best.tolist())


def _middles(network: RoadNetwork) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y (num_edges,) of the middle of each edge's first lane, in m."""
    lanes = network.lanes[network.edges["first_lane"]]
    place = lanes["first_point"] + lanes["num_points"] // 2
    even = lanes["num_points"] % 2 == 0
    points = network.points
    return (
        np.where(even, 0.5 * (points["x"][place] + points["x"][place - 1]), points["x"][place]),
        np.where(even, 0.5 * (points["y"][place] + points["y"][place - 1]), points["y"][place]),
    )


def _inside(
    corners: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which places are inside of a polygon (even-odd rule)."""
    found = np.zeros(len(x), dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        at = ax + (y - ay) * (bx - ax) / (by - ay if by != ay else 1.0)
        found ^= crosses & (x < at)
    return found
