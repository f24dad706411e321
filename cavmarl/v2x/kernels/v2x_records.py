"""What goes over the air, as records, and what a bus of messages works on.

A packet is what one station sends at once; it carries reports, one of its sender in a CAM, one of
each vehicle that it sees in a CPM. `v2x/v2x_messages.py` is the schema that others see. Records
that outlive a tick have no bytes between their fields: the state's hash is over all of their bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid
from cavmarl.core.records import record

# PACKET["kind"], in the order in which one station sends them.
KIND_CAM = 0
KIND_DENM = 1
KIND_CPM = 2
KIND_SPAT = 3
NUM_KINDS = 4

# REPORT["code"] of an event: ETSI's cause codes (EN 302 637-3, table 10).
CAUSE_NONE = 0
CAUSE_COLLISION = 2
CAUSE_OBSTACLE = 10
CAUSE_STATIONARY = 94
CAUSE_HARD_BRAKING = 99

# Roadside unit k is station FIRST_ROADSIDE_ID + k; vehicles have smaller ids.
FIRST_ROADSIDE_ID = 1 << 46

# Mail.counts, since reset
COUNT_SENT = 0  # four numbers, by kind
COUNT_OVERFLOW = 4  # packets for which there was no room
COUNT_NO_ACCESS = 5  # packets that never found the air free
COUNT_REACHABLE = 6  # receivers within reach, over all packets
COUNT_RECEIVED = 7  # those that received
NUM_COUNTS = 8
MAX_DELAYS = 65  # ticks of delay that are told apart
NUM_BANDS = 40  # bands of distance that receptions are counted by; the last one has no end
BAND_M = 25.0
BANDS_PER_M = 1.0 / BAND_M
MAX_NEAR = 64  # bodies that a station looks at, the nearest ones

REPORT = record(
    ("subject", np.int64),  # of the report: vehicle, SIGNAL row; of an event its sender
    ("sender", np.int64),  # station; -1 where no report is
    ("tick", np.int64),  # when it was so
    ("expires", np.int64),  # the last tick for which a receiver keeps it
    ("kind", np.int32),  # KIND_*
    ("code", np.int32),  # of a vehicle its class, of an event the cause, of a signal PHASE row
    ("x", np.float64),  # m, world frame
    ("y", np.float64),
    ("z", np.float64),
    ("heading", np.float64),  # rad, counter-clockwise from east
    ("speed", np.float64),  # m/s along the heading
    ("accel", np.float64),  # m/s²
    ("yaw_rate", np.float64),  # rad/s
    ("length", np.float64),  # m
    ("width", np.float64),  # m
    ("left_s", np.float64),  # s until the phase of a signal ends, at the soonest
)

PACKET = record(
    ("sender", np.int64),
    ("tick", np.int64),  # when it was sent
    ("x", np.float64),  # m, where the sender was
    ("y", np.float64),
    ("word", np.uint64),  # of its random numbers
    ("kind", np.int32),
    ("first", np.int32),  # its reports
    ("count", np.int64),
)

# Stations that can send or receive in this tick.
STATION = record(
    ("id", np.int64),
    ("zone", np.int32),  # where its row lies
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

# Where a receiver is.
RECEIVER = record(
    ("id", np.int64),  # -1: there is none
    ("x", np.float64),
    ("y", np.float64),
    ("word", np.uint64),  # of its random numbers
)


class Sending(NamedTuple):
    """When stations send what; periods in ticks, 0: never."""

    dt_s: float
    equipped: float
    cam_period: int
    cam_triggered: bool
    denm_period: int
    hard_braking_mps2: float
    stationary_s: float
    denm_ticks: int  # for which an event is kept
    cpm_period: int
    cpm_range_m: float
    cpm_objects: int
    spat_period: int
    unit_cpm_period: int
    unit_range_m: float
    memory_ticks: int  # for which all else is kept
    latency: int  # ticks between sending and receiving


class Mail(NamedTuple):
    """What outlives a tick, of W worlds with R receivers: the agents, then the roadside units.

    Packets in flight lie in L + 1 slots, those of tick t in slot t modulo L + 1.
    """

    objects: NDArray[np.void]  # REPORT (W, R, N) nearest first
    events: NDArray[np.void]  # REPORT (W, R, E)
    signals: NDArray[np.void]  # REPORT (W, R, G)
    owner: NDArray[np.int64]  # (W, R) whose inboxes these are; -1: unused
    declared: NDArray[np.int32]  # (W, R) cause of an event to be sent in the next tick
    packets: NDArray[np.void]  # PACKET (W, L + 1, P) by sender, then kind
    num_packets: NDArray[np.int64]  # (W, L + 1)
    reports: NDArray[np.void]  # REPORT (W, L + 1, Q)
    num_reports: NDArray[np.int64]  # (W, L + 1)
    last_cams: NDArray[np.void]  # LAST_CAM (W, C) by id
    num_last: NDArray[np.int64]  # (W,)
    counts: NDArray[np.int64]  # (W, NUM_COUNTS)
    delays: NDArray[np.int64]  # (W, MAX_DELAYS) receptions by ticks of delay
    bands: NDArray[np.int64]  # (W, NUM_BANDS, 2) reachable and received, by distance
    busy: NDArray[np.float64]  # (W, 3) share of time that the air was busy: sum, number, maximum


class Air(NamedTuple):
    """Packets of one tick by place."""

    cells: Grid  # of which the bodies are not used
    x: NDArray[np.float64]  # (P,) in the order of the cells
    y: NDArray[np.float64]
    sender: NDArray[np.int64]
    word: NDArray[np.uint64]  # see PACKET
    which: NDArray[np.int32]  # the packet


class HeardCams(NamedTuple):
    """CAMs that one receiver could receive, in the order in which they are found."""

    place: NDArray[np.int32]  # (P + 1,) in `V2xScratch.cams`
    squared: NDArray[np.float64]  # squared distance, m²
    word: NDArray[np.uint64]  # see PACKET
    distance: NDArray[np.float64]  # m
    number: NDArray[np.float64]  # of the reception, see `draw`


class V2xScratch(NamedTuple):
    """What a tick works in; holds nothing between ticks."""

    stations: NDArray[np.void]  # STATION (C,)
    spare: NDArray[np.void]  # STATION (C,)
    receivers: NDArray[np.void]  # RECEIVER (R,)
    bodies: Grid  # of the vehicles in id order
    everybody: NDArray[np.void]  # VEHICLE (C,) in id order
    next_cams: NDArray[np.void]  # LAST_CAM (C,)
    near: NDArray[np.int32]  # (MAX_NEAR,) bodies around a station, nearest first
    near_squared: NDArray[np.float64]
    seen: NDArray[np.int32]  # (MAX_NEAR,) those of them that it sees, as rows of `everybody`
    cams: Air  # what vehicles tell of themselves
    others: Air  # all else
    kinds: NDArray[np.int64]  # (NUM_KINDS,) packets that are received now
    access: NDArray[np.bool_]  # (P,) whether a packet gets on the air
    cam_of: NDArray[np.int32]  # (a power of 2,) the CAM of a sender, or -1; a hash table
    heard: HeardCams
    tally: NDArray[np.int64]  # (2 NUM_BANDS,) packets lost and received by bands of distance
    squared: NDArray[np.float64]  # (largest inbox,)
