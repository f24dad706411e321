"""The agent has to join a lane with passing cars that do not slow down for it."""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.traffic.scenarios.scene import Meeting, Scene, meetings, setting
from cavmarl.traffic.scenarios.streets import Streets

NEEDS = "a movement that yields to another one into the same lane, with 45 m of road before it"

FAR_M = 40.0  # initial distance from the agent to the junction


@dataclass(frozen=True)
class Parameters:
    """Parameters of the agent and the passing cars."""

    speed_mps: float = setting(6.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    passing_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the passing cars")
    gap_s: float = setting(1.5, 1.0, 3.0, "s", "time between the centres of passing cars")
    cars: float = setting(3, 1, 6, "", "number of passing cars")
    lead_s: float = setting(
        0.0, -0.4, 0.4, "s", "time from the first car's arrival to an agent's at constant speed"
    )


def places(streets: Streets, parameters: Parameters) -> dict[str, Meeting]:
    """Return movements that yield to a straight movement into the same lane."""
    crossings = streets.crossings("slLrR", yields=True, merges=True)
    return meetings(streets, crossings, FAR_M, parameters.passing_mps, parameters)


def stage(streets: Streets, place: Meeting, parameters: Parameters) -> Scene:
    """Stage cars so that the first meets an agent at constant speed where both paths join."""
    return place[1]
