"""The road behind the next junction is closed: a van blocks each of its lanes.

The agent stops before the vans until the road is opened, or reaches its goal on another route.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from cavmarl.core.math.elementary import hypot
from cavmarl.traffic.scenarios.motions import Act, Await, Move, Ride, Wait
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.scene import FREE_M, Scene, approach, setting
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = (
    "a straight movement into a road of 80 m or more that leads on to another road, with 45 m of "
    "road before the junction"
)

FAR_M = 40.0  # initial distance from the agent to the junction
INTO_M = 50.0  # distance from the start of the closed road to the vans
ROAD_M = INTO_M + FREE_M + 10.0
NEAR_M = 35.0  # distance from the agent to the vans at which the time until they leave starts
MARGIN_M = 30.0  # margin around the scene that has no other vehicles at the start


@dataclass(frozen=True)
class Parameters:
    """Parameters of the closure."""

    speed_mps: float = setting(8.0, 3.0, 12.0, "m/s", "speed of the agent when it starts")
    closed_s: float = setting(
        10.0, 8.0, 90.0, "s", "time for which the road stays closed once the agent is near"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, int]:
    """Return straight movements into a long road that leads on to another road."""
    found: dict[str, int] = {}
    for link in streets.movements("s"):
        row = streets.network.links[link]
        lane, closed = int(row["from_lane"]), int(row["to_lane"])
        goal = streets.onward(closed)
        seat = approach(streets, link, FAR_M, parameters.speed_mps)
        if seat is None or goal is None or streets.edge(goal) == streets.edge(lane):
            continue
        if min(map(streets.length_m, streets.lanes_beside(closed))) >= ROAD_M:
            found.setdefault(streets.name(lane), link)
    return found


def stage(streets: Streets, place: int, parameters: Parameters) -> Scene:
    """Stage vans that block the road from the start, and leave after the agent has come near."""
    seat = approach(streets, place, FAR_M, parameters.speed_mps)
    closed = int(streets.network.links["to_lane"][place])
    goal = streets.onward(closed)
    assert seat is not None, "a place that `places` has not found"
    assert goal is not None, "a place that `places` has not found"
    x, y, _ = streets.point(closed, INTO_M).tolist()
    vans = []
    for lane in streets.lanes_beside(closed):
        acts: list[Act] = [
            Move(streets.point(lane, INTO_M)[None, :], lane),
            Await(0),
            Wait(parameters.closed_s),
            Ride((lane,), INTO_M, INTO_M + FREE_M, 6.0, end_mps=6.0),
        ]
        vans.append(Actor("van", acts, streets.edge(lane)))
    start = streets.point(seat.lane, seat.s)
    return Scene(
        streets.name(seat.lane),
        x,
        y,
        replace(seat, goal_edge=streets.edge(goal)),
        vans,
        [Cue(x, y, NEAR_M)],
        clear_m=hypot(start[0] - x, start[1] - y) + MARGIN_M,
    )
