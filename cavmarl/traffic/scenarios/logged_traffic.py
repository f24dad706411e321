"""The vehicles of a logged scene as agents, replayed vehicles and built-in drivers.

A replayed vehicle has the poses of the log, as if the caller of the environment had set them (see
`ExternalComponent`). A vehicle that reacts is a departure of a demand file, with the logged path as
its route.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.scenario import ScenarioConfig
from cavmarl.core.errors import ConfigError, ScenarioError
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.records.external_records import (
    EXTERNAL,
    EXTERNAL_POSED,
    EXTERNAL_REMOVED,
)
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.driving.vehicle_types import EXTERNAL_TYPES
from cavmarl.maps.scenes.logged_scene import LoggedScene, Track, boxes_meet, wrapped
from cavmarl.maps.scenes.scene_files import read_scene
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import make_plans
from cavmarl.traffic.scenarios.lane_matching import LaneMatcher, LanePlace
from cavmarl.traffic.scenarios.scene import (
    LoggedTraffic,
    ReactingVehicle,
    Scene,
    Seat,
    SeatBody,
    checked,
    setting,
    switch,
)

TRUCK_M = 7.0  # a longer vehicle is a truck
GOAL_STEPS = 10  # number of samples between two places that are tried as an agent's goal
_LARGEST = EXTERNAL_TYPES["bus"]


@dataclass(frozen=True)
class LoggedParameters:
    """Parameters of a logged scene."""

    start_s: float = setting(0.0, 0.0, 1e6, "s", "time in the log at which an episode begins")
    reactive: bool = switch(False, "built-in drivers drive the other vehicles along their routes")


def plan_logged_scene(config: ScenarioConfig, network: RoadNetwork, agents: int) -> Scene:
    """Return the scene of a scene file.

    Raises:
        MapError: the file cannot be read.
        ConfigError: a parameter or a seat is invalid.
        ScenarioError: too few vehicles of the scene can be driven by agents.
    """
    params = tuple(sorted(config.params.items()))
    return _planned(read_scene(config.name), network, config.name, params, config.seats, agents)


@lru_cache(maxsize=4)  # a world is planned several times
def _planned(
    scene: LoggedScene,
    network: RoadNetwork,
    name: str,
    params: tuple[tuple[str, bool | float], ...],
    wanted: tuple[str, ...],
    agents: int,
) -> Scene:
    parameters = checked(LoggedParameters, dict(params), name)
    first = round(parameters.start_s / scene.step_s)
    if first >= scene.num_times - 1:
        raise ConfigError(
            f"scenario.params.start_s = {parameters.start_s:g}: must be before the last sample at "
            f"{(scene.num_times - 1) * scene.step_s:g} s"
        )
    return _Casting(scene, network, first).scene(wanted, agents, parameters.reactive)


class _Casting:
    """Chooses for each track: an agent, a replayed vehicle, or a vehicle that reacts."""

    def __init__(self, scene: LoggedScene, network: RoadNetwork, first: int) -> None:
        self._log, self._network, self._first = scene, network, first
        self._matcher = LaneMatcher(network)
        self._clipped = 0

    def scene(self, wanted: Sequence[str], agents: int, reactive: bool) -> Scene:
        seated = self._seated(wanted, agents)
        others = [
            track
            for track in self._log.tracks
            if track.valid[self._first :].any() and track.name not in seated
        ]
        reacting: list[ReactingVehicle] = []
        if reactive:
            found = [self._reaction(track) for track in others if track.kind == "vehicle"]
            reacting = [one for one in found if one is not None]
            reacting.sort(key=lambda one: one.depart_s)
        driven = {one.track.name for one in reacting}
        replayed = [track for track in others if track.name not in driven]
        unable = sum(track.kind == "vehicle" for track in replayed) if reactive else 0
        self._clipped += sum(clipped_size(track) != track.size_m for track in others)
        told = (
            (self._clipped, "road users are larger than a bus: reduced to the size of a bus"),
            (unable, "vehicles replayed, because they do not drive along lanes that are connected"),
        )
        seats = list(seated.values())
        tracks = {track.name: track for track in self._log.tracks}
        traffic = LoggedTraffic(
            self._log,
            self._first,
            [tracks[name] for name in seated],
            replayed,
            reacting,
            tuple(f"{count} {what}" for count, what in told if count),
        )
        body = seats[0].body
        assert body is not None, "seats of a log have bodies"
        return Scene(self._log.name, body.x, body.y, seats[0], (), seats=seats, log=traffic)

    def _seated(self, wanted: Sequence[str], agents: int) -> dict[str, Seat]:
        """Return the agents' seats by track."""
        if wanted:
            if len(wanted) != agents:
                raise ConfigError(
                    f"scenario.seats names {len(wanted)} tracks, but population.agents = {agents}: "
                    "name one track per agent"
                )
            return {name: self._named_seat(name) for name in wanted}
        names = [self._log.own] if self._log.own else []
        names += [track.name for track in self._log.tracks if track.name != self._log.own]
        tracks = {track.name: track for track in self._log.tracks}
        found: dict[str, Seat] = {}
        for name in names:
            seat = self._seat(tracks[name]) if name in tracks else "is not in the scene"
            if isinstance(seat, Seat):
                found[name] = seat
            if len(found) == agents:
                return found
        raise ScenarioError(
            f"population.agents = {agents}: only {len(found)} vehicles of the scene "
            f"'{self._log.name}' are on a free place of a lane at "
            f"{self._first * self._log.step_s:g} s; set at most {len(found)}, or another "
            "scenario.params.start_s"
        )

    def _named_seat(self, name: str) -> Seat:
        track = next((track for track in self._log.tracks if track.name == name), None)
        seat = "is not a track of the scene" if track is None else self._seat(track)
        if isinstance(seat, Seat):
            return seat
        some = [
            track.name
            for track in self._log.tracks
            if track.name != name and isinstance(self._seat(track), Seat)
        ]
        raise ConfigError(
            f"scenario.seats: '{name[:80]}' {seat}; use another track, for example "
            f"{', '.join(some[:8]) or 'none is suitable'}, or change scenario.params.start_s"
        )

    def _seat(self, track: Track) -> Seat | str:
        """Return the seat in a track's vehicle, or the reason why an agent cannot drive it."""
        if track.kind != "vehicle":
            return f"is a {track.kind}, not a vehicle"
        if not track.valid[self._first]:
            return f"was not seen at {self._first * self._log.step_s:g} s"
        places = self._matcher.lanes(*track.poses[self._first].tolist())
        if not places:
            return "is not on a lane in its direction"
        if self._overlaps(track):
            return f"overlaps another road user at {self._first * self._log.step_s:g} s"
        # Where lanes diverge, choose the lane that leads farthest along the log.
        goals = [self._goal(track, place) for place in places]
        best = max(range(len(places)), key=lambda k: (goals[k][0], -k))
        return self._seat_at(track, places[best], self._first, goals[best][1])

    def _seat_at(self, track: Track, place: LanePlace, time: int, goal: int) -> Seat:
        x, y, heading = track.poses[time].tolist()
        body = SeatBody(x, y, heading, place.d, *clipped_size(track))
        speed = float(speeds_of(track, self._log.step_s)[time])
        return Seat(place.lane, place.s, max(speed, 0.0), goal, body)

    def _place(self, track: Track, time: int) -> LanePlace | None:
        return self._matcher.place(*track.poses[time].tolist())

    def _overlaps(self, track: Track) -> bool:
        """Return whether a vehicle overlaps another road user at the reset."""
        present = [one for one in self._log.tracks if one.valid[self._first]]
        poses = np.array([one.poses[self._first] for one in present])
        half = 0.5 * np.array([clipped_size(one)[:2] for one in present])
        number = next(k for k, one in enumerate(present) if one.name == track.name)
        return bool(boxes_meet(poses, half)[number].any())

    def _goal(self, track: Track, start: LanePlace) -> tuple[int, int]:
        """Return the latest tried sample whose edge is reachable from the start, and that edge.

        If there is none, return the first sample and the edge of the start.
        """
        times = track.times[track.times >= self._first][::-1]
        tried: set[int] = set()
        for time in times[::GOAL_STEPS].tolist():
            place = self._place(track, time)
            if place is None:
                continue
            edge = self._matcher.edge(place.lane, is_start=False)
            if edge in tried:
                continue
            tried.add(edge)
            plan = make_plans(self._network, [edge])[0]
            if np.isfinite(plan["to_go"][start.lane]) and plan["to_go"][start.lane] > start.s:
                return time, edge
        return self._first, self._matcher.edge(start.lane, is_start=False)

    def _reaction(self, track: Track) -> ReactingVehicle | None:
        """Return the route of a vehicle that reacts; None if it has to be replayed."""
        times = track.times[track.times >= self._first]
        first = int(times[0])
        start = self._place(track, first)
        if start is None:
            return None
        is_inside = bool(self._network.lanes["internal"][start.lane])
        if is_inside and first > self._first:
            return None
        edges = [self._matcher.edge(start.lane, is_start=True)]
        lane = start.lane
        for time in times.tolist():
            place = self._place(track, time)
            if place is None or self._network.lanes["internal"][place.lane]:
                continue
            if self._matcher.edge(place.lane, is_start=False) == edges[-1]:
                lane = place.lane
                continue
            way = self._matcher.way(lane, place.lane)
            if way is None:
                return None
            edges += way[1:] if way[0] == edges[-1] else way
            lane = place.lane
        if is_inside and len(edges) == 1:
            edges.append(self._matcher.edge(start.lane, is_start=False))
        if any(one == other for one, other in pairwise(edges)):
            return None
        seat = self._seat_at(track, start, first, edges[-1])
        return ReactingVehicle(track, seat, tuple(edges), (first - self._first) * self._log.step_s)


