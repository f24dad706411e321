"""A `Scene`: the actors, their scripts and the agent's start. Scenarios make them.

Their parameters are dataclass fields that know their range, their unit and what they are. Streams
of scripted vehicles cross or join the agent's way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from difflib import get_close_matches
from typing import Any, NamedTuple, TypeVar

from cavmarl.core.errors import ConfigError
from cavmarl.traffic.scenarios.motions import Ride, path_of
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.streets import Crossing, Streets


@dataclass(frozen=True)
class Seat:
    """Where the agent's vehicle begins."""

    lane: int
    s: float  # of its centre on the lane, m
    speed_mps: float  # at the beginning, and what its built-in driver would like to keep
    goal_edge: int  # EDGE row where its trip ends


class Outage(NamedTuple):
    """A signal that goes dark: the name of the signal, and when, in s since the beginning."""

    signal: str
    at_s: float


@dataclass(frozen=True)
class Scene:
    """One conflict, played to an agent; others may come behind it."""

    place: str  # where, by the map's name
    x: float  # its middle, m
    y: float
    seat: Seat
    actors: Sequence[Actor]  # those that follow a script
    cues: Sequence[Cue] = ()  # what they wait for, by the numbers of their `Await`s
    clear_m: float = 90.0  # how far around the middle no other vehicle is in the beginning
    outages: Sequence[Outage] = ()  # signals that go dark, and stay so

    @property
    def goal_edges(self) -> list[int]:
        released = [a.released_to for a in self.actors if a.released_to is not None]
        return list(dict.fromkeys([self.seat.goal_edge, *released]))


T = TypeVar("T")


def setting(default: float, low: float, high: float, unit: str, what: str) -> Any:
    metadata = {"low": low, "high": high, "unit": unit, "what": what}
    return field(default=default, metadata=metadata)


def switch(default: bool, what: str) -> Any:
    return field(default=default, metadata={"unit": "", "what": what})


def describe(parameters: type[Any]) -> list[tuple[str, str, str, str]]:
    """(name, default, range with unit, what it is) of each parameter of a dataclass."""
    return [(f.name, f"{f.default:g}" if _is_number(f) else str(f.default).lower(), _range(f),
             f.metadata["what"]) for f in fields(parameters)]  # fmt: skip


def checked(parameters: type[T], given: Mapping[str, bool | float], scenario: str) -> T:
    """The parameters of a scenario with the given values.

    `parameters`: a dataclass of `setting`s and `switch`es. `given`: value by name.

    Raises ConfigError: a name that it does not have, or a value out of range.
    """
    kind: Any = parameters
    known = {f.name: f for f in fields(kind)}
    for name, value in given.items():
        where = f"scenario.params.{name} = {value!r}"
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(known)}"
            raise ConfigError(f"{where}: scenario '{scenario}' has no such parameter; {hint}")
        about = known[name]
        if isinstance(value, bool) is _is_number(about):
            raise ConfigError(f"{where}: must be {_range(about)}")
        if _is_number(about):
            low, high = about.metadata["low"], about.metadata["high"]
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"{where}: must be {_range(about)}")
    made: T = kind(**given)
    return made


def _is_number(about: Field[Any]) -> bool:
    return "low" in about.metadata


def _range(about: Field[Any]) -> str:
    if not _is_number(about):
        return "true or false"
    low, high, unit = (about.metadata[key] for key in ("low", "high", "unit"))
    return f"{low:g} to {high:g} {unit}".rstrip()


Meeting = tuple[Crossing, Scene]

FREE_M = 20.0  # beyond the junction a built-in driver takes over


def approach(streets: Streets, link: int, far_m: float, speed_mps: float) -> Seat | None:
    """A seat on the lane that a link leaves, `far_m` before its end; None where that is shorter.

    `link`: LINK row that the agent is to drive over. `far_m`: of its centre to the end of the lane.
    """
    row = streets.network.links[link]
    lane, beyond = int(row["from_lane"]), int(row["to_lane"])
    s = streets.length_m(lane) - far_m
    if s < 5.0 or streets.length_m(beyond) < FREE_M:
        return None
    return Seat(lane, s, speed_mps, streets.edge(beyond))


def stream(
    streets: Streets, link: int, middle_m: float, speed_mps: float, times_s: list[float]
) -> list[Actor] | None:
    """Cars that drive over a link without reacting to others; None where there is no room for them.

    `middle_m`: a place on its path, from the stop line. `speed_mps`: of all of them, all the time.
    `times_s`: when each one's centre is at that place, rising.
    """
    path = path_of(streets.network, link)
    far_m = times_s[-1] * speed_mps - middle_m
    way = streets.upstream(path[0], far_m + 5.0)
    if way is None or streets.length_m(path[-1]) < FREE_M + 5.0:
        return None
    lanes, to_line_m = way
    through_m = float(streets.network.links["length_m"][link])
    riders = []
    for time_s in times_s:
        start_m = to_line_m + middle_m - time_s * speed_mps
        end_m = to_line_m + through_m + FREE_M
        ride = Ride((*lanes, *path[1:]), start_m, end_m, speed_mps, speed_mps, speed_mps)
        riders.append(Actor("car", [ride], streets.edge(path[-1])))
    return riders


def meet_stream(
    streets: Streets, place: Crossing, far_m: float, stream_mps: float, said: Any
) -> Scene | None:
    """An agent that meets the first car of a stream if it keeps its speed; None: no room for them.

    `place`: where both ways meet. `far_m`: from the agent to the junction in the beginning. `said`:
    the scenario's parameters: `speed_mps` of the agent, how many `cars`, `gap_s` between their
    centres, `lead_s` that the first is there before the agent.
    """
    seat = approach(streets, place.link, far_m, said.speed_mps)
    if seat is None:
        return None
    first_s = (far_m + place.middle_m) / said.speed_mps - said.lead_s
    times_s = [first_s + k * said.gap_s for k in range(math.floor(said.cars))]
    actors = stream(streets, place.foe, place.foe_middle_m, stream_mps, times_s)
    if actors is None:
        return None
    x, y, _ = streets.point(seat.lane, streets.length_m(seat.lane)).tolist()
    return Scene(streets.name(seat.lane), x, y, seat, actors)


def meetings(
    streets: Streets,
    crossings: Iterable[Crossing],
    far_m: float,
    stream_mps: float,
    said: Any,
) -> dict[str, Meeting]:
    """The first crossing of each lane where an agent meets a stream, and what is played there."""
    found: dict[str, Meeting] = {}
    for crossing in crossings:
        name = streets.name(int(streets.network.links["from_lane"][crossing.link]))
        if name not in found:
            scene = meet_stream(streets, crossing, far_m, stream_mps, said)
            if scene is not None:
                found[name] = crossing, scene
    return found
