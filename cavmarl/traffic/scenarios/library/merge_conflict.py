"""The agent has to join a lane on which cars pass that do not slow down for it."""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.traffic.scenarios.scene import Meeting, Scene, meetings, setting
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = "a movement that gives way to another one into the same lane, with 45 m of road before it"

FAR_M = 40.0  # from the agent to the junction in the beginning


@dataclass(frozen=True)
class Parameters:
    """What can be said about both sides."""

    speed_mps: float = setting(6.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    passing_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the cars that pass")
    gap_s: float = setting(1.5, 1.0, 3.0, "s", "between them, from centre to centre")
    cars: float = setting(3, 1, 6, "", "how many pass")
    lead_s: float = setting(
        0.0, -0.4, 0.4, "s", "how long the first is there before an agent that keeps its speed"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, Meeting]:
    """Movements that have to give way to one that goes straight on into the same lane."""
    crossings = streets.crossings("slLrR", yields=True, merges=True)
    return meetings(streets, crossings, FAR_M, parameters.passing_mps, parameters)


def stage(streets: Streets, place: Meeting, parameters: Parameters) -> Scene:
    """The first car meets an agent that keeps its speed where both ways join."""
    return place[1]
