"""The actions of a scripted actor, and the pose of the actor in each tick."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import atan, atan2, cosine, sine
from cavmarl.core.math.elementary_arrays import cos_all, hypot_all, sin_all
from cavmarl.driving.kernels.junctions.approach import MAX_LINKS_AHEAD
from cavmarl.driving.kernels.junctions.stop_line_registration import registration_distance_m
from cavmarl.roads.network import RoadNetwork

ACCEL_MPS2 = 2.5  # acceleration and braking of actors
CREEP_MPS = 0.2  # minimum speed in the last centimetres before standstill


class Pose(NamedTuple):
    """The state of an actor in one tick."""

    x: float  # m, centre of the body
    y: float
    heading: float
    speed: float  # m/s along the heading, negative backwards
    beside: int  # LANE row whose height the actor has
    pitch: float = 0.0
    # lane, s and d of an actor that rides along lanes; None: it moves freely
    on: tuple[int, float, float] | None = None
    link: int = -1  # LINK row that the actor is on or entered last
    # (distance to the stop line, LINK row) of each link that it is on or will be on soon
    claims: tuple[tuple[float, int], ...] = ()
    cue: int = -1  # number of the cue for which the actor waits, or -1


@dataclass(frozen=True)
class Wait:
    """Stay in place for some seconds."""

    seconds: float

    def poses(
        self, network: RoadNetwork, length: float, last: Pose | None, dt: float
    ) -> Iterator[Pose]:
        assert last is not None, "a script begins with a place"
        for _ in range(round(self.seconds / dt)):
            yield last._replace(speed=0.0, cue=-1)


@dataclass(frozen=True)
class Await:
    """Wait for a cue of the scene, given by its number."""

    cue: int

    def poses(
        self, network: RoadNetwork, length: float, last: Pose | None, dt: float
    ) -> Iterator[Pose]:
        assert last is not None, "a script begins with a place"
        yield last._replace(cue=self.cue)


@dataclass(frozen=True)
class Move:
    """Move freely along a line, from standstill to standstill."""

    # (n, 3) x, y and heading, dense enough for linear interpolation; with a single row, the actor
    # stays there
    line: NDArray[np.float64]
    beside: int  # LANE row of the road on which, or beside which, the line is
    speed_mps: float = 0.0  # speed between the ends
    backwards: bool = False  # whether a vehicle reverses

    def poses(
        self, network: RoadNetwork, length: float, last: Pose | None, dt: float
    ) -> Iterator[Pose]:
        """Yield the pose of each tick.

        `length`: length of the body, m. `last`: the previous pose; None at the start of the script,
        when the first pose is yielded as well.
        """
        line = self.line
        if last is None:
            x, y, heading = line[0].tolist()
            yield Pose(x, y, heading, 0.0, self.beside)
        if len(line) == 1:
            return
        steps = hypot_all(*np.diff(line[:, :2], axis=0).T)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        headings = np.unwrap(line[:, 2])
        for u, speed in _course(float(along[-1]), 0.0, self.speed_mps, 0.0, dt):
            x, y, heading = (
                float(np.interp(u, along, column)) for column in (line[:, 0], line[:, 1], headings)
            )
            turned = math.remainder(heading, 2.0 * math.pi)
            yield Pose(x, y, turned, -speed if self.backwards else speed, self.beside)


@dataclass(frozen=True)
class Ride:
    """Ride along the centre of lanes like a built-in driver, but without reacting to others."""

    lanes: tuple[int, ...]  # consecutive LANE rows, including those inside junctions
    start_m: float  # first position of the centre, from the start of the first lane
    end_m: float  # last position of the centre, from the start of the first lane
    speed_mps: float  # speed between the ends
    start_mps: float = 0.0  # speed at the beginning
    end_mps: float = 0.0  # speed at the end

    def poses(
        self, network: RoadNetwork, length: float, last: Pose | None, dt: float
    ) -> Iterator[Pose]:
        if last is None:
            yield self._pose(network, length, self.start_m, self.start_mps)
        far = self.end_m - self.start_m
        for u, speed in _course(far, self.start_mps, self.speed_mps, self.end_mps, dt):
            yield self._pose(network, length, self.start_m + u, speed)

    def _pose(self, network: RoadNetwork, length: float, u: float, speed: float) -> Pose:
        front, rear = (self._point(network, u + side * 0.5 * length) for side in (1.0, -1.0))
        lane, s = self._place(network, u)
        _, _, _, _, _, slope = network.pose_on(lane, s)
        return Pose(
            0.5 * (front[0] + rear[0]),
            0.5 * (front[1] + rear[1]),
            atan2(front[1] - rear[1], front[0] - rear[0]),
            speed,
            lane,
            atan(slope),
            (lane, s, 0.0),
            self._entered(network, lane),
            tuple(self._claims(network, u, speed, length)),
        )

    def _place(self, network: RoadNetwork, u: float) -> tuple[int, float]:
        """Return lane and s of a place on the path; beyond the path, s is outside the end lane."""
        for lane in self.lanes[:-1]:
            here = float(network.lanes["length_m"][lane])
            if u < here:
                return lane, u
            u -= here
        return self.lanes[-1], u

    def _point(self, network: RoadNetwork, u: float) -> tuple[float, float]:
        x, y, *_ = network.pose_on(*self._place(network, u))
        return x, y

    def _entered(self, network: RoadNetwork, lane: int) -> int:
        """Return the last link that the actor entered before a lane."""
        at = self.lanes.index(lane)
        for before, after in reversed(list(pairwise(self.lanes[: at + 1]))):
            if (link := _link_between(network, before, after)) >= 0:
                return link
        return -1

    def _claims(
        self, network: RoadNetwork, u: float, speed: float, length: float
    ) -> Iterator[tuple[float, int]]:
        """Yield the links that the actor is on or will be on soon, as in `junctions.approach`."""
        reach = registration_distance_m(speed)
        line_m, ahead = 0.0, 0
        for before, after in pairwise(self.lanes):
            line_m += float(network.lanes["length_m"][before])
            link = _link_between(network, before, after)
            if link < 0:
                continue
            dist = line_m - u
            row = network.links[link]
            behind = float(max(row["length_m"], row["fork_m"], row["swept_m"])) + 0.5 * length
            if dist > reach or ahead == MAX_LINKS_AHEAD:
                return
            if dist > -behind:
                ahead += dist > 0.0
                yield dist, link


Act = Move | Ride | Wait | Await
"""One action of an actor."""


def path_of(network: RoadNetwork, link: int) -> tuple[int, ...]:
    """Return the lanes of a link, from the lane before the junction to the lane after it."""
    row = network.links[link]
    lanes = [int(row["from_lane"]), int(row["next_lane"])]
    while network.lanes["internal"][lanes[-1]]:
        lanes.append(int(network.lanes["successor"][lanes[-1]]))
    return tuple(lanes)


def arc(
    start: Sequence[float] | NDArray[np.float64],
    radius_m: float,
    turn_rad: float,
    *,
    backwards: bool = False,
) -> NDArray[np.float64]:
    """Return (n, 3) x, y and heading of the centre of a vehicle on a circular arc.

    Args:
        start: x, y and heading at the start of the arc.
        radius_m: radius of the arc.
        turn_rad: change of the heading, positive to the left.
        backwards: whether the vehicle reverses.
    """
    x, y, heading = start
    # Forwards, the centre of the circle is on the side to which the heading turns.
    side = math.copysign(1.0, turn_rad) * (-1.0 if backwards else 1.0)
    headings = heading + np.linspace(0.0, turn_rad, max(2, int(abs(turn_rad) / 0.05) + 1))
    middle_x, middle_y = (
        x - side * radius_m * sine(heading),
        y + side * radius_m * cosine(heading),
    )
    return np.stack(
        [
            middle_x + side * radius_m * sin_all(headings),
            middle_y - side * radius_m * cos_all(headings),
            headings,
        ],
        axis=1,
    )


def _course(
    far: float, start: float, speed: float, end: float, dt: float
) -> Iterator[tuple[float, float]]:
    """Yield the distance in m and the speed in m/s after each tick, over `far` m."""
    u, present = 0.0, start
    while u < far:
        braking = math.sqrt(end * end + 2.0 * ACCEL_MPS2 * (far - u))
        present = min(present + ACCEL_MPS2 * dt, speed, braking)
        present = max(present, min(CREEP_MPS, speed))
        u += present * dt
        if u >= far:
            u, present = far, end
        yield u, present


def _link_between(network: RoadNetwork, before: int, after: int) -> int:
    """Return the LINK from a lane outside junctions to the lane after it, or -1."""
    row = network.lanes[before]
    for link in range(row["first_link"], row["first_link"] + row["num_links"]):
        if network.links["next_lane"][link] == after:
            return int(link)
    return -1
