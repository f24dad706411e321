"""A car stops in the middle of a junction, across the agent's path, and later drives on."""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.traffic.scenarios.motions import Act, Await, Ride, Wait, path_of
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.scene import FREE_M, Scene, approach, setting
from cavmarl.traffic.scenarios.streets import Crossing, Streets

NEEDS = "a junction where a straight movement crosses another movement, with 65 m of road before it"

FAR_M = 60.0  # initial distance from the agent to the junction
ROLL_M = 12.0  # initial distance from the other car to its stop line
NEAR_M = 30.0  # distance from the agent to the junction at which the time of the blockage starts


@dataclass(frozen=True)
class Parameters:
    """Parameters of the blockage."""

    speed_mps: float = setting(8.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    blocked_s: float = setting(
        8.0, 6.0, 60.0, "s", "time for which the car blocks the junction once the agent is near"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, Crossing]:
    """Return straight movements that another straight movement crosses."""
    found: dict[str, Crossing] = {}
    for yields in (False, True):
        for crossing in streets.crossings("s", yields=yields, merges=False):
            lane = int(streets.network.links["from_lane"][crossing.link])
            seat = approach(streets, crossing.link, FAR_M, parameters.speed_mps)
            path = path_of(streets.network, crossing.foe)
            ends = (streets.length_m(path[0]), streets.length_m(path[-1]))
            room = ends[0] > ROLL_M + 5.0 and ends[1] > FREE_M + 5.0
            if seat is not None and room:
                found.setdefault(streets.name(lane), crossing)
    return found


def stage(streets: Streets, place: Crossing, parameters: Parameters) -> Scene:
    """Stage a car that blocks the junction before an agent arrives, and drives on later."""
    seat = approach(streets, place.link, FAR_M, parameters.speed_mps)
    assert seat is not None, "a place that `places` has not found"
    path = path_of(streets.network, place.foe)
    line_m = streets.length_m(path[0])
    stop_m = line_m + place.foe_middle_m
    end_m = line_m + float(streets.network.links["length_m"][place.foe]) + FREE_M
    acts: list[Act] = [
        Ride(path, line_m - ROLL_M, stop_m, 8.0, start_mps=6.0),
        Await(0),
        Wait(parameters.blocked_s),
        Ride(path, stop_m, end_m, 6.0, end_mps=6.0),
    ]
    x, y, _ = streets.point(seat.lane, streets.length_m(seat.lane)).tolist()
    car = Actor("car", acts, streets.edge(path[-1]))
    return Scene(streets.name(seat.lane), x, y, seat, [car], [Cue(x, y, NEAR_M)])
