"""Records of messages, and the working memory of a message bus.

A packet is one transmission of a station. It carries reports: a CAM carries a report on its sender,
and a CPM a report on each perceived vehicle. `v2x/v2x_messages.py` is the external schema. Records
that outlive a tick have no padding, because the hash of the state covers all their bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid
from cavmarl.core.records import record

# Values of PACKET["kind"], in the order in which a station sends them.
KIND_CAM = 0
KIND_DENM = 1
KIND_CPM = 2
KIND_SPAT = 3
NUM_KINDS = 4

# Values of REPORT["code"] of an event: ETSI cause codes (EN 302 637-3, table 10).
CAUSE_NONE = 0
CAUSE_COLLISION = 2
CAUSE_ROAD_CLOSED = 5
CAUSE_OBSTACLE = 10
CAUSE_STATIONARY = 94
CAUSE_HARD_BRAKING = 99

# Roadside unit k is station FIRST_ROADSIDE_ID + k; vehicles have smaller ids.
FIRST_ROADSIDE_ID = 1 << 46

# REPORT["subject"] of a closed road is FIRST_CLOSED_ROAD + EDGE row.
FIRST_CLOSED_ROAD = 1 << 47

# Indices of Mail.counts; counts are since the reset.
COUNT_SENT = 0  # packets sent: four numbers, by kind
COUNT_OVERFLOW = 4  # packets beyond the capacity
COUNT_NO_ACCESS = 5  # packets that never got channel access
COUNT_REACHABLE = 6  # receivers within reach, summed over packets
COUNT_RECEIVED = 7  # receivers that received the packet, summed over packets
NUM_COUNTS = 8
MAX_DELAYS = 65  # number of delay bins, in ticks
NUM_BANDS = 40  # number of distance bands for receptions; the last band has no upper bound
BAND_M = 25.0
BANDS_PER_M = 1.0 / BAND_M
MAX_NEAR = 64  # number of nearest bodies that a station examines

REPORT = record(
    (
        "subject",
        np.int64,
    ),  # subject: a vehicle, or a SIGNAL row; for an event, its sender or a closed road
    ("sender", np.int64),  # station; -1: no report
    ("tick", np.int64),  # tick of the reported state
    ("expires", np.int64),  # last tick in which a receiver keeps the report
    ("kind", np.int32),  # KIND_*
    ("code", np.int32),  # vehicle class, cause of an event, or PHASE row (see `shown_states`)
    ("x", np.float64),  # m, world frame
    ("y", np.float64),
    ("z", np.float64),
    ("heading", np.float64),  # rad, counter-clockwise from east
    ("speed", np.float64),  # m/s along the heading
    ("accel", np.float64),  # m/s²
    ("yaw_rate", np.float64),  # rad/s
    ("length", np.float64),  # m
    ("width", np.float64),  # m
    ("left_s", np.float64),  # earliest remaining time of a signal's phase, s
)

PACKET = record(
    ("sender", np.int64),
    ("tick", np.int64),  # tick of sending
    ("x", np.float64),  # m, position of the sender
    ("y", np.float64),
    ("word", np.uint64),  # part of the random number of a reception, see `packet_word`
    ("kind", np.int32),
    ("first", np.int32),  # index of the packet's first report
    ("count", np.int64),
)

# A station that can send or receive in this tick.
STATION = record(
    ("id", np.int64),
    ("zone", np.int32),  # zone that holds the station's row
    ("row", np.int32),
)

LAST_CAM = record(
    ("id", np.int64),
    ("tick", np.int64),
    ("x", np.float64),
    ("y", np.float64),
    ("heading", np.float64),
    ("speed", np.float64),
)

# A roadside unit.
UNIT = record(
    ("signal", np.int32),  # SIGNAL row
    ("x", np.float64),  # m
    ("y", np.float64),
    ("z", np.float64),
)

# A receiver and its position.
RECEIVER = record(
    ("id", np.int64),  # -1: none
    ("x", np.float64),
    ("y", np.float64),
    ("word", np.uint64),  # part of the random number of a reception, see `receiver_word`
)


class Sending(NamedTuple):
    """The sending schedule of stations; periods are in ticks, 0: never."""

    dt_s: float
    equipped: float  # share of the background vehicles that can send
    cam_period: int
    cam_triggered: bool  # whether a due CAM is sent only if ETSI's conditions are met
    denm_period: int
    hard_braking_mps2: float
    stationary_s: float
    denm_ticks: int  # lifetime of an event
    cpm_period: int
    cpm_range_m: float
    cpm_objects: int
    spat_period: int
    unit_cpm_period: int
    unit_range_m: float
    memory_ticks: int  # lifetime of all other reports
    latency: int  # ticks between sending and receiving
    decide: int  # ticks between decisions about the green phases of signals


class Mail(NamedTuple):
    """State that outlives a tick, of W worlds with R receivers: agents, then roadside units.

    L is the latency in ticks. Packets of tick t are in slot t modulo L + 1, with room for P packets
    and Q reports. A receiver has room for N vehicles, E events and G signals; U is the number of
    roadside units.
    """

    objects: NDArray[np.void]  # REPORT (W, R, N) vehicles, nearest first
    events: NDArray[np.void]  # REPORT (W, R, E)
    signals: NDArray[np.void]  # REPORT (W, R, G)
    owner: NDArray[np.int64]  # (W, R) id of the inboxes' owner; -1: unused
    declared: NDArray[np.int32]  # (W, R) cause of an event to send in the next tick
    # (W, U, 5) x, y, z, heading and EDGE row + 1 of the closed road that a unit declares; 0: none
    closures: NDArray[np.float64]
    packets: NDArray[np.void]  # PACKET (W, L + 1, P) by sender, then kind
    num_packets: NDArray[np.int64]  # (W, L + 1)
    reports: NDArray[np.void]  # REPORT (W, L + 1, Q)
    num_reports: NDArray[np.int64]  # (W, L + 1)
    last_cams: NDArray[np.void]  # LAST_CAM (W, C) by id
    num_last: NDArray[np.int64]  # (W,)
    counts: NDArray[np.int64]  # (W, NUM_COUNTS)
    delays: NDArray[np.int64]  # (W, MAX_DELAYS) receptions by delay in ticks
    bands: NDArray[np.int64]  # (W, NUM_BANDS, 2) reachable and received, by distance
    busy: NDArray[np.float64]  # (W, 3) channel busy ratio: sum, number, maximum


class Air(NamedTuple):
    """Packets of one tick, sorted by position."""

    cells: Grid  # bodies are not used
    x: NDArray[np.float64]  # (P,) m, in the order of the cells
    y: NDArray[np.float64]
    sender: NDArray[np.int64]
    word: NDArray[np.uint64]  # see PACKET
    which: NDArray[np.int32]  # index of the packet


class HeardCams(NamedTuple):
    """CAMs that one receiver could receive, in order of discovery."""

    place: NDArray[np.int32]  # (P + 1,) index in `V2xScratch.cams`
    squared: NDArray[np.float64]  # squared distance, m²
    word: NDArray[np.uint64]  # see PACKET
    distance: NDArray[np.float64]  # m
    number: NDArray[np.float64]  # random number of the reception, see `draw`


class V2xScratch(NamedTuple):
    """Working memory of a tick; its content is lost between ticks."""

    stations: NDArray[np.void]  # STATION (C,)
    spare: NDArray[np.void]  # STATION (C,)
    receivers: NDArray[np.void]  # RECEIVER (R,)
    bodies: Grid  # grid of vehicles in id order
    vehicles: NDArray[np.void]  # VEHICLE (C,) in id order
    next_cams: NDArray[np.void]  # LAST_CAM (C,)
    near: NDArray[np.int32]  # (MAX_NEAR,) bodies around a station, nearest first
    near_squared: NDArray[np.float64]
    seen: NDArray[np.int32]  # (MAX_NEAR,) vehicles that the station sees, as rows of `vehicles`
    cams: Air  # CAMs
    others: Air  # all other packets
    kinds: NDArray[np.int64]  # (NUM_KINDS,) number of packets received in this tick
    access: NDArray[np.bool_]  # (P,) whether a packet has channel access
    cam_of: NDArray[np.int32]  # (a power of 2,) hash table: the CAM of a sender, or -1
    heard: HeardCams
    tally: NDArray[np.int64]  # (2 NUM_BANDS,) packets lost and received by distance band
    squared: NDArray[np.float64]  # (largest inbox,)
