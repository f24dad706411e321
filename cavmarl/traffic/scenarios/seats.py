"""Where the agents of a scene begin: the first in the conflict, the others behind it."""

from __future__ import annotations

from dataclasses import replace

from cavmarl.core.errors import ConfigError
from cavmarl.traffic.scenarios.motions import Ride
from cavmarl.traffic.scenarios.scene import Scene, Seat
from cavmarl.traffic.scenarios.streets import Streets

APART_M = 6.0  # between the centres of two agents, one behind the other,
APART_S = 2.0  # and the way of this time
START_M = 5.0  # of a lane on which no vehicle begins


def take_seats(streets: Streets, scene: Scene, num: int) -> list[Seat]:
    """The seats of `num` agents, that of the scene first.

    The others come after it on its own approach, with the same speed and the same goal, on lanes
    outside junctions along which no actor rides: actors react to no vehicle.

    Raises:
        ConfigError: there is no room for so many behind the first.
    """
    rides = [act for actor in scene.actors for act in actor.acts if isinstance(act, Ride)]
    closed = {lane for ride in rides for lane in ride.lanes}
    seats = [scene.seat]
    lane, s = scene.seat.lane, scene.seat.s
    while len(seats) < num:
        s -= APART_M + APART_S * scene.seat.speed_mps
        while s < START_M:
            closed.add(lane)
            before = streets.before(lane)
            if before is None or before in closed:
                raise ConfigError(
                    f"population.agents = {num}: behind the agent of the scene at '{scene.place}' "
                    f"on the map '{streets.network.name}' there is room for {len(seats) - 1} "
                    f"more; ask for at most {len(seats)}, or name another scenario.place"
                )
            lane = before
            s += streets.length_m(lane)
        row = streets.network.lanes[lane]
        if not row["internal"]:
            speed_mps = min(scene.seat.speed_mps, float(row["speed_mps"]))
            seats.append(replace(scene.seat, lane=lane, s=s, speed_mps=speed_mps))
    return seats
