"""The signals of a junction fail as the agent arrives on the road that then has to yield.

Cars on the other road do not slow down for the agent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from cavmarl.traffic.scenarios.scene import Meeting, Outage, Scene, meetings, setting
from cavmarl.traffic.scenarios.streets import Crossing, Streets

NEEDS = (
    "a signal, and a straight movement that must yield to another movement while the signal is "
    "off, with 55 m of road before it"
)

FAR_M = 50.0  # initial distance from the agent to the junction


@dataclass(frozen=True)
class Parameters:
    """Parameters of the outage, the agent and the crossing cars."""

    speed_mps: float = setting(8.0, 3.0, 10.0, "m/s", "speed of the agent when it starts")
    passing_mps: float = setting(8.0, 3.0, 14.0, "m/s", "speed of the crossing cars")
    gap_s: float = setting(1.5, 1.0, 3.0, "s", "time between the centres of crossing cars")
    cars: float = setting(3, 1, 6, "", "number of crossing cars")
    lead_s: float = setting(
        0.0, -0.4, 0.4, "s", "time from the first car's arrival to an agent's at constant speed"
    )
    dark_s: float = setting(1.0, 0.0, 10.0, "s", "time at which the signals go dark")


def places(streets: Streets, parameters: Parameters) -> dict[str, Meeting]:
    """Return straight movements that must yield to a crossing movement if the signal is off."""
    crossings = (
        crossing
        for crossing in streets.crossings("s", yields=True, merges=False)
        if _loses_its_signal(streets, crossing)
    )
    return meetings(streets, crossings, FAR_M, parameters.passing_mps, parameters)


def _loses_its_signal(streets: Streets, crossing: Crossing) -> bool:
    one, other = streets.network.links[[crossing.link, crossing.foe]]
    return bool(
        one["signal"] >= 0 and one["signal"] == other["signal"] and one["state"] == ord("o")
    )


def stage(streets: Streets, place: Meeting, parameters: Parameters) -> Scene:
    """Stage cars so that the first meets an agent at constant speed in the junction."""
    crossing, scene = place
    signal = int(streets.network.links["signal"][crossing.link])
    outage = Outage(streets.network.signal_ids[signal], parameters.dark_s)
    return replace(scene, outages=(outage,))
