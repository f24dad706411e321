"""`Scene`: the actors, their scripts and the agent's start, as made by scenarios.

Parameters of scenarios are dataclass fields with a range, a unit and a description. This module
also has helpers for streams of scripted vehicles that cross or join the agent's path.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from difflib import get_close_matches
from typing import Any, NamedTuple, TypeVar

from cavmarl.core.errors import ConfigError
from cavmarl.maps.scenes.logged_scene import LoggedScene, Track
from cavmarl.traffic.scenarios.motions import Ride, path_of
from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue
from cavmarl.traffic.scenarios.streets import Crossing, Streets


@dataclass(frozen=True)
class Seat:
    """The start of an agent's vehicle."""

    lane: int
    s: float  # m, position of the centre on the lane
    speed_mps: float  # initial speed, and the speed that its built-in driver keeps
    goal_edge: int  # EDGE row where the trip ends
    body: SeatBody | None = None  # None: in the middle of the lane, with the size of the type


class SeatBody(NamedTuple):
    """The exact pose and the size of a vehicle at its start."""

    x: float  # m, position of the centre
    y: float
    heading: float  # rad
    d: float  # m to the left of the middle of the lane
    length: float  # m
    width: float
    height: float


class ReactingVehicle(NamedTuple):
    """A logged vehicle that a built-in driver drives along the logged route."""

    track: Track
    seat: Seat
    edges: tuple[int, ...]  # EDGE rows of the route
    depart_s: float  # departure in s after the reset


class LoggedTraffic(NamedTuple):
    """The vehicles of a logged scene."""

    scene: LoggedScene
    first: int  # number of the sample at the reset
    seated: Sequence[Track]  # tracks whose vehicles the agents drive
    replayed: Sequence[Track]
    reacting: Sequence[ReactingVehicle]  # sorted by departure
    notes: tuple[str, ...]  # changes to the log, with counts


class Outage(NamedTuple):
    """A signal failure: the name of the signal, and the start in s after the reset."""

    signal: str
    at_s: float


@dataclass(frozen=True)
class Scene:
    """A conflict staged for an agent; other agents may follow behind it."""

    place: str  # name of the place on the map
    x: float  # m, centre of the scene
    y: float
    seat: Seat
    actors: Sequence[Actor]  # the scripted actors
    cues: Sequence[Cue] = ()  # cues by the numbers in the actors' `Await`s
    clear_m: float = 90.0  # radius around the centre without other vehicles at the start
    outages: Sequence[Outage] = ()  # signals that fail and stay off
    seats: Sequence[Seat] = ()  # seats of all agents, if each agent has its own place
    log: LoggedTraffic | None = None

    @property
    def goal_edges(self) -> list[int]:
        released = [a.released_to for a in self.actors if a.released_to is not None]
        seats = [seat.goal_edge for seat in self.seats]
        return list(dict.fromkeys([self.seat.goal_edge, *released, *seats]))

    @property
    def num_rows(self) -> int:
        """Number of vehicles besides agents' vehicles and vehicles with an order."""
        return len(self.actors) + (0 if self.log is None else len(self.log.replayed))


T = TypeVar("T")


def setting(default: float, low: float, high: float, unit: str, what: str) -> Any:
    metadata = {"low": low, "high": high, "unit": unit, "what": what}
    return field(default=default, metadata=metadata)


def switch(default: bool, what: str) -> Any:
    return field(default=default, metadata={"unit": "", "what": what})


def describe(parameters: type[Any]) -> list[tuple[str, str, str, str]]:
    """Return name, default, range with unit, and description of each field of a dataclass."""
    return [(f.name, f"{f.default:g}" if _is_number(f) else str(f.default).lower(), _range(f),
             f.metadata["what"]) for f in fields(parameters)]  # fmt: skip


def checked(parameters: type[T], given: Mapping[str, bool | float], scenario: str) -> T:
    """Return the parameters of a scenario with the given values.

    `parameters`: a dataclass of `setting`s and `switch`es. `given`: value by name.

    Raises ConfigError: a name is unknown, or a value is out of range.
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

FREE_M = 20.0  # distance beyond the junction at which a built-in driver takes over


def approach(streets: Streets, link: int, far_m: float, speed_mps: float) -> Seat | None:
    """Return a seat `far_m` before the link's stop line; None if the lane is too short.

    `link`: LINK row over which the agent has to drive. `far_m`: from its centre to the lane's end.
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
    """Return cars that drive over a link without reacting to others; None without room.

    `middle_m`: a place on the link, from the stop line. `speed_mps`: constant speed of all cars.
    `times_s`: time of each car's centre at that place, ascending.
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
    streets: Streets, place: Crossing, far_m: float, stream_mps: float, parameters: Any
) -> Scene | None:
    """Stage a stream of cars so that the first meets an agent at constant speed; None: no room.

    `place`: where both paths meet. `far_m`: initial distance from the agent to the junction.
    `parameters`: the scenario's `speed_mps` of the agent, number of `cars`, `gap_s` between the
    cars' centres, and `lead_s` of the first car before the agent.
    """
    seat = approach(streets, place.link, far_m, parameters.speed_mps)
    if seat is None:
        return None
    first_s = (far_m + place.middle_m) / parameters.speed_mps - parameters.lead_s
    times_s = [first_s + k * parameters.gap_s for k in range(math.floor(parameters.cars))]
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
    parameters: Any,
) -> dict[str, Meeting]:
    """Return, for each lane, the first crossing with room for a stream, and its scene."""
    found: dict[str, Meeting] = {}
    for crossing in crossings:
        name = streets.name(int(streets.network.links["from_lane"][crossing.link]))
        if name not in found:
            scene = meet_stream(streets, crossing, far_m, stream_mps, parameters)
            if scene is not None:
                found[name] = crossing, scene
    return found
