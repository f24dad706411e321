"""Finds turns of a map that are too tight for a car's turning circle; trips avoid these turns.

Cars cannot reverse. Where a path turns back on itself within a few metres, as at dead ends and
hairpins, a car would have to leave the road.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import RoadArrays
from cavmarl.driving.kernels.motion.trial_drive import (
    BEYOND_M,
    FASTER_MPS,
    TRIAL_MPS,
    stays_on_road,
)
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.kernels.plans import TURNAROUND
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import PLAN, lane_grid

TURN_RAD = 0.9  # rad; paths that turn less within `NEAR_M` suit every car
NEAR_M = 12.0


class TurningBody(NamedTuple):
    """The dimensions of a vehicle that limit its turns; names and units as in `VTYPE`."""

    length: float
    width: float
    wheelbase: float
    most_steering: float


CAR_BODY = TurningBody(5.0, 2.0, 5.0, np.inf)


@lru_cache(maxsize=1)
def with_tight_turns(
    network: RoadNetwork, steering_rad: float, bodies: tuple[TurningBody, ...] = (CAR_BODY,)
) -> RoadArrays:
    """Mark as U-turns all turns that are too tight for one of the `bodies`, so plans avoid them.

    `steering_rad`: maximum angle of the front wheels. If a lane itself turns too tightly, all links
    to and from it are marked.
    """
    trials = [_Trial(network, steering_rad, body) for body in bodies]
    for_cars = network.lanes["permissions"] & CARS != 0
    links = network.arrays.links.copy()
    normal = np.flatnonzero(for_cars & ~network.lanes["internal"])
    tight = [lane for lane in normal.tolist() if any(trial.is_tight_lane(lane) for trial in trials)]
    at_tight = np.isin(links["to_lane"], tight) | np.isin(links["from_lane"], tight)
    usable = for_cars[links["from_lane"]] & for_cars[links["to_lane"]]
    for link in np.flatnonzero(usable & (links["first_internal"] >= 0)).tolist():
        if at_tight[link] or any(trial.is_tight_link(link) for trial in trials):
            links["direction"][link] = TURNAROUND
    return network.arrays._replace(links=links)


class _Trial:
    """A test drive of one kind of vehicle over single turns."""

    def __init__(self, network: RoadNetwork, steering_rad: float, body: TurningBody) -> None:
        self._body = body
        self._network = network
        self._steering_rad = min(steering_rad, body.most_steering)
        self._grid = lane_grid(network)
        self._plan = np.zeros((1, len(network.lanes)), dtype=PLAN)
        self._plan["next"] = network.lanes["successor"]

    def is_tight_lane(self, lane: int) -> bool:
        row = self._network.lanes[lane]
        points = self._network.lane_points(lane)
        length_m = float(row["length_m"])
        if _most_turn(points["s"], points["heading"]) < TURN_RAD:
            return False
        return not self._drives(lane, 0.0, lane, length_m - 1.0)

    def is_tight_link(self, link: int) -> bool:
        network = self._network
        row = network.links[link]
        lanes = [int(row["from_lane"]), int(row["first_internal"])]
        while network.lanes["internal"][lanes[-1]]:
            lanes.append(int(network.lanes["successor"][lanes[-1]]))
        before_m, after_m = (float(network.lanes["length_m"][k]) for k in (lanes[0], lanes[-1]))
        begin_m, end_m = max(before_m - BEYOND_M, 0.0), min(BEYOND_M, after_m - 1.0)
        parts = [network.lane_points(lane) for lane in lanes]
        starts = np.cumsum([0.0, *(float(part["s"][-1]) for part in parts[:-1])])
        s = np.concatenate([part["s"] + at for part, at in zip(parts, starts, strict=True)])
        heading = np.concatenate([part["heading"] for part in parts])
        near = (s >= before_m - BEYOND_M) & (s <= starts[-1] + BEYOND_M)
        near[len(parts[0]) - 1] = True
        if _most_turn(s[near], heading[near]) < TURN_RAD:
            return False
        for lane, following in pairwise(lanes):
            self._plan["next"][0, lane] = following
        ends = lanes[0], begin_m, lanes[-1], end_m
        stays = self._drives(*ends)
        if stays:
            # In the drive above, the plan has link 0 in place of the turn's link. With the turn's
            # link, the car may cut the corner, so only its centre is checked here: the turn is too
            # tight only if the centre leaves the road at both speeds.
            self._plan["link"][0, lanes[0]] = link
            stays = any(self._drives(*ends, speed, False) for speed in (TRIAL_MPS, FASTER_MPS))
            self._plan["link"][0, lanes[0]] = 0
        self._plan["next"][0, lanes[0]] = -1
        return not stays

    def _drives(
        self,
        lane: int,
        begin_m: float,
        last_lane: int,
        end_m: float,
        speed: float = TRIAL_MPS,
        whole_body: bool = True,
    ) -> bool:
        inwards = -1 if self._network.left_hand else 1
        row = blank_vehicle()[0]
        row["length"], row["width"] = self._body.length, self._body.width
        return bool(
            stays_on_road(
                self._network.arrays,
                self._plan,
                self._grid,
                row,
                self._body.wheelbase,
                lane,
                begin_m,
                last_lane,
                max(end_m, 0.0),
                self._steering_rad,
                inwards if whole_body else 0,
                speed,
            )
        )


def _most_turn(s: NDArray[np.float64], heading: NDArray[np.float64]) -> float:
    """Return the largest sum of absolute turns of a polyline within `NEAR_M`, in rad."""
    turned = np.concatenate(
        [[0.0], np.cumsum(np.abs(np.remainder(np.diff(heading) + np.pi, 2.0 * np.pi) - np.pi))]
    )
    return float((turned[np.searchsorted(s, s + NEAR_M, side="right") - 1] - turned).max())
