"""The message schema: fixed little-endian records with a version.

The records resemble the standards but are simpler: metres and radians in the world's frame instead
of degrees, ticks instead of milliseconds, no encoding rules, no certificates.

| message | modelled after | contents |
|---|---|---|
| `CAM` | ETSI EN 302 637-2, cooperative awareness | state of the sending vehicle |
| `DENM` | ETSI EN 302 637-3, decentralized notification | an event |
| `CPM_OBJECT` | ETSI TS 103 324, collective perception | a vehicle that the sender sees |
| `SPAT` | SAE J2735, signal phase and timing | the current phase of a signal |
| `MAP` | SAE J2735, map data | one approach to a signal |

All positions are centres of bodies, x east, y north, z up; headings are counter-clockwise from
east. Ticks are ticks of the world. A station is a vehicle, given by its id, or roadside unit k,
given by `FIRST_ROADSIDE_ID` + k.

Roadside units are at signals. A `MAP` never changes and is not sent; `map_of` returns it.

An external network simulator (ns-3, OMNeT++ or any other) implements `NetworkSimulator.exchange`.
The bus calls this method once per tick and world with the packets sent in that tick. The method
returns when it has simulated up to that tick, so neither side runs ahead.
"""

from __future__ import annotations

import difflib
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.v2x import EVERY_SIGNAL, RoadsideConfig, V2xConfig
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.core.records import record
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.signal_places import links_of_signal, place_of_signal, stop_lines
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_COLLISION,
    CAUSE_HARD_BRAKING,
    CAUSE_OBSTACLE,
    CAUSE_ROAD_CLOSED,
    CAUSE_STATIONARY,
    FIRST_ROADSIDE_ID,
    KIND_CAM,
    KIND_CPM,
    KIND_DENM,
    KIND_SPAT,
    UNIT,
)

SCHEMA_VERSION = 1

HEADER = np.dtype(
    [
        ("version", "<u2"),  # SCHEMA_VERSION
        ("kind", "<u2"),  # 0 CAM, 1 DENM, 2 CPM, 3 SPAT
        ("count", "<u4"),  # number of records that follow: 1, or the objects of a CPM
        ("sender", "<i8"),  # station
        ("tick", "<i8"),  # tick of sending
        ("x", "<f8"),  # m, position of the sender
        ("y", "<f8"),  # m
    ]
)

_KINEMATICS = [
    ("x", "<f8"),  # m
    ("y", "<f8"),  # m
    ("z", "<f8"),  # m
    ("heading", "<f8"),  # rad
    ("speed", "<f8"),  # m/s, negative if reversing
    ("accel", "<f8"),  # m/s²
    ("yaw_rate", "<f8"),  # rad/s
    ("length", "<f8"),  # m
    ("width", "<f8"),  # m
]

CAM = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("vclass", "<i4"),  # index in roads.network.VEHICLE_CLASSES
        *_KINEMATICS,
    ]
)

CPM_OBJECT = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("object", "<i8"),  # the perceived vehicle
        ("vclass", "<i4"),
        *_KINEMATICS,
    ]
)

DENM = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),  # tick of the event
        ("expires", "<i8"),  # last tick in which the event is valid
        ("cause", "<i4"),  # ETSI cause code: 2, 5, 10, 94, 99
        ("x", "<f8"),  # m, position of the event
        ("y", "<f8"),
        ("z", "<f8"),
        ("heading", "<f8"),  # rad, heading of the affected traffic
        ("speed", "<f8"),  # m/s, speed of the vehicle
    ]
)

SPAT = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("signal", "<i4"),  # SIGNAL row
        # current PHASE row, with the letters of all links; −1 − row if the caller overrides the
        # state of some of them
        ("phase", "<i4"),
        ("left_s", "<f8"),  # earliest remaining time of the phase, s
    ]
)

MAP = np.dtype(
    [
        ("sender", "<i8"),
        ("signal", "<i4"),  # SIGNAL row
        ("link", "<i4"),  # LINK row: one movement
        ("letter", "<i4"),  # index of the link's letter in the signal's phases
        ("x", "<f8"),  # m, position of the link's stop line
        ("y", "<f8"),
        ("heading", "<f8"),  # rad, direction of travel
        ("speed_limit", "<f8"),  # m/s
    ]
)

