"""Scripts of pedestrians and vehicles, compiled for kernels into one FRAME per tick.

An actor performs its acts one after the other: it moves freely, rides along lanes, waits for a
time, or waits for a cue. For built-in drivers, the actor's body occupies every lane that it covers.
While the actor moves freely, it also occupies lanes that it will cover within `FORESIGHT_S`, so
that drivers brake for actors about to step onto their lane.

`Shadows` finds the lanes that a body covers, and the covered stretch of each lane.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import cos_sin, cosine, hypot, sine
from cavmarl.core.records import record
from cavmarl.core.records.arrays import Scripts
from cavmarl.core.records.codes import CLASS_PEDESTRIAN, MODEL_IDM
from cavmarl.driving.vehicle_types import CLASS_DEFAULTS, generated_types, set_model
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.routing import lane_grid
from cavmarl.traffic.kernels.covered_stretch import covered_stretch
from cavmarl.traffic.scenarios.motions import Act, Pose

SAMPLE_M = 0.5  # spacing of the sample points of a body
LEVEL_M = 4.0  # lanes with a larger difference in height are on different levels
BESIDE_M = 1.0  # bodies farther than this beside a lane never cover it, even with rounding
FARTHEST_M = 200.0  # maximum distance from an actor to a lane
ON_ROAD = (1 << len(VEHICLE_CLASSES)) - 1


class Shadow(NamedTuple):
    """A stretch of a lane that a body covers."""

    start: float  # m along the lane
    end: float  # m along the lane
    speed: float  # speed of the body along the lane in m/s, at least 0

    def joined(self, other: Shadow) -> Shadow:
        """Return the smallest stretch that contains both stretches, with speed 0."""
        return Shadow(min(self.start, other.start), max(self.end, other.end), 0.0)


class Shadows:
    """Finds the lanes below bodies."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._grid = lane_grid(network)
        self._found: dict[bytes, Mapping[int, Shadow]] = {}

    def of(self, pose: Pose, length: float, width: float) -> Mapping[int, Shadow]:
        """Return the stretch of each LANE row that a body of this size covers at its pose."""
        place = (pose.x, pose.y, pose.heading, pose.speed, pose.beside)
        key = struct.pack("7d", *place, length, width)  # distinguishes the signs of zeros
        found = self._found.get(key)
        if found is None:  # cached, because bodies keep a pose for many ticks
            found = self._found[key] = self._covered(pose, length, width)
        return found

    def _covered(self, pose: Pose, length: float, width: float) -> dict[int, Shadow]:
        points = _outline(pose, length, width)
        found = {}
        for lane in self._near(points):
            row = self._network.lanes[lane]
            if not self._is_level(lane, pose.beside):
                continue
            start, end = covered_stretch(self._network.points, row, points)
            if start <= end:
                _, _, _, cos, sin, _ = self._network.pose_on(lane, 0.5 * (start + end))
                along = cosine(pose.heading) * cos + sine(pose.heading) * sin
                found[lane] = Shadow(start, end, max(pose.speed * along, 0.0))
        return found

    def nearest(self, pose: Pose) -> tuple[int, float, float]:
        """Return the lane nearest to a place, and s and d of the place on it."""
        best, best_off = (pose.beside, 0.0, 0.0), math.inf
        for lane in self._around(pose.x, pose.y):
            if not self._is_level(lane, pose.beside):
                continue
            s, d, _, _ = self._network.beside(lane, pose.x, pose.y)
            length = float(self._network.lanes["length_m"][lane])
            on = min(max(s, 0.0), length)
            off = hypot(abs(s - on), d)
            if off < best_off:
                best, best_off = (lane, on, d), off
        return best

    def height_m(self, lane: int, s: float) -> float:
        return self._network.pose_on(lane, s)[2]

    def distance_m(self, lane: int, s: float, pose: Pose) -> float:
        """Return the horizontal distance in m from a place on a lane to an actor."""
        x, y, *_ = self._network.pose_on(lane, s)
        return hypot(x - pose.x, y - pose.y)

    def _is_level(self, lane: int, other: int) -> bool:
        """Return whether two neighbouring lanes can belong to the same road."""
        z = self._network.points["z"][self._network.lanes["first_point"][[lane, other]]]
        return bool(abs(z[0] - z[1]) < LEVEL_M)

    def _near(self, points: NDArray[np.float64]) -> list[int]:
        """Return lanes, ascending, that may reach below some of the points."""
        grid = self._grid
        columns, lines = ((points - (grid.min_x, grid.min_y)) // grid.cell_m).astype(np.int64).T
        columns, lines = columns.clip(0, grid.num_x - 1), lines.clip(0, grid.num_y - 1)
        cells = set((lines * grid.num_x + columns).tolist())
        near = np.array(sorted({lane for cell in cells for lane in self._members(cell)}), np.int64)
        rows = self._network.lanes[near]
        reach = 0.5 * rows["width_m"] + BESIDE_M
        (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
        is_across = (rows["min_x"] - reach <= right) & (left <= rows["max_x"] + reach)
        is_along = (rows["min_y"] - reach <= high) & (low <= rows["max_y"] + reach)
        found: list[int] = near[is_across & is_along].tolist()
        return found

    def _around(self, x: float, y: float) -> list[int]:
        """Return the lanes, ascending, of the nearest cells that contain lanes."""
        step = self._grid.cell_m
        for ring in range(1, int(FARTHEST_M / step) + 1):
            offsets = np.arange(-ring, ring + 1) * step
            cells = {self._cell(x + dx, y + dy) for dx in offsets for dy in offsets}
            if found := sorted({lane for cell in cells for lane in self._members(cell)}):
                return found
        return list(range(len(self._network.lanes)))

    def _cell(self, x: float, y: float) -> int:
        grid = self._grid
        column = min(max(int((x - grid.min_x) // grid.cell_m), 0), grid.num_x - 1)
        line = min(max(int((y - grid.min_y) // grid.cell_m), 0), grid.num_y - 1)
        return line * grid.num_x + column

    def _members(self, cell: int) -> list[int]:
        start = self._grid.cell_start
        lanes: list[int] = self._grid.cell_lanes[start[cell] : start[cell + 1]].tolist()
        return [lane for lane in lanes if self._network.lanes["permissions"][lane] & ON_ROAD]


def _outline(pose: Pose, length: float, width: float) -> NDArray[np.float64]:
    """Return (n, 2) sample points of a body, including its corners."""
    along = np.linspace(-0.5, 0.5, max(2, round(length / SAMPLE_M) + 1)) * length
    across = np.linspace(-0.5, 0.5, max(2, round(width / SAMPLE_M) + 1)) * width
    u, v = (grid.ravel() for grid in np.meshgrid(along, across))
    cos, sin = cos_sin(pose.heading)
    return np.stack([pose.x + u * cos - v * sin, pose.y + u * sin + v * cos], axis=1)


FORESIGHT_S = 2.0  # drivers brake for actors that will be on their lane within this time

FRAME = record(
    ("x", np.float64),  # as in VEHICLE
    ("y", np.float64),
    ("z", np.float64),
    ("heading", np.float64),
    ("pitch", np.float64),
    ("speed", np.float64),
    ("s", np.float64),  # position on `lane`, the nearest lane
    ("d", np.float64),
    ("lane", np.int32),
    ("link", np.int32),
    ("following", np.int32),  # FRAME of the next tick; the last frame points to itself
    ("cue", np.int32),  # CUE that the actor waits for; -1: it continues at once
    ("released_to", np.int32),  # goal to which a built-in driver drives the actor from here, or -1
    ("first_cover", np.int32),  # COVER rows
    ("num_covers", np.int32),
    ("first_claim", np.int32),  # CLAIM rows
    ("num_claims", np.int32),
)

COVER = record(
    ("s", np.float64),  # middle of the covered part of the lane, m
    ("half", np.float64),  # half the length of that part, m
    ("speed", np.float64),  # m/s along the lane, at least 0
    ("lane", np.int32),
)

CLAIM = record(
    ("dist", np.float64),  # from the centre to the stop line, m; negative beyond the line
    ("link", np.int32),
)

CUE = record(
    ("x", np.float64),  # the cue is given if an agent's centre is within `radius_m` of this place
    ("y", np.float64),
    ("radius_m", np.float64),
    ("tick", np.int64),  # or at this tick; -1: no tick
)

NO_SCRIPTS = Scripts(
    np.zeros(0, FRAME), np.zeros(0, COVER), np.zeros(0, CLAIM), np.zeros(0, CUE), 0, 0.0
)


class Body(NamedTuple):
    """Class and size of an actor; in metres."""

    vclass: int
    length: float
    width: float
    height: float


_CAR = generated_types()[0]
BODIES: Mapping[str, Body] = {
    "pedestrian": Body(CLASS_PEDESTRIAN, 0.5, 0.5, 1.75),
    "car": Body(*(_CAR[name].item() for name in Body._fields)),
    "van": Body(VEHICLE_CLASSES.index("delivery"), *CLASS_DEFAULTS["delivery"][:3]),
}


class Cue(NamedTuple):
    """A cue for actors: an agent within `radius_m` of (x, y), or the time `at_s`."""

    x: float = 0.0
    y: float = 0.0
    radius_m: float = 0.0
    at_s: float | None = None


@dataclass(frozen=True)
class Actor:
    """A road user that follows a script."""

    body: str  # a name of `BODIES`
    acts: Sequence[Act]  # performed in order; each begins where the previous one ends
    # EDGE to which a built-in driver drives the actor at the end; None: the actor stays
    released_to: int | None = None


def actor_types() -> NDArray[np.void]:
    """Return the VTYPE rows of `BODIES`, with the driver of the generator's car."""
    types = generated_types().repeat(len(BODIES))
    for row, body in zip(types, BODIES.values(), strict=True):
        for name, value in body._asdict().items():
            row[name] = value
    set_model(types, MODEL_IDM)
    return types


def bodies_of(actors: Sequence[Actor]) -> list[int]:
    names = list(BODIES)
    return [names.index(actor.body) for actor in actors]


@dataclass
class _Tables:
    """Growing tables of rows."""

    frames: list[tuple[object, ...]] = field(default_factory=list)
    covers: list[tuple[float, float, float, int]] = field(default_factory=list)
    claims: list[tuple[float, int]] = field(default_factory=list)
    room: int = 0
    reach_m: float = 0.0


def compile_scripts(
    network: RoadNetwork,
    actors: Sequence[Actor],
    cues: Sequence[Cue],
    goals: Mapping[int, int],
    dt: float,
) -> tuple[Scripts, list[int]]:
    """Return the compiled scripts of all actors, and the first FRAME of each.

    `actors`: actors with a script. `cues`: indexed by the numbers in `Await`. `goals`: row of the
    table of plans by EDGE, for released actors.
    """
    tables = _Tables()
    shadows = Shadows(network)
    firsts = []
    for actor in actors:
        firsts.append(len(tables.frames))
        goal = -1 if actor.released_to is None else goals[actor.released_to]
        _write(tables, shadows, BODIES[actor.body], list(_poses(network, actor, dt)), goal, dt)
    ticks = [-1 if cue.at_s is None else round(cue.at_s / dt) for cue in cues]
    cue_rows = [(*cue[:3], tick) for cue, tick in zip(cues, ticks, strict=True)]
    scripts = Scripts(
        np.array(tables.frames, FRAME),
        np.array(tables.covers, COVER),
        np.array(tables.claims, CLAIM),
        np.array(cue_rows, CUE),
        tables.room,
        tables.reach_m,
    )
    return scripts, firsts


def _poses(network: RoadNetwork, actor: Actor, dt: float) -> Iterator[Pose]:
    last: Pose | None = None
    for act in actor.acts:
        for pose in act.poses(network, BODIES[actor.body].length, last, dt):
            last = pose
            yield pose


def _write(
    tables: _Tables, shadows: Shadows, body: Body, poses: list[Pose], goal: int, dt: float
) -> None:
    own = [shadows.of(pose, body.length, body.width) for pose in poses]
    ahead = round(FORESIGHT_S / dt)
    most = 0
    for k, pose in enumerate(poses):
        lane, s, d = pose.on if pose.on is not None else shadows.nearest(pose)
        seen = own[k]
        if pose.on is None:
            seen = _foreseen(own, poses, k, ahead)
        first = len(tables.covers)
        for number, shadow in sorted(seen.items()):
            speed = own[k][number].speed if number in own[k] else 0.0
            half = 0.5 * (shadow.end - shadow.start)
            tables.covers.append((shadow.start + half, half, speed, number))
            off_m = shadows.distance_m(number, shadow.start + half, pose) + half
            tables.reach_m = max(tables.reach_m, off_m)
        first_claim = len(tables.claims)
        tables.claims += pose.claims
        is_last = k == len(poses) - 1
        number = len(tables.frames)
        tables.frames.append(
            (
                pose.x, pose.y, shadows.height_m(lane, s), pose.heading, pose.pitch, pose.speed,
                s, d, lane, pose.link, number if is_last else number + 1, pose.cue,
                goal if is_last else -1, first, len(seen), first_claim, len(pose.claims),
            )
        )  # fmt: skip
        most = max(most, len(seen))
    tables.room += most


def _foreseen(
    own: list[Mapping[int, Shadow]], poses: list[Pose], k: int, ahead: int
) -> dict[int, Shadow]:
    """Return the stretches that an actor covers now or soon, up to its next wait for a cue."""
    seen = dict(own[k])
    for later in range(k, min(k + ahead, len(own) - 1)):
        if poses[later].cue >= 0:
            break
        for lane, shadow in own[later + 1].items():
            seen[lane] = shadow.joined(seen[lane]) if lane in seen else shadow
    return seen
