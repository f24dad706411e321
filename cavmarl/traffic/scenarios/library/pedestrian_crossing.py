"""A pedestrian steps onto the road, away from crosswalks, just as the agent arrives.

If `occluded` is set, a van parked beside the road hides the pedestrian until the last moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cavmarl.traffic.scenarios.motions import ACCEL_MPS2, Await, Move
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.scene import Scene, Seat, setting, switch
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = "a straight road for cars of 85 m or more"

ROAD_M = 85.0
BEHIND_M = 25.0  # length of road beyond the pedestrian
KERB_M = 1.4  # distance of the pedestrian's start and end from the road
VAN_GAP_M = 0.3  # distance between road and van
VAN_M = (6.5, 2.16)
STEP_M = 1.0  # distance between van and pedestrian


@dataclass(frozen=True)
class Parameters:
    """Parameters of the crossing."""

    speed_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the agent when it starts")
    walk_mps: float = setting(1.4, 0.5, 3.0, "m/s", "speed of the pedestrian")
    lead_s: float = setting(
        0.0, -0.5, 2.0, "s", "time from the pedestrian's arrival to an agent's at constant speed"
    )
    occluded: bool = switch(False, "a parked van hides the pedestrian")


def places(streets: Streets, parameters: Parameters) -> dict[str, int]:
    """Return the lanes at the kerb of straight roads."""
    return {
        streets.name(lane): lane for lane in streets.straights(ROAD_M) if streets.is_at_kerb(lane)
    }


def stage(streets: Streets, place: int, parameters: Parameters) -> Scene:
    """Stage a pedestrian so that an agent at constant speed would collide with it."""
    lane, s = place, streets.length_m(place) - BEHIND_M
    near, far = streets.kerbs_m(lane, s)
    side = near + KERB_M
    walk = parameters.walk_mps
    to_lane_s = side / walk + 0.5 * walk / ACCEL_MPS2
    radius_m = parameters.speed_mps * (to_lane_s + parameters.lead_s)
    start, end = streets.inside(lane, s, -side), streets.inside(lane, s, far + KERB_M)
    heading = start[2] + 0.5 * np.pi * streets.inwards
    line = np.array([[*start[:2], heading], [*end[:2], heading]])
    actors = [Actor("pedestrian", [Move(line[:1], lane), Await(0), Move(line, lane, walk)])]
    if parameters.occluded:
        aside_m = near + VAN_GAP_M + 0.5 * VAN_M[1]
        van = streets.inside(lane, s - STEP_M - 0.5 * VAN_M[0], -aside_m)
        actors.append(Actor("van", [Move(van[None, :], lane)]))
    x, y, _ = streets.point(lane, s).tolist()
    seat = Seat(lane, max(s - radius_m - 20.0, 5.0), parameters.speed_mps, streets.edge(lane))
    return Scene(streets.name(lane), x, y, seat, actors, [Cue(x, y, radius_m)])
