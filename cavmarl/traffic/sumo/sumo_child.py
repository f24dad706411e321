"""The program of a SUMO process: it runs libsumo, or TraCI if libsumo is not installed.

The program is run by its file name and imports nothing of this package, so that it starts as fast
as libsumo does. At its start it receives the layouts of all records. A message consists of a head
of 32-bit numbers, and of bytes: records, signal letters, and a line of JSON for rare events.

libsumo allows one simulation per process: a second start would silently replace the first. So the
running simulation is closed before the next simulation is started.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from itertools import chain, compress, repeat
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

HEAD = np.dtype([("kind", "<i4"), ("records", "<i4"), ("letters", "<i4"), ("line", "<i4")])
START, STEP, LOOK_UP = 0, 1, 2  # kinds of requests
DONE, REFUSED = 0, 1  # kinds of answers

NOWHERE = ""  # lane of a vehicle on no lane: waiting to enter, or being teleported
PUPPET = "cavmarl."  # prefix of the names of puppets, vehicles that SUMO does not move
FREE = 2  # mode of moveToXY: anywhere, on a road or not
PARKS = 1 | 64  # flags of a stop: beside the road, at a parking area
BY_ITSELF = 0  # speed mode and lane change mode in which SUMO decides nothing
LANE_CHANGE = -1  # `kind` of the record of a lane that changes
SIZE_M = 1e-4  # sizes that differ by less than this count as equal

# Getters that are read for each vehicle, by field of its record; _FIELDS_SEEN only if SUMO drives.
_FIELDS = {"at": "getRouteIndex", "pos": "getLanePosition"}
_FIELDS_SEEN = {
    "angle": "getAngle",
    "speed": "getSpeed",
    "lat": "getLateralLanePosition",
    "signals": "getSignals",
}


class SumoSimulation:
    """The simulation of this process.

    Args:
        setup: sent once; names of lanes, edges, signals and types, and layouts of records.
    """

    def __init__(self, setup: dict[str, Any]) -> None:
        self._sumo: Any = importlib.import_module(setup["interface"])
        self._program = _program(setup["interface"])
        self._runs = False
        self._seen = np.dtype([tuple(field) for field in setup["seen"]])
        self.moved = np.dtype([tuple(field) for field in setup["moved"]])
        self._lane_row = {name: row for row, name in enumerate(setup["lanes"])}
        self._lane_row[NOWHERE] = -1
        self._edge_row = {name: row for row, name in enumerate(setup["edges"])}
        self._edges: list[str] = setup["edges"]
        self._signals: list[str] = setup["signals"]
        self._type_row: dict[str, int] = setup["types"]
        self._is_seen: bool = setup["drives"]  # whether the positions of SUMO's vehicles are read
        self._lane_names: list[str] = setup["lanes"]
        self._classes: list[list[str]] = setup["classes"]  # SUMO's classes by bit of a class
        self._reroutes: str = setup["reroutes"]  # see `population.reroute`
        self._outages_ms: dict[str, int] = setup["outages_ms"]  # time of failure by signal
        self._num_slots: int = setup["persons"]  # maximum number of persons that are reported
        self._forget()

    def _forget(self) -> None:
        self._number: dict[str, int] = {}  # vehicle on the road: its number
        self._types: list[int] = []  # type by number of the vehicle
        self._route_row: dict[str, int] = {}
        self._puppets: dict[int, str] = {}
        self._allowed: dict[str, tuple[str, ...]] = {}  # classes of changed lanes, as on the map
        self._shut: dict[str, set[str]] = {}  # closed classes by lane
        self._unsure: set[str] = set()  # vehicles whose routes are examined again each second
        self._waiting: set[str] = set()  # loaded vehicles that have not entered
        self._goals: dict[int, str] = {}  # last edge of each route, by its number
        self._goal_of: dict[int, str] = {}  # last edge of each vehicle's route
        self._slot_of: dict[str, int] = {}  # slot by person
        self._to_fail = dict(self._outages_ms)
        self._free_slots = list(reversed(range(self._num_slots)))

    def start(self, words: list[str]) -> dict[str, Any]:
        self._stop()
        self._forget()
        self._sumo.start([self._program, *words])
        self._runs = True
        self._vehicle = self._sumo.vehicle
        fields = {**_FIELDS, **(_FIELDS_SEEN if self._is_seen else {})}
        self._getters = {field: _bare(self._sumo, "vehicle", get) for field, get in fields.items()}
        self._lane_of = _bare(self._sumo, "vehicle", "getLaneID")
        self._route_of = _bare(self._sumo, "vehicle", "getRouteID")
        self._place_of = _bare(self._sumo, "vehicle", "getPosition3D")
        self._state_of = _bare(self._sumo, "trafficlight", "getRedYellowGreenState")
        return {"version": str(self._sumo.getVersion()[1]), "time_ms": self._time_ms()}

    def _stop(self) -> None:
        if self._runs:
            self._runs = False
            self._sumo.close()

    def look_up(self) -> dict[str, Any]:
        """Return the content of the files: types by name, and number of letters by signal."""
        kinds, lights = self._sumo.vehicletype, self._sumo.trafficlight
        letters = {name: lights.getRedYellowGreenState(name) for name in lights.getIDList()}
        return {
            "types": {name: _describe(kinds, name) for name in sorted(kinds.getIDList())},
            "signals": {name: len(state) for name, state in letters.items()},
        }

    def step(self, moved: NDArray[np.void]) -> tuple[NDArray[np.void], bytes, dict[str, Any]]:
        """Run one step: change lanes, place puppets, and let SUMO move all other vehicles.

        If no puppets are placed, the records that are not lanes are vehicles that ask for a route.
        """
        is_lane = moved["kind"] == LANE_CHANGE
        if is_lane.any():
            self._change_lanes(moved[is_lane])
        if self._is_seen:
            self._place(moved[~is_lane])
        self._fail_signals()
        self._sumo.simulationStep()
        line = self._after_closures() if self._allowed else {}
        seen, letters, news = self.read_state()
        if not self._is_seen and not is_lane.all():
            line["ways"] = self._find_ways(moved[~is_lane], news)
        return seen, letters, news | line

    def _fail_signals(self) -> None:
        """Switch off the signals that fail by the end of the next step."""
        after_ms = self._time_ms() + round(1000.0 * self._sumo.simulation.getDeltaT())
        for name in [name for name, at_ms in self._to_fail.items() if at_ms <= after_ms]:
            del self._to_fail[name]
            self._sumo.trafficlight.setProgram(name, "off")

    def _change_lanes(self, changes: NDArray[np.void]) -> None:
        """Set the classes and the speed limits of lanes, and let vehicles find other routes."""
        lanes = self._sumo.lane
        for bits, limit_mps, row in zip(
            changes["id"].tolist(), changes["x"].tolist(), changes["edge"].tolist(), strict=True
        ):
            name = self._lane_names[row]
            on_map = self._allowed.setdefault(name, tuple(lanes.getAllowed(name)))
            shut = {one for k, of in enumerate(self._classes) if bits >> k & 1 for one in of}
            allowed = [one for one in on_map if one not in shut]
            self._shut[name] = shut
            lanes.setMaxSpeed(name, limit_mps)
            if allowed:
                lanes.setAllowed(name, allowed)
            else:
                lanes.setDisallowed(name, ["all"])
        present = set(self._vehicle.getIDList())
        puppets = set(self._puppets.values())
        absent = set(self._vehicle.getLoadedIDList()) - present - puppets
        # SUMO reports a negative time of departure until the vehicle departs.
        self._waiting |= {name for name in absent if self._vehicle.getDeparture(name) < 0.0}
        self._renew_routes(present - puppets)

    def _after_closures(self) -> dict[str, Any]:
        """Renew routes after a step; return the names of vehicles that SUMO has dropped.

        SUMO drops a vehicle whose first edge is closed to it at its departure.
        """
        simulation = self._sumo.simulation
        puppets = set(self._puppets.values())
        entered = set(simulation.getDepartedIDList()) - puppets
        self._waiting |= set(simulation.getLoadedIDList()) - puppets
        self._waiting -= entered
        present = set(self._vehicle.getIDList())
        is_second = self._time_ms() % 1000 < round(1000.0 * simulation.getDeltaT())
        self._renew_routes((entered | self._unsure if is_second else entered) & present)
        self._unsure &= present
        if not self._waiting:
            return {}
        dropped = self._waiting - set(self._vehicle.getLoadedIDList())
        self._waiting -= dropped
        return {"dropped": sorted(dropped)} if dropped else {}

    def _renew_routes(self, names: set[str]) -> None:
        """Let SUMO find another route for each vehicle whose route leads over a closed lane.

        `_unsure` receives the vehicles that cannot turn off now, or are in a junction or on a
        closed lane.
        """
        if self._reroutes == "never":
            return
        vehicle = self._vehicle
        for name in sorted(names):
            lane = vehicle.getLaneID(name)
            kind = vehicle.getVehicleClass(name)
            is_bound = lane.startswith(":") or kind in self._shut.get(lane, ())
            if lane == NOWHERE or is_bound:
                self._unsure.add(name)
                continue
            if self._reroutes == "always" or not vehicle.isRouteValid(name):
                vehicle.rerouteTraveltime(name)
            if vehicle.isRouteValid(name):
                self._unsure.discard(name)
            else:
                self._unsure.add(name)

    def _find_ways(self, asking: NDArray[np.void], line: dict[str, Any]) -> list[list[int]]:
        """Return number, route and type of each vehicle that has a route to its goal."""
        found: dict[tuple[int, str, int], int] = {}
        ways = []
        for number, edge, kind in zip(
            asking["id"].tolist(), asking["edge"].tolist(), asking["kind"].tolist(), strict=True
        ):
            key = edge, self._goal_of[number], kind
            if key not in found:
                found[key] = self._find_way(self._edges[edge], key[1], kind, line)
            if found[key] >= 0:
                ways.append([number, found[key], kind])
        return ways

    def _find_way(self, start: str, goal: str, kind: int, line: dict[str, Any]) -> int:
        """Return the number of the fastest route that is open to a type, or -1."""
        name = next(name for name, row in self._type_row.items() if row == kind)
        try:
            edges = self._sumo.simulation.findRoute(start, goal, name).edges
        except self._sumo.TraCIException:  # the first edge is closed
            return -1
        return self._number_route("|".join(edges), edges, line) if edges else -1

    def read_state(self) -> tuple[NDArray[np.void], bytes, dict[str, Any]]:
        """Return the records of vehicles, the letters of signals, and rare events."""
        line: dict[str, Any] = {"time_ms": self._time_ms()}
        lifted = [
            [self._number.pop(name), name]
            for name in self._sumo.simulation.getStartingTeleportIDList()
            if name in self._number
        ]
        names, numbers, lanes, fresh = self._on_road()
        for key, news in (("teleported", lifted), ("departed", fresh)):
            if news:
                line[key] = news
        seen = np.zeros(len(names), dtype=self._seen)
        seen["number"] = numbers
        seen["vtype"] = np.array(self._types, dtype=np.int32)[numbers]
        seen["lane"] = lanes
        seen["route"] = self._routes(names, line)
        if self._reroutes and not self._is_seen:
            goals = map(self._goals.__getitem__, seen["route"].tolist())
            self._goal_of.update(zip(numbers.tolist(), goals, strict=True))
        if self._is_seen:
            places = chain.from_iterable(map(self._place_of, names))
            xyz = np.fromiter(places, np.float64, 3 * len(names)).reshape(-1, 3)
            seen["x"], seen["y"], seen["z"] = xyz.T
        for field, get in self._getters.items():
            seen[field] = np.fromiter(map(get, names), self._seen[field], len(names))
        letters = "".join(map(self._state_of, self._signals)).encode()
        seen = seen[np.argsort(numbers)]
        if self._num_slots:
            seen = np.concatenate([self._people(line), seen])
        return seen, letters, line

    def _people(self, line: dict[str, Any]) -> NDArray[np.void]:
        """Return the records of persons on foot; `line` gets the number of persons without a slot.

        A slot stays free for one step before another person gets it.
        """
        person = self._sumo.person
        names = [name for name in person.getIDList() if not person.getVehicle(name)]
        left = sorted(self._slot_of.keys() - set(names))
        fresh = [name for name in names if name not in self._slot_of]
        for name in fresh[: len(self._free_slots)]:
            self._slot_of[name] = self._free_slots.pop()
        self._free_slots += [self._slot_of.pop(name) for name in left]
        if unseen := len(names) - len(self._slot_of):
            line["unseen"] = unseen
        names = [name for name in names if name in self._slot_of]
        seen = np.zeros(len(names), dtype=self._seen)
        seen["number"] = [-1 - self._slot_of[name] for name in names]
        places = chain.from_iterable(map(person.getPosition3D, names))
        seen["x"], seen["y"], seen["z"] = np.fromiter(places, np.float64).reshape(-1, 3).T
        for field, get in (
            ("angle", person.getAngle),
            ("speed", person.getSpeed),
            ("pos", person.getLength),
            ("lat", person.getWidth),
        ):
            seen[field] = np.fromiter(map(get, names), np.float64, len(names))
        return seen

    def _on_road(
        self,
    ) -> tuple[Sequence[str], NDArray[np.int32], NDArray[np.int32], list[list[Any]]]:
        """Find the vehicles on the map's lanes, and register vehicles that have entered.

        Returns names, numbers and LANE rows, and the reports of newly entered vehicles.
        """
        vehicle, none = self._vehicle, repeat(-1)
        names = vehicle.getIDList()
        lanes = map(self._lane_row.get, map(self._lane_of, names), none)
        rows = np.fromiter(lanes, np.int32, len(names))
        known = map(self._number.get, names, none)
        numbers = np.fromiter(known, np.int32, len(names))
        is_here = (rows >= 0) & (numbers >= 0)
        there = int(is_here.sum())
        come = np.flatnonzero((rows >= 0) & (numbers < 0)).tolist()
        if there < len(self._number):
            for name in self._number.keys() - set(compress(names, is_here)):
                del self._number[name]
        fresh = []
        puppets = set(self._puppets.values()) if come else set()
        for place in come:
            name = names[place]
            if name in puppets:
                continue
            kind = self._row_of(vehicle.getTypeID(name))
            if kind >= 0:
                fresh.append(self._register(name, kind))
                numbers[place] = self._number[name]
                is_here[place] = True
        return [*compress(names, is_here)], numbers[is_here], rows[is_here], fresh

    def _row_of(self, kind: str) -> int:
        """Return the row of a type; a vehicle's own type, `type@vehicle`, has the row of `type`."""
        row = self._type_row.get(kind, self._type_row.get(kind.partition("@")[0]))
        if row is None:
            raise LookupError(f"type '{kind}' is not in the files")
        return row

    def _register(self, name: str, kind: int) -> list[Any]:
        """Assign a number to a vehicle that has entered, or entered again; return its report."""
        self._number[name] = len(self._types)
        self._types.append(kind)
        stops = [] if self._is_seen else self._stops(name)
        return [self._number[name], name, self._vehicle.getSpeedFactor(name), stops]

    def _stops(self, name: str) -> list[list[Any]]:
        """Return the future stops of a vehicle: LANE row, start, end, duration, until, parking.

        Times are in s, -1 if not given. The result omits stops with neither time, stops off the
        map's lanes, and stops with the speed of a waypoint.
        """
        found = []
        for stop in self._vehicle.getStops(name):
            row = self._lane_row.get(stop.lane, -1)
            ends = stop.duration >= 0.0 or stop.until >= 0.0
            if row >= 0 and ends and not stop.speed > 0.0:
                times = [max(-1.0, time) for time in (stop.duration, stop.until)]
                parks = bool(stop.stopFlags & PARKS)
                found.append([row, stop.startPos, stop.endPos, *times, parks])
        return found

    def _routes(self, names: Sequence[str], line: dict[str, Any]) -> NDArray[np.int32]:
        """Return the number of each vehicle's route; edges of new routes are added to `line`."""
        known = self._route_row
        ids = [*map(self._route_of, names)]
        rows = np.fromiter(map(known.get, ids, repeat(-1)), np.int32, len(ids))
        for place in np.flatnonzero(rows < 0).tolist():
            route = ids[place]
            if route not in known:
                self._number_route(route, self._vehicle.getRoute(names[place]), line)
            rows[place] = known[route]
        return rows

    def _number_route(self, route: str, edges: Sequence[str], line: dict[str, Any]) -> int:
        """Return the number of a route; the edges of a new route are added to `line`."""
        number = self._route_row.setdefault(route, len(self._goals))
        if number == len(self._goals):
            self._goals[number] = edges[-1]
            line.setdefault("routes", []).append([self._edge_row.get(e, -1) for e in edges])
        return number

    def _place(self, moved: NDArray[np.void]) -> None:
        """Place the puppets. Add new puppets, and remove puppets that are not listed."""
        vehicle = self._vehicle
        present = set(vehicle.getIDList()) if len(moved) or self._puppets else set()
        wanted = {int(row["id"]) for row in moved}
        for number in [number for number in self._puppets if number not in wanted]:
            name = self._puppets.pop(number)
            if name in present:
                vehicle.remove(name)
        for row in moved.tolist():
            number, x, y, angle, length, width, edge, kind = row
            name = f"{PUPPET}{number}"
            if name not in present:
                self._add(name, self._edges[edge], kind, length, width)
                self._puppets[number] = name
            vehicle.moveToXY(name, "", -1, x, y, angle, FREE)

    def _add(self, name: str, edge: str, kind: int, length: float, width: float) -> None:
        route = f"{PUPPET}{edge}"
        if route not in self._sumo.route.getIDList():
            self._sumo.route.add(route, [edge])
        self._vehicle.add(name, route, typeID=f"{PUPPET}{kind}")
        self._vehicle.setSpeedMode(name, BY_ITSELF)
        self._vehicle.setLaneChangeMode(name, BY_ITSELF)
        # A vehicle whose size differs from its type gets its own type.
        if abs(self._vehicle.getLength(name) - length) > SIZE_M:
            self._vehicle.setLength(name, length)
        if abs(self._vehicle.getWidth(name) - width) > SIZE_M:
            self._vehicle.setWidth(name, width)

    def _time_ms(self) -> int:
        time_s: float = self._sumo.simulation.getTime()
        return round(1000.0 * time_s)


