"""The messages between a world and its followers; docs/guides/cosimulation.md specifies them.

A frame of `framed_socket` has a head, a payload in msgpack, and the bytes of arrays. A payload is
data and never code: an instance of one of these classes, as a map of its fields. A payload with
other fields, or with values of other types, is refused.
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
_ADAPTERS: dict[type, TypeAdapter[Any]] = {}  # cached, as they are slow to construct
_CLOSED = ConfigDict(extra="forbid")

VERSION = 4
MAX_LETTER = 1 << 22  # bytes of a payload
MAX_DATA = 1 << 28  # bytes of the arrays of one message
MAX_VEHICLES = 4096  # vehicles that one follower may request
MAX_POSES = 4096  # maximum number for one actor in a message


class Say(IntEnum):
    """Kinds of frames, and their senders."""

    HELLO = 0  # follower: requests vehicles
    WELCOME = 1  # world: accepts the request and describes its clock and sensors
    SNAPSHOT = 2  # world: the clock, and the sensors' new samples
    CONTROL = 3  # follower: controls of its vehicles for the next step
    TICK = 4  # follower: requests a tick of its own; a leading follower releases the next step
    TICKED = 5  # world: result of that tick
    REFUSAL = 6  # world: reason why it drops the follower
    GOODBYE = 7  # either: end of the connection
    POSES = 8  # follower: poses of its actors, at any time


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
class ActorRequest:
    """An actor that a follower brings into the world; see `ActorOrder`."""

    name: StrictStr  # unique among the actors of the follower
    type: StrictStr  # car, truck, bus, pedestrian, cyclist, roadside_unit, or a type of the world
    x: StrictFloat  # centre, in m
    y: StrictFloat
    heading: StrictFloat  # rad, counter-clockwise from east
    z: StrictFloat | None = None  # height of the ground below the centre, in m; none: the lane's
    # body: length, width and height in m; empty: size of the type
    size_m: list[StrictFloat] = field(default_factory=list)
    speed: StrictFloat = 0.0  # at the start, in m/s
    moved_by: StrictStr = "poses"  # or `controls`, `nothing`
    rate_hz: StrictFloat = 0.0  # rate of its poses; 0: unknown
    extrapolation_s: StrictFloat = 0.5  # largest time for which a pose is extrapolated
    # names of the sensors of the world's `rig` that it carries
    rig: list[StrictStr] = field(default_factory=list)


@with_config(_CLOSED)
@dataclass(frozen=True)
class Hello:
    """The first message of a follower."""

    name: StrictStr
    # agents to drive; none: it only follows the clock
    vehicles: list[StrictStr] = field(default_factory=list)
    secret: StrictStr = ""  # secret of the world, if the world listens at a port
    truth: StrictBool = False  # whether its snapshots are to contain all vehicles of the world
    actors: list[ActorRequest] = field(default_factory=list)  # actors that it brings
    # whether the world waits for its answers; if not, it sends poses and controls at any time
    waits: StrictBool = True
    leads: StrictBool = False  # whether each step of the world waits for a TICK of this follower


@with_config(_CLOSED)
@dataclass(frozen=True)
class SensorView:
    """A sensor that every vehicle has."""

    name: StrictStr
    units: list[StrictStr]  # units of its channels
    # its keys in `env.yaml`: type, mounting, rate, range and so on
    settings: dict[StrictStr, Any]


@with_config(_CLOSED)
@dataclass(frozen=True)
class Welcome:
    """The world's answer to HELLO."""

    environment: StrictStr  # name and version
    map_hash: StrictStr  # hash of the roads' source; a stack needs the same map
    vehicles: list[StrictStr]  # agents assigned to the follower
    tick: StrictInt  # the master's current tick
    dt_s: StrictFloat
    ticks_per_step: StrictInt  # ticks from one snapshot to the next
    # ticks from the start of a step until the vehicle applies the controls of this step
    control_latency_ticks: StrictInt
    action: StrictStr  # `continuous`, `discrete` or `grid`
    acceleration_mps2: StrictFloat  # acceleration if the first control is 1
    steering_rad: StrictFloat  # steering angle if the second control is 1
    # sensors of every vehicle; empty: snapshots contain the `observation` of the environment
    sensors: list[SensorView]


