"""The messages between a world and its followers; docs/followers.md specifies them.

A frame is that of `hosts.wire`: a head, a letter in msgpack, and the bytes of arrays. No letter is
ever run. Each is one of these classes, as a map of its fields; a letter with other fields, or with
values of other types, is refused.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import IntEnum
from typing import Any, TypeVar

from pydantic import (
    ConfigDict,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
    TypeAdapter,
    ValidationError,
    with_config,
)

from cavmarl.core.errors import FollowerError, require
from cavmarl.parallel.hosts.framed_socket import Dialect

T = TypeVar("T")

_msgpack: Any = require("msgpack", "followers")
_ADAPTERS: dict[type, TypeAdapter[Any]] = {}  # slow to make
_CLOSED = ConfigDict(extra="forbid")

VERSION = 1
MAX_LETTER = 1 << 22
MAX_DATA = 1 << 28
MAX_VEHICLES = 4096


class Say(IntEnum):
    """Kinds of frames, and their senders."""

    HELLO = 0  # follower: I want these vehicles
    WELCOME = 1  # world: they are yours, and this is how time goes here
    SNAPSHOT = 2  # world: the clock, and what the sensors have
    CONTROL = 3  # follower: what the vehicles do in the next step
    TICK = 4  # follower: I want to tick by myself
    TICKED = 5  # world: what has become of that
    REFUSAL = 6  # world: why it does not go on with you
    GOODBYE = 7  # either: there is nothing more to come


FOLLOWERS = Dialect(
    b"cavF",
    VERSION,
    Say,
    MAX_LETTER,
    MAX_DATA,
    _msgpack.packb,
    _msgpack.unpackb,
    "install the same version of the protocol at both ends",
)


@with_config(_CLOSED)
@dataclass(frozen=True)
class Hello:
    """The first words of a follower.

    Attributes:
        name: for people.
        vehicles: agents that it wants to drive; none: it follows the clock only.
        secret: of the world, if it listens at a port.
    """

    name: StrictStr
    vehicles: list[StrictStr] = field(default_factory=list)
    secret: StrictStr = ""


@with_config(_CLOSED)
@dataclass(frozen=True)
class SensorView:
    """One sensor of every vehicle.

    Attributes:
        name: in the rig.
        units: of its channels.
        settings: its keys in `env.yaml`: type, place on the vehicle, rate, range and so on.
    """

    name: StrictStr
    units: list[StrictStr]
    settings: dict[StrictStr, Any]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Welcome:
    """The answer.

    Attributes:
        environment: name and version.
        map_hash: of the roads' source: a stack needs the same map.
        vehicles: those that the follower has been given.
        tick: the master's, now.
        dt_s: seconds a tick.
        ticks_per_step: ticks from one snapshot to the next.
        control_latency_ticks: that controls wait in the vehicle, after the step that they are for
            has begun.
        action: `continuous` or `discrete`.
        acceleration_mps2: what 1 means as the first number of a control.
        steering_rad: what 1 means as the second.
        sensors: of every vehicle; none: a snapshot has the `observation` of the environment.
    """

    environment: StrictStr
    map_hash: StrictStr
    vehicles: list[StrictStr]
    tick: StrictInt
    dt_s: StrictFloat
    ticks_per_step: StrictInt
    control_latency_ticks: StrictInt
    action: StrictStr
    acceleration_mps2: StrictFloat
    steering_rad: StrictFloat
    sensors: list[SensorView]


@with_config(_CLOSED)
@dataclass(frozen=True)
class ArrayView:
    """One array of a snapshot; its bytes lie in the frame's data, in the order of the list.

    Attributes:
        vehicle: whose; nothing: it is of the whole map, as `signals`: (1, links) what the signal of
            each link shows, as a SIGNAL_* code (255: it has none).
        name: of the sensor.
        dtype: as NumPy writes it, little-endian.
        shape: of the array; the first axis are samples.
        stamps_s: when each was taken, in simulated time since the reset.
        lost: which of them were lost: zeros.
    """

    vehicle: StrictStr
    name: StrictStr
    dtype: StrictStr
    shape: list[StrictInt]
    stamps_s: list[StrictFloat]
    lost: list[StrictBool]


@with_config(_CLOSED)
@dataclass(frozen=True)
class VehicleView:
    """One of the follower's vehicles that is in the world.

    Attributes:
        vehicle_id: of the vehicle; another one: the agent drives a new vehicle.
        vclass: SUMO's class of it.
        length_m: of its body.
        width_m: of its body.
        goal_edge: where it is to go, an edge of the map.
        goal_m: the end of that way: x and y on the map.
    """

    vehicle_id: StrictInt
    vclass: StrictStr
    length_m: StrictFloat
    width_m: StrictFloat
    goal_edge: StrictStr
    goal_m: list[StrictFloat]


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerSnapshot:
    """What a follower gets after each step.

    Attributes:
        frame: its number; the next one's is one more.
        episode: goes up with each reset.
        tick: of the world, since its reset.
        time_s: tick · dt_s, simulated time.
        is_over: the episode has ended; no controls are due.
        vehicles: those of the follower's that are in the world, and have to be driven.
        arrays: what their sensors have that is due.
    """

    frame: StrictInt
    episode: StrictInt
    tick: StrictInt
    time_s: StrictFloat
    is_over: StrictBool
    vehicles: dict[StrictStr, VehicleView]
    arrays: list[ArrayView]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Control:
    """The answer to a snapshot.

    Attributes:
        frame: of the snapshot.
        controls: of each vehicle in it: two numbers in [-1, 1], or the number of a meta-action.
    """

    frame: StrictInt
    controls: dict[StrictStr, list[StrictFloat] | StrictInt]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Ticked:
    """What has become of a follower's own tick.

    Attributes:
        done: whether the world has gone on.
        refused: why it was refused; nothing if it was not.
        tick: of the world now, since its reset.
    """

    done: StrictBool
    refused: StrictStr
    tick: StrictInt


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerRefusal:
    """Why the world does not go on with a follower."""

    reason: StrictStr


def letter_of(message: Any) -> dict[str, Any]:
    """A message as the map that is sent."""
    return asdict(message)


def read_letter(kind: type[T], letter: object) -> T:
    """The message of a class that a letter is.

    Raises:
        FollowerError: it is none: a field is missing, unknown or of another type.
    """
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    try:
        checked: T = _ADAPTERS[kind].validate_python(letter)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the letter"
        raise FollowerError(
            f"no {kind.__name__} of protocol version {VERSION}: {place}: {first['msg']}"
        ) from error
    return checked