def clipped_size(track: Track) -> tuple[float, float, float]:
    """Return length, width and height, limited to the size of a bus."""
    length, width, height = track.size_m
    return (
        min(length, _LARGEST.length),
        min(width, _LARGEST.width),
        min(height, _LARGEST.height),
    )


def speeds_of(track: Track, step_s: float) -> NDArray[np.float64]:
    """Return the speeds (T,) along the heading in m/s.

    A speed is the mean since the previous sample; if that is missing, the mean until the next
    sample; if both are missing, 0.
    """
    moves = np.diff(track.poses[:, :2], axis=0)
    heading = track.poses[:, 2].tolist()
    speeds = np.zeros(len(track.valid))
    for time in track.times.tolist():
        move = 0.0
        cos, sin = cos_sin(heading[time])
        if time > 0 and track.valid[time - 1]:
            move = moves[time - 1, 0] * cos + moves[time - 1, 1] * sin
        elif time + 1 < len(track.valid) and track.valid[time + 1]:
            move = moves[time, 0] * cos + moves[time, 1] * sin
        speeds[time] = move / step_s
    return np.clip(speeds, -MAX_SPEED_MPS, MAX_SPEED_MPS)


def type_of(track: Track) -> str:
    """Return the type of a road user's vehicle."""
    if track.kind == "vehicle":
        return "truck" if track.size_m[0] > TRUCK_M else "car"
    return track.kind