def _bare(sumo: Any, domain: str, getter: str) -> Callable[[str], Any]:
    """Return a getter by name, without the Python wrapper that SWIG generates for libsumo.

    The wrapper only forwards its arguments, but takes a fifth of a call's time. If the interface
    has no such inner function, as in TraCI, return the usual getter.
    """
    inner = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    usual: Callable[[str], Any] = getattr(getattr(sumo, domain), getter)
    bare: Callable[[str], Any] = getattr(inner, f"{domain}_{getter}", usual)
    return bare


def _describe(kinds: Any, name: str) -> dict[str, Any]:
    """Return the parameters of a type in SUMO's units."""
    return {
        "vclass": kinds.getVehicleClass(name),
        "length": kinds.getLength(name),
        "width": kinds.getWidth(name),
        "height": kinds.getHeight(name),
        "min_gap": kinds.getMinGap(name),
        "accel": kinds.getAccel(name),
        "decel": kinds.getDecel(name),
        "emergency_decel": kinds.getEmergencyDecel(name),
        "tau": kinds.getTau(name),
        "sigma": kinds.getImperfection(name),
        "max_speed": kinds.getMaxSpeed(name),
        "speed_factor": kinds.getSpeedFactor(name),
        "speed_dev": kinds.getSpeedDeviation(name),
    }