KINDS: dict[int, np.dtype[Any]] = {
    KIND_CAM: CAM,
    KIND_DENM: DENM,
    KIND_CPM: CPM_OBJECT,
    KIND_SPAT: SPAT,
}

# Causes of events, with ETSI's cause codes.
CAUSES = {
    "collision": CAUSE_COLLISION,
    "road_closed": CAUSE_ROAD_CLOSED,
    "obstacle": CAUSE_OBSTACLE,
    "stationary": CAUSE_STATIONARY,
    "hard_braking": CAUSE_HARD_BRAKING,
}

# Fields that have another name in the bus's REPORT.
_OWN_NAMES = {
    "vclass": "code",
    "cause": "code",
    "phase": "code",
    "object": "subject",
    "signal": "subject",
}


def cause_code(cause: str) -> int:
    """Return ETSI's code of a cause.

    Raises ConfigError: no cause has that name.
    """
    if cause not in CAUSES:
        raise ConfigError(f"cause = {cause!r}: must be one of {', '.join(CAUSES)}")
    return CAUSES[cause]


def messages_of(kind: int, reports: NDArray[np.void]) -> NDArray[np.void]:
    """Convert reports of the bus to records of the schema.

    `reports`: REPORT (n,) of that kind; empty rows (sender -1) are left out.

    Returns CAM, DENM, CPM_OBJECT or SPAT (n,).
    """
    there = reports[(reports["sender"] >= 0) & (reports["kind"] == kind)]
    found = np.zeros(len(there), KINDS[kind])
    for name in KINDS[kind].names or ():
        found[name] = there[_OWN_NAMES.get(name, name)]
    return found


def encode(packet: np.void, reports: NDArray[np.void]) -> bytes:
    """Serialize a packet: the header, then the records.

    `reports`: REPORT (Q,) of the packet's tick.
    """
    kind, first, count = int(packet["kind"]), int(packet["first"]), int(packet["count"])
    header = np.zeros((), HEADER)
    header["version"], header["kind"], header["count"] = SCHEMA_VERSION, kind, count
    for name in ("sender", "tick", "x", "y"):
        header[name] = packet[name]
    return header.tobytes() + messages_of(kind, reports[first : first + count]).tobytes()


def decode(data: bytes) -> tuple[np.void, NDArray[np.void]]:
    """Parse the header and the records of a packet.

    Raises MessageError: another version, an unknown kind, or a wrong length.
    """
    if len(data) < HEADER.itemsize:
        raise MessageError(f"{len(data)} bytes are not a message: a header needs {HEADER.itemsize}")
    header = np.frombuffer(data, HEADER, 1)[0]
    if header["version"] != SCHEMA_VERSION:
        raise MessageError(
            f"message of version {header['version']}: only version {SCHEMA_VERSION} can be read"
        )
    kind, count = int(header["kind"]), int(header["count"])
    if kind not in KINDS:
        raise MessageError(f"message of kind {kind}: must be one of {', '.join(map(str, KINDS))}")
    size = HEADER.itemsize + count * KINDS[kind].itemsize
    if len(data) != size:
        raise MessageError(f"message of {len(data)} bytes: header and {count} records need {size}")
    return header, np.frombuffer(data, KINDS[kind], count, HEADER.itemsize)


# The reception of a packet by a receiver, in the tick of the call.
RECEPTION = record(
    ("tick", np.int64),  # tick of sending
    ("packet", np.int64),  # index among the packets of that tick
    ("receiver", np.int64),  # row of `Exchange.receivers`
)


class Exchange(NamedTuple):
    """A tick of a world for a network simulator; the arrays are valid only during the call."""

    world: int
    tick: int  # tick of the world, from 1 after a reset
    packets: NDArray[np.void]  # PACKET (n,) sent in this tick, by sender, then kind
    # RECEIVER (R,), positions of agents and roadside units; id -1: none
    receivers: NDArray[np.void]