def logged_commands(
    traffic: LoggedTraffic | None, type_rows: Mapping[str, int], step_s: float
) -> NDArray[np.void]:
    """Return EXTERNAL (K + 2, L): the commands of K steps for L replayed road users.

    Row 0 is the state at the reset, and row k the command of step k - 1. The last row removes all
    users. Poses at the ends of steps are interpolated between samples of the log.

    `step_s`: duration of a step.
    """
    if traffic is None:
        return np.zeros((1, 0), dtype=EXTERNAL)
    log = traffic.scene
    rest_s = (log.num_times - 1 - traffic.first) * log.step_s
    steps = int(rest_s / step_s + 1e-6)
    at = traffic.first + np.arange(steps + 1) * (step_s / log.step_s)
    before = np.minimum((at + 1e-6).astype(np.int64), log.num_times - 1)
    after = np.minimum(before + 1, log.num_times - 1)
    share = np.where(at - before < 1e-6, 0.0, at - before)
    table = np.zeros((steps + 2, len(traffic.replayed)), dtype=EXTERNAL)
    table["kind"] = EXTERNAL_REMOVED
    for slot, track in enumerate(traffic.replayed):
        seen = track.valid[before] & ((share == 0.0) | track.valid[after])
        start, end = track.poses[before], track.poses[after]
        move = (end - start) * share[:, None]
        move[:, 2] = wrapped(end[:, 2] - start[:, 2]) * share
        poses = start + move
        column = table[:-1, slot]
        column["kind"][seen] = EXTERNAL_POSED
        column["x"], column["y"], column["heading"] = poses.T
        speeds = speeds_of(track, log.step_s)
        column["speed"] = np.where(share == 0.0, speeds[before], speeds[after])
        column["z"] = column["pitch"] = np.nan
        column["vtype"] = type_rows[type_of(track)]
        for name, size in zip(("length", "width", "height"), clipped_size(track), strict=True):
            column[name] = size
    return table
