"""What runs in the process of one SUMO: libsumo, or TraCI where there is none.

It is run by its file name and imports nothing of this package, so that it is up as soon as libsumo
is. It is told the layout of all records when it is started. Its messages are a head of 32-bit
numbers and then bytes: records, signal letters, and a line of JSON for what seldom happens.

SUMO holds one simulation a process: a second start would silently replace the first one. Here one
is closed before the next is started.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from itertools import chain, compress, repeat
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.processes import die_with_parent

HEAD = np.dtype([("kind", "<i4"), ("records", "<i4"), ("letters", "<i4"), ("line", "<i4")])
START, STEP, LOOK_UP = 0, 1, 2  # kinds of orders
DONE, REFUSED = 0, 1  # kinds of answers

NOWHERE = ""  # the lane of a vehicle on none: waiting or being teleported
PUPPET = "cavmarl."  # begins the names of vehicles that are moved from outside
FREE = 2  # moveToXY: wherever it is told, on a road or not
PARKS = 1 | 64  # flags of a stop: beside the road, at a parking area
BY_ITSELF = 0  # speed and lane change modes: SUMO decides nothing for it

# What is asked of every vehicle, by field of its record; the second only where it is read.
_FIELDS = {"at": "getRouteIndex", "pos": "getLanePosition"}
_FIELDS_SEEN = {
    "angle": "getAngle",
    "speed": "getSpeed",
    "lat": "getLateralLanePosition",
    "signals": "getSignals",
}


class SumoSimulation:
    """The one simulation of this process.

    Args:
        told: what it is told once: names of lanes, edges, signals and types, layouts of records.
    """

    def __init__(self, told: dict[str, Any]) -> None:
        self._sumo: Any = None
        self._runs = False
        self._interface = told["interface"]
        self._seen = np.dtype([tuple(field) for field in told["seen"]])
        self.moved = np.dtype([tuple(field) for field in told["moved"]])
        self._lane_row = {name: row for row, name in enumerate(told["lanes"])}
        self._lane_row[NOWHERE] = -1
        self._edge_row = {name: row for row, name in enumerate(told["edges"])}
        self._edges: list[str] = told["edges"]
        self._signals: list[str] = told["signals"]
        self._type_row: dict[str, int] = told["types"]
        self._is_seen: bool = told["drives"]  # whether places of its vehicles are read
        self._forget()

    def _forget(self) -> None:
        self._number: dict[str, int] = {}  # of vehicles on the road, by name
        self._types: list[int] = []  # by number
        self._route_row: dict[str, int] = {}
        self._puppets: dict[int, str] = {}

    def start(self, words: list[str]) -> dict[str, Any]:
        self._stop()
        self._forget()
        if self._sumo is None:
            self._sumo = importlib.import_module(self._interface)
        self._sumo.start([_binary(self._interface), *words])
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
        """What the files have: types by name, and how many letters each signal has."""
        kinds, lights = self._sumo.vehicletype, self._sumo.trafficlight
        letters = {name: lights.getRedYellowGreenState(name) for name in lights.getIDList()}
        return {
            "types": {name: _describe(kinds, name) for name in sorted(kinds.getIDList())},
            "signals": {name: len(state) for name, state in letters.items()},
        }

    def step(self, moved: NDArray[np.void]) -> tuple[NDArray[np.void], bytes, dict[str, Any]]:
        """One step: puppets to their places, all other vehicles by SUMO."""
        self._place(moved)
        self._sumo.simulationStep()
        return self.look()

    def look(self) -> tuple[NDArray[np.void], bytes, dict[str, Any]]:
        """Where vehicles are now, what signals show, and what is new."""
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
        if self._is_seen:
            places = chain.from_iterable(map(self._place_of, names))
            xyz = np.fromiter(places, np.float64, 3 * len(names)).reshape(-1, 3)
            seen["x"], seen["y"], seen["z"] = xyz.T
        for field, get in self._getters.items():
            seen[field] = np.fromiter(map(get, names), self._seen[field], len(names))
        letters = "".join(map(self._state_of, self._signals)).encode()
        return seen[np.argsort(numbers)], letters, line

    def _on_road(
        self,
    ) -> tuple[Sequence[str], NDArray[np.int32], NDArray[np.int32], list[list[Any]]]:
        """The vehicles that stand or drive on the map's lanes, and which of them have come now.

        Returns names, numbers and LANE rows, and what is to be said of vehicles that have come.
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
        """The row of a type; a vehicle's own one, `type@vehicle`, counts as what it was made of."""
        row = self._type_row.get(kind, self._type_row.get(kind.partition("@")[0]))
        if row is None:
            raise LookupError(f"type '{kind}' is in none of the files")
        return row

    def _register(self, name: str, kind: int) -> list[Any]:
        """A number for a vehicle of a type that has come, or has come back."""
        self._number[name] = len(self._types)
        self._types.append(kind)
        stops = [] if self._is_seen else self._stops(name)
        return [self._number[name], name, self._vehicle.getSpeedFactor(name), stops]

    def _stops(self, name: str) -> list[list[Any]]:
        """Stops that a vehicle is to make: LANE row, start, end, duration, until, off the road.

        Times are in s, -1 where there is none. Those that end by neither, on no lane of the map, or
        at which no vehicle stands are left out.
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
        """Numbers of their routes; the edges of new ones go into the line."""
        known = self._route_row
        ids = [*map(self._route_of, names)]
        rows = np.fromiter(map(known.get, ids, repeat(-1)), np.int32, len(ids))
        for place in np.flatnonzero(rows < 0).tolist():
            route = ids[place]
            if route not in known:
                known[route] = len(known)
                edges = self._vehicle.getRoute(names[place])
                line.setdefault("routes", []).append([self._edge_row.get(e, -1) for e in edges])
            rows[place] = known[route]
        return rows

    def _place(self, moved: NDArray[np.void]) -> None:
        """Bring the puppets to their places; new ones come, others go."""
        vehicle = self._vehicle
        present = set(vehicle.getIDList()) if len(moved) or self._puppets else set()
        wanted = {int(row["id"]) for row in moved}
        for number in [number for number in self._puppets if number not in wanted]:
            name = self._puppets.pop(number)
            if name in present:
                vehicle.remove(name)
        for row in moved.tolist():
            number, x, y, angle, edge, kind = row
            name = f"{PUPPET}{number}"
            if name not in present:
                self._add(name, self._edges[edge], kind)
                self._puppets[number] = name
            vehicle.moveToXY(name, "", -1, x, y, angle, FREE)

    def _add(self, name: str, edge: str, kind: int) -> None:
        route = f"{PUPPET}{edge}"
        if route not in self._sumo.route.getIDList():
            self._sumo.route.add(route, [edge])
        self._vehicle.add(name, route, typeID=f"{PUPPET}{kind}")
        self._vehicle.setSpeedMode(name, BY_ITSELF)
        self._vehicle.setLaneChangeMode(name, BY_ITSELF)

    def _time_ms(self) -> int:
        time_s: float = self._sumo.simulation.getTime()
        return round(1000.0 * time_s)


def _bare(sumo: Any, domain: str, getter: str) -> Callable[[str], Any]:
    """A getter for names, of libsumo without the Python function that SWIG puts around it.

    That one only hands on what it is given, and costs a fifth of the call. TraCI has none, nor may
    another libsumo: there it is the usual one.
    """
    inner = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    usual: Callable[[str], Any] = getattr(getattr(sumo, domain), getter)
    bare: Callable[[str], Any] = getattr(inner, f"{domain}_{getter}", usual)
    return bare


def _describe(kinds: Any, name: str) -> dict[str, Any]:
    """A type, in SUMO's units."""
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