@with_config(_CLOSED)
@dataclass(frozen=True)
class ArrayView:
    """One array of a snapshot; its bytes are in the frame's data, in the order of the list."""

    # agent of the vehicle, or name of the actor; empty: the array is about the whole map:
    # `signals`: (1, links) the SIGNAL_* code of each link's signal (255: no signal); `truth`:
    # (1, n, columns of TRUTH)
    vehicle: StrictStr
    name: StrictStr
    dtype: StrictStr  # NumPy's notation, little-endian
    shape: list[StrictInt]  # the first axis counts samples
    stamps_s: list[StrictFloat]  # time of each sample, in simulated time since the reset
    lost: list[StrictBool]  # which samples were lost; their values are 0


@with_config(_CLOSED)
@dataclass(frozen=True)
class VehicleView:
    """A vehicle of the follower that is in the world."""

    vehicle_id: StrictInt  # changes if the agent gets a new vehicle
    vclass: StrictStr  # SUMO's class
    length_m: StrictFloat  # length of its body
    width_m: StrictFloat  # width of its body
    wheelbase_m: StrictFloat  # distance between the axles; the centre of the body is in the middle
    goal_edge: StrictStr  # destination, an edge of the map
    goal_m: list[StrictFloat]  # end of the destination edge: x and y on the map
    goal_heading_rad: StrictFloat  # heading of the road there


@with_config(_CLOSED)
@dataclass(frozen=True)
class ActorView:
    """An actor of the follower."""

    vehicle_id: StrictInt  # -1: it enters with the next step
    agent: StrictStr  # PettingZoo's id; empty: it carries no sensors
    x: StrictFloat  # as in `ActorRequest`
    y: StrictFloat
    z: StrictFloat
    heading: StrictFloat
    pitch: StrictFloat  # rad, positive uphill
    speed: StrictFloat  # m/s along its heading
    hit_id: StrictInt  # vehicle that it touches; -1: none


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerSnapshot:
    """The state of the world for a follower, sent after each step."""

    frame: StrictInt  # consecutive number
    episode: StrictInt  # increases with each reset
    tick: StrictInt  # tick of the world, since its reset
    time_s: StrictFloat  # tick · dt_s, simulated time
    is_over: StrictBool  # whether the episode has ended; then no controls are due
    # the follower's vehicles in the world, which have to be driven
    vehicles: dict[StrictStr, VehicleView]
    arrays: list[ArrayView]  # new samples of the sensors of vehicles and actors
    actors: dict[StrictStr, ActorView] = field(default_factory=dict)  # actors by name


@with_config(_CLOSED)
@dataclass(frozen=True)
class PoseView:
    """A pose of an actor; see `PoseSample`."""

    stamp_s: StrictFloat  # simulated time since the reset, at most the end of the next step
    x: StrictFloat
    y: StrictFloat
    heading: StrictFloat
    z: StrictFloat | None = None
    pitch: StrictFloat | None = None
    speed: StrictFloat | None = None


@with_config(_CLOSED)
@dataclass(frozen=True)
class ActorPoses:
    """Poses of actors, in any order."""

    poses: dict[StrictStr, list[PoseView]]  # poses by name of the actor


@with_config(_CLOSED)
@dataclass(frozen=True)
class Control:
    """The answer to a snapshot."""

    frame: StrictInt  # frame of the snapshot
    # by vehicle or actor. A vehicle gets two numbers in [-1, 1], or the number of a meta-action. An
    # actor that is moved by controls gets two numbers in [-1, 1], and keeps them until new controls
    controls: dict[StrictStr, list[StrictFloat] | StrictInt]
    poses: dict[StrictStr, list[PoseView]] = field(default_factory=dict)  # as in `ActorPoses`


@with_config(_CLOSED)
@dataclass(frozen=True)
class Ticked:
    """The result of a follower's own tick."""

    done: StrictBool  # whether the world has advanced
    refused: StrictStr  # reason of a refusal; empty if not refused
    tick: StrictInt  # current tick of the world, since its reset


@with_config(_CLOSED)
@dataclass(frozen=True)
class FollowerRefusal:
    """The reason why the world drops a follower."""

    reason: StrictStr


def payload_of(message: Any) -> dict[str, Any]:
    """Return a message as the map that is sent."""
    return asdict(message)


def read_payload(kind: type[T], payload: object) -> T:
    """Convert a payload to a message of a class.

    Raises FollowerError: a field is missing, unknown or of another type.
    """
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    try:
        checked: T = _ADAPTERS[kind].validate_python(payload)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the payload"
        raise FollowerError(
            f"not a {kind.__name__} of protocol version {VERSION}: {place}: {first['msg']}"
        ) from error
    return checked
