"""The messages between a world and its followers; docs/guides/cosimulation.md specifies them.

A frame is that of `framed_socket`: a head, a payload in msgpack, and the bytes of arrays. A payload
is data and never code. Each is one of these classes, as a map of its fields; a payload with other
fields, or with values of other types, is refused.
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
from cavmarl.cosim.followers.framed_socket import Dialect

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
    """The first words of a follower."""

    name: StrictStr
    # agents that it wants to drive; none: it follows the clock only
    vehicles: list[StrictStr] = field(default_factory=list)
    secret: StrictStr = ""  # of the world, if it listens at a port


@with_config(_CLOSED)
@dataclass(frozen=True)
class SensorView:
    """One sensor of every vehicle."""

    name: StrictStr
    units: list[StrictStr]  # of its channels
    # its keys in `env.yaml`: type, place on the vehicle, rate, range and so on
    settings: dict[StrictStr, Any]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Welcome:
    """The answer."""

    environment: StrictStr  # name and version
    map_hash: StrictStr  # of the roads' source: a stack needs the same map
    vehicles: list[StrictStr]  # those that the follower has been given
    tick: StrictInt  # the master's, now
    dt_s: StrictFloat
    ticks_per_step: StrictInt  # ticks from one snapshot to the next
    # that controls wait in the vehicle, after the step that they are for has begun
    control_latency_ticks: StrictInt
    action: StrictStr  # `continuous`, `discrete` or `grid`
    acceleration_mps2: StrictFloat  # what 1 means as the first number of a control
    steering_rad: StrictFloat  # what 1 means as the second
    # of every vehicle; none: a snapshot has the `observation` of the environment
    sensors: list[SensorView]


@with_config(_CLOSED)
@dataclass(frozen=True)
class ArrayView:
    """One array of a snapshot; its bytes lie in the frame's data, in the order of the list."""

    # whose; nothing: it is of the whole map, as `signals`: (1, links) what the signal of each link
    # shows, as a SIGNAL_* code (255: it has none)
    vehicle: StrictStr
    name: StrictStr
    dtype: StrictStr  # as NumPy writes it, little-endian
    shape: list[StrictInt]  # of the array; the first axis are samples
    stamps_s: list[StrictFloat]  # when each was taken, in simulated time since the reset
    lost: list[StrictBool]  # which of them were lost: zeros


@with_config(_CLOSED)
@dataclass(frozen=True)
class VehicleView:
    """One of the follower's vehicles that is in the world."""

    vehicle_id: StrictInt  # of the vehicle; another one: the agent drives a new vehicle
    vclass: StrictStr  # SUMO's class of it
    length_m: StrictFloat  # of its body
    width_m: StrictFloat  # of its body
    goal_edge: StrictStr  # where it is to go, an edge of the map
    goal_m: list[StrictFloat]  # the end of that way: x and y on the map


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerSnapshot:
    """What a follower gets after each step."""

    frame: StrictInt  # its number; the next one's is one more
    episode: StrictInt  # goes up with each reset
    tick: StrictInt  # of the world, since its reset
    time_s: StrictFloat  # tick · dt_s, simulated time
    is_over: StrictBool  # the episode has ended; no controls are due
    # those of the follower's that are in the world, and have to be driven
    vehicles: dict[StrictStr, VehicleView]
    arrays: list[ArrayView]  # what their sensors have that is due


@with_config(_CLOSED)
@dataclass(frozen=True)
class Control:
    """The answer to a snapshot."""

    frame: StrictInt  # of the snapshot
    # of each vehicle in it: two numbers in [-1, 1], or the number of a meta-action
    controls: dict[StrictStr, list[StrictFloat] | StrictInt]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Ticked:
    """What has become of a follower's own tick."""

    done: StrictBool  # whether the world has gone on
    refused: StrictStr  # why it was refused; nothing if it was not
    tick: StrictInt  # of the world now, since its reset


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerRefusal:
    """Why the world does not go on with a follower."""

    reason: StrictStr


def payload_of(message: Any) -> dict[str, Any]:
    """A message as the map that is sent."""
    return asdict(message)


def read_payload(kind: type[T], payload: object) -> T:
    """The message of a class that a payload is.

    Raises FollowerError: it is none: a field is missing, unknown or of another type.
    """
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    try:
        checked: T = _ADAPTERS[kind].validate_python(payload)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the payload"
        raise FollowerError(
            f"no {kind.__name__} of protocol version {VERSION}: {place}: {first['msg']}"
        ) from error
    return checked