def _binary(interface: str) -> str:
    """The first word of SUMO's command line; libsumo only looks that there is one."""
    if interface == "libsumo":
        return "sumo"
    return str(importlib.import_module("sumolib").checkBinary("sumo"))


def _read(wire: socket.socket, size: int) -> bytes:
    """So many bytes; where the other side has gone this process ends."""
    parts = []
    while size:
        part = wire.recv(size)
        if not part:
            os._exit(0)
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _order(wire: socket.socket) -> tuple[int, bytes, dict[str, Any]]:
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


def _serve(wire: socket.socket) -> NoReturn:
    _, _, told = _order(wire)
    simulation = SumoSimulation(told)
    while True:
        kind, records, line = _order(wire)
        try:
            if kind == LOOK_UP:
                started = simulation.start(line["words"])
                _answer(wire, DONE, {**started, **simulation.look_up()})
                continue
            if kind == START:
                simulation.start(line["words"])
                found = simulation.look()
            else:
                found = simulation.step(np.frombuffer(records, simulation.moved))
        except Exception as error:  # of SUMO's own kind, which the other side does not know
            _answer(wire, REFUSED, {"error": f"{type(error).__name__}: {error}"})
            continue
        seen, letters, news = found
        _answer(wire, DONE, news, seen.tobytes(), letters)


def main() -> None:
    """Live as long as the process that has started this one."""
    number, parent, dies_with_thread = map(int, sys.argv[1:])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side, which closes
    if dies_with_thread:
        die_with_parent()
    if os.getppid() == parent:
        _serve(socket.socket(fileno=number))


if __name__ == "__main__":
    main()
