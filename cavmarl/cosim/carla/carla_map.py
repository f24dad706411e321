"""`CarlaMap`: the road network for clients: OpenDRIVE, spawn points, and traffic lights.

There is one traffic light on each approach to a junction: the lanes of one edge with one signal.
Its state is green only if all movements from these lanes are green.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from html import unescape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.records.codes import (
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
    SIGNAL_OFF,
    SIGNAL_OFF_BLINKING,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.cosim.carla.carla_geometry import CarlaPose, carla_pose
from cavmarl.cosim.carla.navigation_mesh import NavigationMesh, make_navigation_mesh
from cavmarl.maps.components import strong_components
from cavmarl.roads.network import CARS, SIGNAL_STATES, RoadNetwork
from cavmarl.roads.shown_signals import signal_codes

RED, YELLOW, GREEN, OFF = 0, 1, 2, 3  # CARLA's states of traffic lights, the strictest first

_STATE_OF_CODE = np.zeros(len(SIGNAL_STATES), np.uint8)
_STATE_OF_CODE[[SIGNAL_RED, SIGNAL_RED_YELLOW, SIGNAL_STOP_THEN_GO]] = RED
_STATE_OF_CODE[[SIGNAL_YELLOW_MINOR, SIGNAL_YELLOW_MAJOR]] = YELLOW
_STATE_OF_CODE[[SIGNAL_GREEN_MINOR, SIGNAL_GREEN_MAJOR]] = GREEN
_STATE_OF_CODE[[SIGNAL_OFF_BLINKING, SIGNAL_OFF]] = OFF

SPAWN_HEIGHT_M = 0.3  # spawn points are this far above the road
_SPAWN_EVERY_M = 40.0
_FIRST_SPAWN_M = 15.0  # distance of the first spawn point from the start of a lane over 30 m
_SHORTEST_M = 12.0  # a shorter lane has no spawn point
_SIGNAL = re.compile(r"<signal\s([^>]*)>")
_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')
_BOX_BEFORE_LINE_M = 2.0  # distance from the centre of the trigger volume to the stop line


class LightApproach(NamedTuple):
    """A traffic light: the lanes of an edge that one signal controls."""

    signal_id: str  # id of its signal in the OpenDRIVE document
    signal: int  # SIGNAL row
    indices: tuple[int, ...]  # indices of its movements in the state of the signal
    lanes: tuple[int, ...]  # LANE rows
    pose: CarlaPose  # at the stop line, looking across the road
    half_width_m: float
    pole: int  # number among the approaches of its signal

    @property
    def box(self) -> tuple[list[float], list[float]]:
        """Return centre and half extents of the trigger volume, in the frame of the pose."""
        return [0.0, _BOX_BEFORE_LINE_M, 0.0], [self.half_width_m, 1.5, 2.0]


@dataclass(frozen=True, eq=False)
class CarlaMap:
    """The map of an episode.

    Attributes:
        name: name of the map, without folders.
        document: the map as OpenDRIVE.
        spawn_points: poses on lanes that cars may use.
        approaches: the traffic lights.
        states: (approaches, phases) state of each light in each PHASE of its signal.
        approach_of_lane: (lanes,) index of the light at the end of each lane, or -1.
        times_s: (approaches, 3) green, yellow and red time of the first program.
        origin: latitude and longitude of (0, 0), in degrees.
    """

    name: str
    document: str
    network: RoadNetwork
    spawn_points: tuple[CarlaPose, ...]
    approaches: tuple[LightApproach, ...]
    states: NDArray[np.uint8]
    approach_of_lane: NDArray[np.int32]
    times_s: NDArray[np.float32]
    origin: tuple[float, float]

    @property
    def path(self) -> str:
        """The name of the map as clients see it."""
        return f"Carla/Maps/{self.name}"

    def states_in(self, phases: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Return the state (approaches,) of each light; `phases`: see `Worlds.signal_phase`."""
        signals = [approach.signal for approach in self.approaches]
        found: NDArray[np.uint8] = self.states[np.arange(len(signals)), phases[signals]]
        if phases[len(self.network.signals) :].any():
            shown = _STATE_OF_CODE[signal_codes(self.network, phases)[self._links]]
            found = np.minimum.reduceat(shown, self._first_link)
        return found

    @cached_property
    def navigation_mesh(self) -> NavigationMesh | None:
        """Where walkers may walk; None: the map has no roads, or is too large."""
        return make_navigation_mesh(self.network, self.name)

    @cached_property
    def links_of(self) -> tuple[NDArray[np.intp], ...]:
        """LINK rows of each light."""
        links = self.network.links
        return tuple(
            np.flatnonzero((links["signal"] == one.signal) & np.isin(links["from_lane"], one.lanes))
            for one in self.approaches
        )

    @cached_property
    def _links(self) -> NDArray[np.intp]:
        """LINK rows of all lights, one light after another."""
        return np.concatenate(self.links_of)

    @cached_property
    def _first_link(self) -> NDArray[np.intp]:
        """Where the links of each light begin in `_links`."""
        return np.cumsum([0, *map(len, self.links_of)])[:-1]


def make_carla_map(
    network: RoadNetwork, name: str, document: str, origin: tuple[float, float]
) -> CarlaMap:
    """Return the map of a network; `document`: its OpenDRIVE, from `carla_document`.

    Raises MapError: the network consists of several maps.
    """
    if len(network.maps) > 1:
        raise MapError(f"{name}: {len(network.maps)} maps; a server for CARLA's clients has one")
    approaches = _approaches(network, _ids_of_signals(document))
    at_end = np.full(len(network.lanes), -1, np.int32)
    for number, approach in enumerate(approaches):
        at_end[list(approach.lanes)] = number
    return CarlaMap(
        name,
        document,
        network,
        tuple(spawn_points(network)),
        approaches,
        _states(network, approaches),
        at_end,
        _times_s(network, approaches),
        origin,
    )


