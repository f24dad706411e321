"""The schema of messages: fixed records, little-endian, with a version.

They are like those of the standards, and simpler: metres and radians in the world's frame instead
of degrees and tenths, ticks instead of milliseconds, no encoding rules, no certificates.

| message | after | one of them is |
|---|---|---|
| `CAM` | ETSI EN 302 637-2, cooperative awareness | a vehicle about itself |
| `DENM` | ETSI EN 302 637-3, decentralized notification | an event |
| `CPM_OBJECT` | ETSI TS 103 324, collective perception | a vehicle that the sender sees |
| `SPAT` | SAE J2735, signal phase and timing | what a signal shows |
| `MAP` | SAE J2735, map data | one approach to a signal |

All positions are those of a body's centre, x east, y north, z up; headings are counter-clockwise
from east. Ticks are those of the world; a station is a vehicle by its id, or roadside unit k by
`FIRST_ROADSIDE_ID` + k.

Roadside units stand at signals, and send maps of them.

A simulator of the network (ns-3, OMNeT++ or any other) that runs beside the world implements
`NetworkSimulator.exchange`. It is called once a tick and world, with what is sent in that tick, and
returns when it has simulated up to that tick: the call is the barrier of a step. Neither side runs
ahead.
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
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_COLLISION,
    CAUSE_HARD_BRAKING,
    CAUSE_OBSTACLE,
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
        ("count", "<u4"),  # records that follow: 1, of a CPM as many as it tells of
        ("sender", "<i8"),  # station
        ("tick", "<i8"),  # when it was sent
        ("x", "<f8"),  # m, where the sender was
        ("y", "<f8"),  # m
    ]
)

_KINEMATICS = [
    ("x", "<f8"),  # m
    ("y", "<f8"),  # m
    ("z", "<f8"),  # m
    ("heading", "<f8"),  # rad
    ("speed", "<f8"),  # m/s, negative backwards
    ("accel", "<f8"),  # m/s²
    ("yaw_rate", "<f8"),  # rad/s
    ("length", "<f8"),  # m
    ("width", "<f8"),  # m
]

CAM = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("vclass", "<i4"),  # position in roads.network.VEHICLE_CLASSES
        *_KINEMATICS,
    ]
)

CPM_OBJECT = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("object", "<i8"),  # the vehicle that is seen
        ("vclass", "<i4"),
        *_KINEMATICS,
    ]
)

DENM = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),  # when it was so
        ("expires", "<i8"),  # the last tick in which it is to be believed
        ("cause", "<i4"),  # ETSI's cause code: 2, 10, 94, 99
        ("x", "<f8"),  # m, of the event
        ("y", "<f8"),
        ("z", "<f8"),
        ("heading", "<f8"),  # rad, of the traffic that it concerns
        ("speed", "<f8"),  # m/s, of the vehicle
    ]
)

SPAT = np.dtype(
    [
        ("sender", "<i8"),
        ("tick", "<i8"),
        ("signal", "<i4"),  # SIGNAL row
        ("phase", "<i4"),  # PHASE row that is on: the letters of all of its links
        ("left_s", "<f8"),  # s until it ends, at the soonest
    ]
)

MAP = np.dtype(
    [
        ("sender", "<i8"),
        ("signal", "<i4"),  # SIGNAL row
        ("link", "<i4"),  # LINK row: one movement
        ("letter", "<i4"),  # which letter of the signal's phases is its
        ("x", "<f8"),  # m, of its stop line
        ("y", "<f8"),
        ("heading", "<f8"),  # rad, in which one drives there
        ("speed_limit", "<f8"),  # m/s
    ]
)

KINDS: dict[int, np.dtype[Any]] = {
    KIND_CAM: CAM,
    KIND_DENM: DENM,
    KIND_CPM: CPM_OBJECT,
    KIND_SPAT: SPAT,
}

# What an event can be, with ETSI's cause codes.
CAUSES = {
    "collision": CAUSE_COLLISION,
    "obstacle": CAUSE_OBSTACLE,
    "stationary": CAUSE_STATIONARY,
    "hard_braking": CAUSE_HARD_BRAKING,
}

# Where a record's field stands in the bus's own REPORT, if it has another name there.
_OWN_NAMES = {
    "vclass": "code",
    "cause": "code",
    "phase": "code",
    "object": "subject",
    "signal": "subject",
}


def cause_code(cause: str) -> int:
    """ETSI's code of a cause.

    Raises ConfigError: no cause of that name.
    """
    if cause not in CAUSES:
        raise ConfigError(f"cause = {cause!r}: there are {', '.join(CAUSES)}")
    return CAUSES[cause]


def messages_of(kind: int, reports: NDArray[np.void]) -> NDArray[np.void]:
    """Reports of the bus as records of the schema.

    `reports`: REPORT (n,) of that kind; places where none is (sender -1) are left out.

    Returns CAM, DENM, CPM_OBJECT or SPAT (n,).
    """
    there = reports[(reports["sender"] >= 0) & (reports["kind"] == kind)]
    found = np.zeros(len(there), KINDS[kind])
    for name in KINDS[kind].names or ():
        found[name] = there[_OWN_NAMES.get(name, name)]
    return found


def encode(packet: np.void, reports: NDArray[np.void]) -> bytes:
    """A packet as it goes over a wire: the header, then its records.

    `reports`: REPORT (Q,) of its tick.
    """
    kind, first, count = int(packet["kind"]), int(packet["first"]), int(packet["count"])
    header = np.zeros((), HEADER)
    header["version"], header["kind"], header["count"] = SCHEMA_VERSION, kind, count
    for name in ("sender", "tick", "x", "y"):
        header[name] = packet[name]
    return header.tobytes() + messages_of(kind, reports[first : first + count]).tobytes()


def decode(data: bytes) -> tuple[np.void, NDArray[np.void]]:
    """Header and records of a packet.

    Raises MessageError: of another version, of an unknown kind, or of the wrong length.
    """
    if len(data) < HEADER.itemsize:
        raise MessageError(f"{len(data)} bytes are no message: a header has {HEADER.itemsize}")
    header = np.frombuffer(data, HEADER, 1)[0]
    if header["version"] != SCHEMA_VERSION:
        raise MessageError(
            f"message of version {header['version']}: version {SCHEMA_VERSION} is read here"
        )
    kind, count = int(header["kind"]), int(header["count"])
    if kind not in KINDS:
        raise MessageError(f"message of kind {kind}: there are {', '.join(map(str, KINDS))}")
    size = HEADER.itemsize + count * KINDS[kind].itemsize
    if len(data) != size:
        raise MessageError(f"message of {len(data)} bytes: with {count} records it has {size}")
    return header, np.frombuffer(data, KINDS[kind], count, HEADER.itemsize)


# One receiver receives one packet in the tick of the call.
RECEPTION = record(
    ("tick", np.int64),  # in which the packet was sent
    ("packet", np.int64),  # its number among the packets of that tick
    ("receiver", np.int64),  # row of `Exchange.receivers`
)


class Exchange(NamedTuple):
    """What a network simulator is told of one tick of one world; views, not to be kept."""

    world: int
    tick: int  # of that world; it begins at 1 after a reset
    packets: NDArray[np.void]  # PACKET (n,) that are sent now, by sender, then kind
    # RECEIVER (R,), where the agents and the roadside units are; id -1: none
    receivers: NDArray[np.void]


class NetworkSimulator(Protocol):
    """Decides which stations receive which packets in which tick."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        """Simulate up to this tick.

        A tick that is begun again, because a host has died, is asked for again with the same
        packets, and must be answered alike.

        Returns RECEPTION (n,): what is received now, of this tick's packets or of earlier ones.
        """
        ...


def check_external(v2x: V2xConfig) -> None:
    """Refuse to connect a network simulator where none is asked."""
    if not (v2x.enabled and v2x.channel.external):
        raise ConfigError("the channel is our own: set v2x.channel.external to connect another")


def check_receptions(
    receptions: NDArray[np.void], sent: Exchange, latency_ticks: int, num_packets: NDArray[np.int64]
) -> NDArray[np.void]:
    """Refuse receptions that cannot be.

    `receptions`: the answer to `sent`. `latency_ticks`: the longest delay. `num_packets`:
    (latency_ticks + 1,) packets in flight, by tick modulo that.

    Returns:
        them by receiver, tick and packet, so that the order of the answer does not matter.

    Raises:
        MessageError: another dtype, packets or receivers that are not there, or a delay that is too
            long or negative.
    """
    if not isinstance(receptions, np.ndarray) or receptions.dtype != RECEPTION:
        raise MessageError("a network simulator answers with an array of dtype RECEPTION")
    delay = sent.tick - receptions["tick"]
    if ((delay < 0) | (delay > latency_ticks) | (receptions["tick"] < 1)).any():
        raise MessageError(
            f"tick {sent.tick}: a reception of another tick than those from "
            f"{max(1, sent.tick - latency_ticks)} to {sent.tick}; v2x.channel.latency_ticks is the "
            "longest delay"
        )
    number, count = receptions["packet"], num_packets[receptions["tick"] % (latency_ticks + 1)]
    if ((number < 0) | (number >= count)).any():
        raise MessageError(f"tick {sent.tick}: a reception of a packet that was not sent")
    receiver = receptions["receiver"]
    if ((receiver < 0) | (receiver >= len(sent.receivers))).any():
        raise MessageError(f"tick {sent.tick}: a reception by no station")
    there = sent.receivers["id"][receiver] >= 0
    return np.sort(receptions[there], order=("receiver", "tick", "packet"))


def make_units(config: RoadsideConfig, network: RoadNetwork) -> NDArray[np.void]:
    """UNIT (n,): one at each signal that has one, in the middle of its stop lines.

    `config`: which signals.

    Raises ConfigError: no signal of that name.
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
                f"There are: {listed or 'none'}"
            )
    units = np.zeros(len(names), UNIT)
    for unit, name in zip(units, names, strict=True):
        signal = known.index(name)
        ends = _stop_lines(network, signal)
        unit["signal"] = signal
        if len(ends):
            unit["x"], unit["y"], unit["z"] = (ends[axis].mean() for axis in ("x", "y", "z"))
    return units


def _links(network: RoadNetwork, signal: int) -> NDArray[np.intp]:
    return np.flatnonzero(network.links["signal"] == signal)


def _stop_lines(network: RoadNetwork, signal: int) -> NDArray[np.void]:
    """POINT of the end of the lane before each link of a signal."""
    lanes = network.lanes[network.links["from_lane"][_links(network, signal)]]
    ends: NDArray[np.void] = network.points[lanes["first_point"] + lanes["num_points"] - 1]
    return ends


def map_of(network: RoadNetwork, units: NDArray[np.void], unit: int) -> NDArray[np.void]:
    """MAP (n,): the approaches that a roadside unit's phases are about; they never change."""
    signal = int(units[unit]["signal"])
    rows = _links(network, signal)
    ends = _stop_lines(network, signal)
    found = np.zeros(len(rows), MAP)
    found["sender"] = FIRST_ROADSIDE_ID + unit
    found["signal"] = signal
    found["link"] = rows
    found["letter"] = network.links["signal_index"][rows]
    for name in ("x", "y", "heading"):
        found[name] = ends[name]
    found["speed_limit"] = network.lanes["speed_mps"][network.links["from_lane"][rows]]
    return found
