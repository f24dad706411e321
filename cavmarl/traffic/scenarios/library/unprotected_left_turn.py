"""The agent turns left across oncoming cars that do not slow down for it.

Where one drives on the left it turns right.

No signal phase of its own protects it: it has to find a gap, or to wait until all have passed.
"""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.traffic.scenarios.scene import Meeting, Scene, meetings, setting
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = "a left turn across an oncoming lane, with 45 m of road before it"

FAR_M = 40.0  # from the agent to the junction in the beginning
OPPOSITE_RAD = 2.4  # between approaches that face each other


@dataclass(frozen=True)
class Parameters:
    """What can be said about both sides."""

    speed_mps: float = setting(6.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    oncoming_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the oncoming cars")
    gap_s: float = setting(1.5, 1.0, 3.0, "s", "between oncoming cars, from centre to centre")
    cars: float = setting(3, 1, 6, "", "how many come")
    lead_s: float = setting(
        0.0, -0.4, 0.4, "s", "how long the first is there before an agent that keeps its speed"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, Meeting]:
    """Turns across the road that have to give way to a lane that comes from the opposite side."""
    crossings = (
        crossing
        for crossing in streets.crossings(streets.across, yields=True, merges=False)
        if streets.turn_rad(crossing.link, crossing.foe) > OPPOSITE_RAD
    )
    return meetings(streets, crossings, FAR_M, parameters.oncoming_mps, parameters)


def stage(streets: Streets, place: Meeting, parameters: Parameters) -> Scene:
    """The first car meets an agent that keeps its speed where both ways cross."""
    return place[1]
