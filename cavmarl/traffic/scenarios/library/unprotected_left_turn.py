"""The agent turns left across oncoming cars that do not slow down for it.

In left-hand traffic the agent turns right.

No signal phase protects the turn: the agent has to find a gap or wait until all cars have passed.
"""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.traffic.scenarios.scene import Meeting, Scene, meetings, setting
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = "a left turn across an oncoming lane, with 45 m of road before it"

FAR_M = 40.0  # initial distance from the agent to the junction
OPPOSITE_RAD = 2.4  # minimum angle between opposite approaches


@dataclass(frozen=True)
class Parameters:
    """Parameters of the agent and the oncoming cars."""

    speed_mps: float = setting(6.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    oncoming_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the oncoming cars")
    gap_s: float = setting(1.5, 1.0, 3.0, "s", "time between the centres of oncoming cars")
    cars: float = setting(3, 1, 6, "", "number of oncoming cars")
    lead_s: float = setting(
        0.0, -0.4, 0.4, "s", "time from the first car's arrival to an agent's at constant speed"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, Meeting]:
    """Return turns across the road that yield to a lane from the opposite side."""
    crossings = (
        crossing
        for crossing in streets.crossings(streets.across, yields=True, merges=False)
        if streets.turn_rad(crossing.link, crossing.foe) > OPPOSITE_RAD
    )
    return meetings(streets, crossings, FAR_M, parameters.oncoming_mps, parameters)


def stage(streets: Streets, place: Meeting, parameters: Parameters) -> Scene:
    """Stage cars so that the first meets an agent at constant speed where both paths cross."""
    return place[1]