def _ids_of_signals(document: str) -> dict[str, str]:
    """Return the ids of signals by their names. Parsing a whole town would take seconds."""
    found = {}
    for signal in _SIGNAL.finditer(document):
        values = dict(_ATTRIBUTE.findall(signal[1]))
        found[unescape(values.get("name", ""))] = unescape(values.get("id", ""))
    return found


def spawn_points(network: RoadNetwork) -> list[CarlaPose]:
    """Return poses on lanes that cars may use, `SPAWN_HEIGHT_M` above the road.

    Programs choose starts and destinations at random from these poses. If the largest set of lanes
    that can all reach each other has at least half of the poses, the other poses are left out.
    """
    found: list[CarlaPose] = []
    lanes: list[int] = []
    for lane, row in enumerate(network.lanes):
        length = float(row["length_m"])
        if row["internal"] or not row["permissions"] & CARS or length < _SHORTEST_M:
            continue
        places = np.arange(_FIRST_SPAWN_M, length - _FIRST_SPAWN_M, _SPAWN_EVERY_M).tolist()
        for s in places or [0.5 * length]:
            x, y, z, cos, sin, slope = network.pose_on(lane, s)
            pose = carla_pose(x, y, z, math.atan2(sin, cos), math.atan(slope))
            found.append(pose.at((pose.x, pose.y, pose.z + SPAWN_HEIGHT_M)))
            lanes.append(lane)
    connected = np.flatnonzero(_in_largest_part(network)[lanes]).tolist()
    return [found[row] for row in connected] if 2 * len(connected) >= len(found) else found


def _in_largest_part(network: RoadNetwork) -> NDArray[np.bool_]:
    """Return (lanes,) whether a lane is in the largest strongly connected component for cars."""
    lanes, links = network.lanes, network.links
    for_cars = (lanes["permissions"] & CARS) != 0
    arcs = [np.stack([links["from_lane"], links["to_lane"]], axis=1)]
    for side in ("left", "right"):
        there = np.flatnonzero(lanes[side] >= 0)
        arcs.append(np.stack([there, lanes[side][there]], axis=1))
    joined = np.concatenate(arcs).astype(np.int32)
    part = strong_components(len(lanes), joined[for_cars[joined].all(axis=1)])
    part[lanes["internal"] | ~for_cars] = len(lanes)  # in no component
    found: NDArray[np.bool_] = part == np.bincount(part)[: len(lanes)].argmax()
    return found


def _approaches(network: RoadNetwork, known: Mapping[str, str]) -> tuple[LightApproach, ...]:
    """Return the approaches whose signal is in the document, in order of signal and edge.

    `known`: ids of the signals in the document, by the ids that netconvert has given.
    """
    links = network.links[network.links["signal"] >= 0]
    edges = network.lanes["edge"][links["from_lane"]]
    found: list[LightApproach] = []
    poles: dict[int, int] = {}
    for signal, edge in sorted(set(zip(links["signal"].tolist(), edges.tolist(), strict=True))):
        own = links[(links["signal"] == signal) & (edges == edge)]
        indices = tuple(sorted(set(own["signal_index"].tolist())))
        name = network.signal_ids[signal]
        ids = [known[one] for index in indices if (one := f"{name}_{index}") in known]
        if not ids:
            continue
        lanes = tuple(sorted(set(own["from_lane"].tolist())))
        pose, half_width_m = _stop_line(network, lanes)
        pole = poles[signal] = poles.get(signal, -1) + 1
        found.append(LightApproach(ids[0], signal, indices, lanes, pose, half_width_m, pole))
    return tuple(found)


def _stop_line(network: RoadNetwork, lanes: tuple[int, ...]) -> tuple[CarlaPose, float]:
    """Return the pose of a light at the middle of the ends of lanes, and half their width."""
    ends = np.array([network.pose_on(lane, network.lanes["length_m"][lane]) for lane in lanes])
    x, y, z, cos, sin, _ = ends.mean(axis=0).tolist()
    across = carla_pose(x, y, z, math.atan2(sin, cos) - 0.5 * math.pi)
    return across, 0.5 * float(network.lanes["width_m"][list(lanes)].sum())


def _states(network: RoadNetwork, approaches: tuple[LightApproach, ...]) -> NDArray[np.uint8]:
    found = np.full((len(approaches), len(network.phases)), OFF, np.uint8)
    for program in network.programs:
        first = int(program["first_phase"])
        rows = range(first, first + int(program["num_phases"]))
        for number, approach in enumerate(approaches):
            if approach.signal != program["signal"]:
                continue
            for row in rows:
                letters = int(network.phases["first_state"][row]) + np.array(approach.indices)
                found[number, row] = _joint_state(_STATE_OF_CODE[network.phase_states[letters]])
    return found


def _joint_state(states: NDArray[np.uint8]) -> int:
    """Return the state of a light that stands for several movements: the strictest of these."""
    return int(states.min())


def _times_s(network: RoadNetwork, approaches: tuple[LightApproach, ...]) -> NDArray[np.float32]:
    found = np.zeros((len(approaches), 3), np.float32)
    states = _states(network, approaches)
    for number, approach in enumerate(approaches):
        program = network.programs[network.signals["program"][approach.signal]]
        first = int(program["first_phase"])
        rows = slice(first, first + int(program["num_phases"]))
        durations = network.phases["duration_s"][rows]
        for column, state in enumerate((GREEN, YELLOW, RED)):
            found[number, column] = durations[states[number, rows] == state].sum()
    return found