def _program(interface: str) -> str:
    """Return the first word of SUMO's command line; libsumo ignores its value."""
    if interface == "libsumo":
        return "sumo"
    return str(importlib.import_module("sumolib").checkBinary("sumo"))


def _read(wire: socket.socket, size: int) -> bytes:
    """Read `size` bytes; if the other side has closed the connection, end this process."""
    parts = []
    while size:
        part = wire.recv(size)
        if not part:
            os._exit(0)
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _request(wire: socket.socket) -> tuple[int, bytes, dict[str, Any]]:
    head = np.frombuffer(_read(wire, HEAD.itemsize), HEAD)[0]
    records = _read(wire, int(head["records"]))
    line = _read(wire, int(head["line"]))
    return int(head["kind"]), records, json.loads(line) if line else {}


def _answer(
    wire: socket.socket, kind: int, line: dict[str, Any], records: bytes = b"", letters: bytes = b""
) -> None:
    text = json.dumps(line).encode()
    head = np.array([(kind, len(records), len(letters), len(text))], dtype=HEAD)
    wire.sendall(head.tobytes() + records + letters + text)


def limit_memory(most_bytes: int) -> None:
    """Limit the memory that this process may allocate; Linux only.

    Child processes inherit the limit.
    """
    if sys.platform == "linux":
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        pages_now = int(Path("/proc/self/statm").read_text().split()[5])
        most = most_bytes + pages_now * resource.getpagesize()
        if hard != resource.RLIM_INFINITY:
            most = min(most, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def _serve(wire: socket.socket, most_bytes: int) -> NoReturn:
    _, _, setup = _request(wire)
    simulation = SumoSimulation(setup)
    # From here, the files determine how much memory is needed. An import that runs out of memory
    # may raise almost any error, so the limit is set after the imports.
    limit_memory(most_bytes)
    while True:
        kind, records, line = _request(wire)
        try:
            if kind == LOOK_UP:
                started = simulation.start(line["words"])
                _answer(wire, DONE, {**started, **simulation.look_up()})
                continue
            if kind == START:
                simulation.start(line["words"])
                found = simulation.read_state()
            else:
                found = simulation.step(np.frombuffer(records, simulation.moved))
        except Exception as error:  # the other side does not know SUMO's error types
            _answer(wire, REFUSED, {"error": f"{type(error).__name__}: {error}"})
            continue
        seen, letters, news = found
        _answer(wire, DONE, news, seen.tobytes(), letters)


def main() -> None:
    """Serve requests until the process that started this one ends."""
    number, most_bytes = map(int, sys.argv[1:])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side handles Ctrl-C and closes
    _serve(socket.socket(fileno=number), most_bytes)


if __name__ == "__main__":
    main()
