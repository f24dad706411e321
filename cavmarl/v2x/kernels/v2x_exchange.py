"""One tick of a bus of messages: stations send, packets travel, receivers keep what they hear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import fill_grid
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Common, RoadArrays, Zoned
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.v2x.kernels.v2x_channel import Channel, receiver_word
from cavmarl.v2x.kernels.v2x_inbox import empty
from cavmarl.v2x.kernels.v2x_receiving import age, deliver, learn
from cavmarl.v2x.kernels.v2x_records import FIRST_ROADSIDE_ID, Mail, Sending, V2xScratch
from cavmarl.v2x.kernels.v2x_sending import gather, send_from_units, send_from_vehicles


@kernel
def _place_receivers(
    zoned: Zoned,
    side: int,
    w: int,
    num: int,
    key: np.uint64,
    units: NDArray[np.void],
    mail: Mail,
    room: V2xScratch,
) -> None:
    """Note where the agents and the roadside units are; new ones have empty inboxes."""
    receivers = room.receivers
    num_agents = receivers.size - units.size
    for r in range(num_agents):
        receivers[r]["id"] = -1
    for k in range(num):
        station = room.stations[k]
        row = zoned.rows[side, station["zone"], w, station["row"]]
        if row["driver"] == DRIVER_AGENT:
            me = receivers[row["agent"]]
            me["id"] = row["id"]
            me["x"] = row["x"]
            me["y"] = row["y"]
    for k in range(units.size):
        me = receivers[num_agents + k]
        me["id"] = FIRST_ROADSIDE_ID + k
        me["x"] = units[k]["x"]
        me["y"] = units[k]["y"]
    for r in range(receivers.size):
        me = receivers[r]
        if me["id"] >= 0:
            me["word"] = receiver_word(key, me["id"])
        if mail.owner[w, r] != me["id"]:
            mail.owner[w, r] = me["id"]
            empty(mail.objects[w, r], 0)
            empty(mail.events[w, r], 0)
            empty(mail.signals[w, r], 0)


@kernel
def exchange_messages(
    sending: Sending,
    channel: Channel,
    roads: RoadArrays,
    types: NDArray[np.void],
    units: NDArray[np.void],
    common: Common,
    zoned: Zoned,
    side: int,
    first: int,
    last: int,
    mail: Mail,
    room: V2xScratch,
) -> None:
    """Send what is due in the present tick of some worlds, and receive what arrives in it.

    Args:
        sending: when stations send what.
        channel: the air.
        roads: the road arrays.
        types: VTYPE (num_types,).
        units: UNIT (num_units,), the roadside units.
        common: clocks, keys and signals of the worlds.
        zoned: the vehicles of all zones.
        side: on which of their sides the committed rows are.
        first: of the worlds.
        last: the one after the last.
        mail: what outlives the tick; written.
        room: to work in.
    """
    for w in range(first, last):
        tick = common.ticks[w]
        key = common.keys[w]
        num = gather(zoned, side, w, room.stations, room.spare)
        if sending.cpm_period > 0 or sending.unit_cpm_period > 0:
            for k in range(num):
                station = room.stations[k]
                room.everybody[k] = zoned.rows[side, station["zone"], w, station["row"]]
            fill_grid(room.everybody, num, room.bodies)
        slots = sending.latency + 1
        slot = tick % slots
        mail.num_packets[w, slot] = 0
        mail.num_reports[w, slot] = 0
        send_from_vehicles(
            sending, mail, w, slot, zoned, side, num, key, tick, types, channel.walls, room
        )
        send_from_units(sending, mail, w, slot, roads, common, units, types, channel.walls, room)
        mail.declared[w] = 0
        _place_receivers(zoned, side, w, num, key, units, mail, room)
        if not channel.external:
            arriving = (tick - sending.latency) % slots
            deliver(channel, mail, w, arriving, key, tick, sending.latency, room)


@kernel
def hand_out(
    receptions: NDArray[np.void],
    tick: int,
    latency: int,
    mail: Mail,
    w: int,
    room: V2xScratch,
) -> None:
    """Let receivers have what a network simulator says that they receive in this tick.

    `receptions`: RECEPTION (n,), of packets that are in flight, by receivers that are there.
    `latency`: the longest delay, in ticks. `mail`: inboxes and counts are written. `room`:
    `receivers` as `exchange_messages` has left them.
    """
    for r in range(room.receivers.size):
        if room.receivers[r]["id"] >= 0:
            age(mail, w, r, tick, room)
    for k in range(receptions.size):
        sent = receptions[k]["tick"]
        slot = sent % (latency + 1)
        learn(mail, w, slot, receptions[k]["packet"], receptions[k]["receiver"], tick - sent, room)
