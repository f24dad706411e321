"""An oncoming car attempts a U-turn, fails and blocks the agent's lane.

The car reverses, turns further and drives off in front of the agent: a three-point turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import acos, sine
from cavmarl.traffic.scenarios.motions import ACCEL_MPS2, Act, Await, Move, Wait, arc
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.scene import Scene, Seat, setting
from cavmarl.traffic.scenarios.streets import Opposite, Streets

NEEDS = "a straight road of 85 m or more with an adjacent lane in the opposite direction"

ROAD_M = 85.0
BEHIND_M = 30.0  # length of road beyond the start of the turn
RADIUS_M = 5.0  # radius of the turning circle


@dataclass(frozen=True)
class Parameters:
    """Parameters of the turn."""

    speed_mps: float = setting(8.0, 3.0, 12.0, "m/s", "speed of the agent when it starts")
    turn_mps: float = setting(3.0, 1.0, 4.0, "m/s", "speed of the turning car")
    pause_s: float = setting(3.0, 1.0, 20.0, "s", "pause between two parts of the turn")
    lead_s: float = setting(
        0.5, 0.0, 2.0, "s", "time from blocking the lane to an agent's arrival at constant speed"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, int]:
    """Return straight lanes beside an oncoming lane."""
    found = {}
    for lane in streets.straights(ROAD_M):
        other = streets.opposite(lane, streets.length_m(lane) - BEHIND_M)
        if other is not None and other.apart_m < 2.0 * RADIUS_M:
            found[streets.name(lane)] = lane
    return found


def stage(streets: Streets, place: int, parameters: Parameters) -> Scene:
    """Stage the car so that it blocks the lane just ahead of an agent that keeps its speed."""
    begin_s = streets.length_m(place) - BEHIND_M
    other = streets.opposite(place, begin_s)
    assert other is not None, "a place that `places` has not found"
    forward, back, away = _parts(streets, other)
    speed = parameters.turn_mps
    to_across_s = RADIUS_M * _first_turn(other) / speed + speed / ACCEL_MPS2
    radius_m = parameters.speed_mps * (to_across_s + parameters.lead_s)
    acts: list[Act] = [
        Move(forward[:1], other.lane),
        Await(0),
        Move(forward, place, speed),
        Wait(parameters.pause_s),
        Move(back, place, speed, backwards=True),
        Wait(parameters.pause_s),
        Move(away, place, speed),
        Wait(0.5),
    ]
    across_s = begin_s - RADIUS_M * sine(_first_turn(other))
    x, y, _ = streets.point(place, across_s).tolist()
    edge = streets.edge(place)
    seat = Seat(place, max(across_s - radius_m - 20.0, 5.0), parameters.speed_mps, edge)
    car = Actor("car", acts, edge)
    return Scene(streets.name(place), x, y, seat, [car], [Cue(x, y, radius_m)])


def _first_turn(other: Opposite) -> float:
    """Return the change of heading in the first part of the turn, in rad.

    Three arcs of one radius r through α, π - 2 α and α move a car sideways by 2 r (1 - 2 cos α),
    which has to be the distance between the lanes.
    """
    return acos(0.25 * (2.0 - other.apart_m / RADIUS_M))


def _parts(streets: Streets, other: Opposite) -> list[NDArray[np.float64]]:
    first, side = _first_turn(other), streets.inwards
    forward = arc(streets.point(other.lane, other.s), RADIUS_M, side * first)
    back = arc(forward[-1], RADIUS_M, side * (math.pi - 2.0 * first), backwards=True)
    return [forward, back, arc(back[-1], RADIUS_M, side * first)]