class NetworkSimulator(Protocol):
    """Decides which stations receive which packets in which tick."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """Simulate up to this tick.

        If a node dies, a tick is repeated: the method gets the same packets again and must return
        the same answer.

        Returns RECEPTION (n,): packets of this or earlier ticks that are received in this tick.
        """
        ...


def check_external(v2x: V2xConfig) -> None:
    """Check that the channel is external, so that a network simulator can be connected."""
    if not (v2x.enabled and v2x.channel.external):
        raise ConfigError("v2x.channel.external is off: set it to connect a network simulator")


def check_receptions(
    receptions: NDArray[np.void], sent: Exchange, latency_ticks: int, num_packets: NDArray[np.int64]
) -> NDArray[np.void]:
    """Check the receptions that a network simulator returns.

    `receptions`: the answer to `sent`. `latency_ticks`: the longest delay. `num_packets`:
    (latency_ticks + 1,) number of packets in flight, by tick modulo latency_ticks + 1.

    Returns:
        The receptions sorted by receiver, tick and packet, so that their order does not matter.

    Raises:
        MessageError: the dtype is wrong, a packet or receiver is unknown, or a delay is too long or
            negative.
    """
    if not isinstance(receptions, np.ndarray) or receptions.dtype != RECEPTION:
        raise MessageError("a network simulator must return an array of dtype RECEPTION")
    delay = sent.tick - receptions["tick"]
    if ((delay < 0) | (delay > latency_ticks) | (receptions["tick"] < 1)).any():
        raise MessageError(
            f"tick {sent.tick}: a reception has a tick outside "
            f"{max(1, sent.tick - latency_ticks)} to {sent.tick}; v2x.channel.latency_ticks is the "
            "longest delay"
        )
    number, count = receptions["packet"], num_packets[receptions["tick"] % (latency_ticks + 1)]
    if ((number < 0) | (number >= count)).any():
        raise MessageError(f"tick {sent.tick}: a reception of a packet that was not sent")
    receiver = receptions["receiver"]
    if ((receiver < 0) | (receiver >= len(sent.receivers))).any():
        raise MessageError(f"tick {sent.tick}: a reception by an unknown receiver")
    there = sent.receivers["id"][receiver] >= 0
    return np.sort(receptions[there], order=("receiver", "tick", "packet"))


def make_units(config: RoadsideConfig, network: RoadNetwork) -> NDArray[np.void]:
    """Return UNIT (n,): a unit at the centre of the stop lines of each equipped signal.

    `config`: the equipped signals.

    Raises ConfigError: no signal has that name.
    """
    known = network.signal_ids
    names = known if config.signals == (EVERY_SIGNAL,) else config.signals
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            meant = f"did you mean '{close[0]}'? " if close else ""
            listed = ", ".join(known[:8]) + (", …" if len(known) > 8 else "")
            raise ConfigError(
                f"v2x.roadside.signals: no signal '{name}' on the map '{network.name}'; {meant}"
                f"The map has: {listed or 'none'}"
            )
    units = np.zeros(len(names), UNIT)
    for unit, name in zip(units, names, strict=True):
        signal = known.index(name)
        unit["signal"] = signal
        unit["x"], unit["y"], unit["z"] = place_of_signal(network, signal)
    return units


def map_of(network: RoadNetwork, units: NDArray[np.void], unit: int) -> NDArray[np.void]:
    """Return MAP (n,): the approaches to a roadside unit's signal, which never change."""
    signal = int(units[unit]["signal"])
    rows = links_of_signal(network, signal)
    ends = stop_lines(network, signal)
    found = np.zeros(len(rows), MAP)
    found["sender"] = FIRST_ROADSIDE_ID + unit
    found["signal"] = signal
    found["link"] = rows
    found["letter"] = network.links["signal_index"][rows]
    for name in ("x", "y", "heading"):
        found[name] = ends[name]
    found["speed_limit"] = network.lanes["speed_mps"][network.links["from_lane"][rows]]
    return found
