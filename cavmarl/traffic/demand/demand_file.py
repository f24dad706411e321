"""`DemandFile`: the immutable demand of SUMO files on a map, from which episodes are drawn."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import DemandError
from cavmarl.core.xml_root import is_sumo_config
from cavmarl.driving.vehicle_types import STATED_FIELDS, VTYPE
from cavmarl.roads.network import RoadNetwork, content_of
from cavmarl.traffic.demand.definition_collector import DefinitionCollector
from cavmarl.traffic.demand.demand_records import FLOW_REGULAR, ORDER, POS_GIVEN, Choices
from cavmarl.traffic.demand.drawing import (
    DRAW_REROUTE,
    DRAW_ROUTE,
    DRAW_TYPE,
    chances,
    copied,
    departures_ms,
    scaled_flows,
)
from cavmarl.traffic.demand.element import MAX_TIME_MS, DemandReport, late_begin
from cavmarl.traffic.demand.map_index import MapIndex
from cavmarl.traffic.demand.rerouters import Rerouters
from cavmarl.traffic.demand.rerouting_device import DeviceOptions
from cavmarl.traffic.demand.resolver import Resolver
from cavmarl.traffic.demand.sumo_config import SumoConfigFile, read_sumo_config
from cavmarl.traffic.demand.xml_files import read_elements

MAX_DEPARTURES = 2_000_000

_COPIED = (
    "depart_pos_code",
    "depart_speed_code",
    "depart_speed",
    "arrival_pos_code",
    "arrival_speed_code",
    "arrival_speed",
    "speed_factor",
)


@dataclass(frozen=True, eq=False)
class DemandFile:
    """The vehicles that drive on a map; see `demand_records` for the dtypes."""

    network: RoadNetwork  # the network that all rows refer to
    types: NDArray[np.void]
    type_ids: tuple[str, ...]  # names of `types`
    routes: NDArray[np.void]  # ROUTE (num_routes,); equal routes are stored once
    route_edges: NDArray[np.int32]  # EDGE rows that ROUTE points into
    route_ids: tuple[str, ...]  # names of `routes`; "" for routes defined inside vehicles
    stops: NDArray[np.void]  # STOP (num_stops,) that ROUTE and ELEMENT refer to
    elements: NDArray[np.void]  # ELEMENT (num_elements,), in the order of the files
    element_ids: tuple[str, ...]  # ids of vehicles, trips and flows
    type_choices: Choices  # lists of VTYPE rows with probabilities
    route_choices: Choices  # lists of ROUTE rows with probabilities
    # pairs of a type and a route that it cannot drive, as sorted numbers type * num_routes + route;
    # empty unless vehicles that cannot drive their route are skipped
    bad_pairs: NDArray[np.int64]
    rerouters: Rerouters  # rules that reroute vehicles on certain edges
    device: DeviceOptions  # options of the rerouting device for all vehicles
    # (num_edges, n) LANE row by SUMO's index on the edge, -1 if there is none
    lane_table: NDArray[np.int32]
    begin_ms: int  # start of the simulation for which the files were made
    has_begin: bool  # whether the files state `begin_ms`; if not, it is 0; not part of the hash
    end_ms: int  # end of the simulation; `MAX_TIME_MS` if the files state no end
    step_ms: int
    scale: float  # number of vehicles per departure in the files
    report: DemandReport  # counts of elements that were read or tolerated

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @property
    def content_hash(self) -> str:
        """SHA-256 (hex) of everything that episodes depend on."""
        digest = hashlib.sha256()
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Choices):
                for part in (value.start, value.rows, value.upper):
                    digest.update(part.tobytes())
            elif isinstance(value, Rerouters):
                digest.update(value.content())
            elif isinstance(value, DeviceOptions):
                digest.update(repr(value).encode())
            elif isinstance(value, np.ndarray):
                stated = value[STATED_FIELDS] if value.dtype == VTYPE else value
                digest.update(content_of(stated))
            elif isinstance(value, tuple):
                digest.update("\0".join(value).encode())
            elif isinstance(value, float) and value != 1.0:
                digest.update(f"{field.name}={value!r}".encode())
            elif isinstance(value, int) and not isinstance(value, bool):
                digest.update(f"{field.name}={value}".encode())
        return digest.hexdigest()

    def draw(self, key: int, until_s: float | None = None) -> NDArray[np.void]:
        """Draw the departures of one episode (ORDER rows), a pure function of the key.

        `key`: random key of the world and episode, see `math.rng.world_key`. `until_s`: no vehicle
        departs at or after this time; None: the end of the files' simulation.

        Returns ORDER (n,), sorted by departure, then in the order of the files.
        """
        end_ms = self.end_ms if until_s is None else min(self.end_ms, round(until_s * 1000.0))
        rows, numbers, times = departures_ms(self.elements, key, self.begin_ms, end_ms)
        if self.scale != 1.0:
            rows, numbers, times = copied(self.elements, rows, numbers, times, self.scale)
        order = np.lexsort((numbers, rows, times))
        rows, numbers, times = rows[order], numbers[order], times[order]
        types = self._pick(self.type_choices, "types", rows, numbers, key, DRAW_TYPE)
        routes = self._pick(self.route_choices, "routes", rows, numbers, key, DRAW_ROUTE)
        driven = ~np.isin(types.astype(np.int64) * len(self.routes) + routes, self.bad_pairs)
        rows, numbers, times = rows[driven], numbers[driven], times[driven]
        types, routes, element = types[driven], routes[driven], self.elements[rows]
        orders = np.zeros(len(rows), dtype=ORDER)
        orders["depart"] = times / 1000.0
        orders["element"], orders["number"] = rows, numbers
        orders["vtype"], orders["route"] = types, routes
        own = element["first_stop"] >= 0
        for name in ("first_stop", "num_stops"):
            orders[name] = np.where(own, element[name], self.routes[name][routes])
        chance = self._device_setting("reroute", element, types, self.device.chance)
        orders["reroute"] = chances(key, rows, numbers, DRAW_REROUTE) < chance
        orders["reroute_period_ms"] = self._device_setting(
            "reroute_period_ms", element, types, self.device.period_ms
        )
        for name in _COPIED:
            orders[name] = element[name]
        self._place(orders, element)
        return orders

    @property
    def may_look(self) -> bool:
        """True if any vehicle may have a rerouting device."""
        return any(
            bool((chance > 0.0).any())
            for chance in (self.elements["reroute"], self.types["reroute"])
        ) or (self.device.chance > 0.0 and len(self.elements) > 0)

    def _device_setting(
        self, field: str, element: NDArray[np.void], types: NDArray[np.int32], default: float
    ) -> NDArray[np.float64]:
        """Return a device setting of vehicles (n,), from the vehicle, its type, or the default."""
        setting: NDArray[np.float64] = self.types[field][types].astype(np.float64)
        setting = np.where(setting < 0.0, default, setting)
        return np.where(element[field] < 0, setting, element[field])

    def _pick(
        self,
        choices: Choices,
        field: str,
        rows: NDArray[np.int64],
        numbers: NDArray[np.int64],
        key: int,
        stream: int,
    ) -> NDArray[np.int32]:
        """Return the row that each vehicle (n,) draws from the choice of its element."""
        return choices.pick(self.elements[field][rows], chances(key, rows, numbers, stream))

    def vehicle_id(self, order: np.void) -> str:
        """Return SUMO's name of the vehicle of one ORDER row."""
        row = int(order["element"])
        name = self.element_ids[row]
        numbered = self.elements[row]["flow"] or order["number"] > 0
        return f"{name}.{order['number']}" if numbered else name

    def place(self, row: int) -> str:
        element = self.elements[row]
        return f"{self.report.files[int(element['file'])]}, line {element['line']}"

    @property
    def tolerated(self) -> tuple[str, ...]:
        """Parts of the files that were left out or replaced, one line each with its count."""
        return tuple(self.report.lines())

    def begun(self, horizon_s: float) -> DemandFile:
        """Return this demand, with a later begin if no vehicle departs within an episode.

        If the files state no begin, and no vehicle departs in the first `horizon_s`, the demand
        begins at its first departure, rounded down to whole seconds. The report states this. If
        still no vehicle departs within an episode, the demand does not change, and the report
        states that.
        """
        if self._departs_within(horizon_s):
            return self
        elements = self.elements
        some = elements[(elements["number"] > 0) & (elements["end_ms"] > elements["begin_ms"])]
        if not len(some):
            return self
        first = some[np.argmin(some["begin_ms"])]
        first_ms = int(first["begin_ms"])
        place = f"{self.report.files[int(first['file'])]}, line {first['line']}"
        begun = self if self.has_begin else replace(self, begin_ms=first_ms // 1000 * 1000)
        stays = not begun._departs_within(horizon_s)
        what = late_begin(self.begin_ms / 1000.0, horizon_s, first_ms, stays)
        self.report.tolerate(what, place)
        return self if stays else begun

    def _departs_within(self, horizon_s: float) -> bool:
        """Return whether a vehicle may depart within an episode."""
        end_ms = min(self.begin_ms + round(horizon_s * 1000.0), self.end_ms)
        elements = self.elements
        random = elements[elements["pattern"] != FLOW_REGULAR]
        may = (random["begin_ms"] < end_ms) & (random["end_ms"] > self.begin_ms)
        may &= random["number"] > 0
        regular = elements[elements["pattern"] == FLOW_REGULAR]
        return bool(may.any()) or len(departures_ms(regular, 0, self.begin_ms, end_ms)[0]) > 0

    def to_report(self) -> str:
        """Return lines for a terminal: counts of read and tolerated elements."""
        return self.report.to_report()

    def _place(self, orders: NDArray[np.void], element: NDArray[np.void]) -> None:
        """Convert lanes to LANE rows, and positions to distances from the start of the edge."""
        route = self.routes[orders["route"]]
        ends = {
            "depart": self.route_edges[route["first_edge"]],
            "arrival": self.route_edges[route["first_edge"] + route["num_edges"] - 1],
        }
        for end, edges in ends.items():
            lane = element[f"{end}_lane"]
            rows = self.lane_table[edges, np.clip(lane, 0, self.lane_table.shape[1] - 1)]
            orders[f"{end}_lane"] = np.where(lane < 0, lane, rows)
            length = self.network.edges["length_m"][edges]
            place = element[f"{end}_pos"]
            place = np.clip(np.where(place < 0.0, place + length, place), 0.0, length)
            orders[f"{end}_pos"] = np.where(element[f"{end}_pos_code"] == POS_GIVEN, place, 0.0)


def read_demand(
    paths: Sequence[Path],
    network: RoadNetwork,
    *,
    on_bad_route: Literal["error", "skip"] = "error",
    max_departures: int = MAX_DEPARTURES,
    programs: Sequence[Path] = (),
) -> DemandFile:
    """Read SUMO's files of vehicles, routes, types and stopping places.

    Args:
        paths: `.rou.xml` and `.add.xml` files, plain or gzipped, in any order; a SUMO configuration
            (`.sumocfg`) stands for the files and options that it names.
        network: the map.
        on_bad_route: how to handle vehicles whose class cannot drive their route, and stops off the
            route: 'error' refuses the file, 'skip' leaves them out and counts them.
        max_departures: maximum number of vehicles.
        programs: files whose signal programs are read elsewhere, so that the report does not count
            these programs as left out.

    Raises:
        DemandError: files are missing, broken, contradictory, or made for another map.
        RouteError: a route is not connected for a class that drives it.
        CapacityError: the files have more than `max_departures` vehicles.
    """
    if on_bad_route not in ("error", "skip"):
        raise DemandError(f"on_bad_route='{on_bad_route}': choose 'error' or 'skip'")
    report = DemandReport(program_files=frozenset(path.resolve() for path in programs))
    config = _configuration(paths, report)
    begin_ms, end_ms = config.begin_ms or 0, config.end_ms
    collector = DefinitionCollector(
        report, begin_ms, end_ms, max_departures, config.departs, config.scale
    )
    for path in config.files:
        read_elements(path, report, collector.take)
    index = MapIndex(network)
    skip = on_bad_route == "skip" or config.skips_bad_routes
    resolver = Resolver(collector, index, skip, config.types)
    elements = resolver.elements()
    if config.scale != 1.0:
        elements = scaled_flows(elements, config.scale)
    rerouters = resolver.rerouters()
    routes, route_edges, stops = resolver.routes.arrays()
    return DemandFile(
        network=network,
        types=resolver.types.records(),
        type_ids=tuple(resolver.types.names),
        routes=routes,
        route_edges=route_edges,
        route_ids=tuple(resolver.routes.names),
        stops=stops,
        elements=elements,
        element_ids=tuple(resolver.ids),
        type_choices=resolver.type_choices(),
        route_choices=resolver.route_choices(),
        bad_pairs=resolver.bad_pairs(),
        rerouters=rerouters,
        device=config.rerouting,
        lane_table=index.lane_table,
        begin_ms=begin_ms,
        has_begin=config.begin_ms is not None,
        end_ms=end_ms if end_ms >= 0 else MAX_TIME_MS,
        step_ms=config.step_ms,
        scale=config.scale,
        report=report,
    )


def _configuration(paths: Sequence[Path], report: DemandReport) -> SumoConfigFile:
    """Return the configuration among `paths`, with all files to read."""
    files: list[Path] = []
    config: SumoConfigFile | None = None
    for path in map(Path, paths):
        if not is_sumo_config(path):
            files.append(path)
            continue
        if config is not None:
            raise DemandError(f"{path}: a second SUMO configuration; give only one of them")
        config = read_sumo_config(path, report)
        files.extend(config.files)
    if not files:
        raise DemandError("no demand file is given; name a .rou.xml or a .sumocfg")
    config = config or SumoConfigFile()
    return replace(config, files=tuple(files))
