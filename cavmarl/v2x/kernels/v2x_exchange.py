"""One tick of a message bus: stations send, packets travel, receivers store what they receive.

The content of an inbox does not depend on the order of packets: first, known subjects get their
newest reports; then, the nearest new subjects are added.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.neighbors import cell_columns, cell_rows, fill_grid
from cavmarl.core.records.arrays import RoadArrays, SharedState, ZoneState
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.v2x.kernels.v2x_air import (
    add_cams,
    band_of,
    grant_access,
    hears,
    list_cams,
    load_around,
    refresh_by_cams,
)
from cavmarl.v2x.kernels.v2x_channel import Channel, busy_level, receiver_word
from cavmarl.v2x.kernels.v2x_inbox import empty, find, forget, insert, is_better, sort_by_distance
from cavmarl.v2x.kernels.v2x_records import (
    COUNT_REACHABLE,
    COUNT_RECEIVED,
    FIRST_ROADSIDE_ID,
    KIND_CAM,
    KIND_CPM,
    KIND_DENM,
    KIND_SPAT,
    NUM_BANDS,
    Mail,
    Sending,
    V2xScratch,
)
from cavmarl.v2x.kernels.v2x_sending import gather, send_from_units, send_from_vehicles


@kernel
def _take_others(
    channel: Channel,
    mail: Mail,
    w: int,
    me: np.void,
    level: int,
    packets: NDArray[np.void],
    reports: NDArray[np.void],
    scratch: V2xScratch,
    kind: int,
    box: NDArray[np.void],
    num: int,
    new: bool,
) -> int:
    """Store the reports of packets of one kind, for known or for new subjects."""
    air = scratch.others
    cells = air.cells
    limit = channel.reach_m * channel.reach_m
    first_column, last_column = cell_columns(cells, me["x"], channel.reach_m)
    first_row, last_row = cell_rows(cells, me["y"], channel.reach_m)
    for j in range(first_row, last_row + 1):
        begin = cells.start[j * cells.num_x + first_column]
        end = cells.start[j * cells.num_x + last_column + 1]
        for b in range(begin, end):
            dx = air.x[b] - me["x"]
            dy = air.y[b] - me["y"]
            squared = dx * dx + dy * dy
            if not squared <= limit or air.sender[b] == me["id"]:
                continue
            packet = packets[air.which[b]]
            if packet["kind"] != kind:
                continue
            is_received = hears(channel, me, level, air.word[b], air.x[b], air.y[b], squared)
            if new:
                mail.counts[w, COUNT_REACHABLE] += 1
                mail.counts[w, COUNT_RECEIVED] += is_received
                if not channel.sure:
                    scratch.tally[2 * band_of(math.sqrt(squared)) + is_received] += 1
            if not is_received:
                continue
            for k in range(packet["first"], packet["first"] + packet["count"]):
                report = reports[k]
                # The subject of a SPAT is a signal, not a vehicle.
                if kind != KIND_SPAT and report["subject"] == me["id"]:
                    continue
                place = find(box, num, report["subject"])
                if place < 0 and new:
                    num = insert(box, num, scratch.squared, report, me["x"], me["y"])
                elif place >= 0 and is_better(report, box[place]):
                    box[place] = report
    return num


@inlined_kernel
def _receive_objects(
    channel: Channel,
    mail: Mail,
    w: int,
    slot: int,
    me: np.void,
    level: int,
    with_seen: bool,
    scratch: V2xScratch,
    box: NDArray[np.void],
    num: int,
) -> int:
    """Receive reports about vehicles, from these vehicles or from stations that see them."""
    packets = mail.packets[w, slot]
    reports = mail.reports[w, slot]
    refresh_by_cams(channel, me, level, packets, reports, scratch, box, num)
    if with_seen:
        _take_others(
            channel, mail, w, me, level, packets, reports, scratch, KIND_CPM, box, num, False
        )
    sort_by_distance(box, num, scratch.squared, me["x"], me["y"])
    num = add_cams(channel, mail, w, me, level, packets, reports, scratch, box, num)
    if with_seen:
        num = _take_others(
            channel, mail, w, me, level, packets, reports, scratch, KIND_CPM, box, num, True
        )
    return num


@kernel
def _receive_others(
    channel: Channel,
    mail: Mail,
    w: int,
    slot: int,
    me: np.void,
    level: int,
    kind: int,
    scratch: V2xScratch,
    box: NDArray[np.void],
    num: int,
) -> int:
    """Receive reports of events, or of signals."""
    packets = mail.packets[w, slot]
    reports = mail.reports[w, slot]
    _take_others(channel, mail, w, me, level, packets, reports, scratch, kind, box, num, False)
    sort_by_distance(box, num, scratch.squared, me["x"], me["y"])
    return _take_others(
        channel, mail, w, me, level, packets, reports, scratch, kind, box, num, True
    )


@inlined_kernel
def _receive(
    channel: Channel,
    mail: Mail,
    w: int,
    slot: int,
    r: int,
    tick: int,
    kinds: NDArray[np.int64],
    scratch: V2xScratch,
) -> None:
    me = scratch.receivers[r]
    level = 0
    if channel.load > 0.0:
        busy = min(load_around(channel, scratch, me["x"], me["y"]), 1.0)
        mail.busy[w, 0] += busy
        mail.busy[w, 1] += 1.0
        mail.busy[w, 2] = max(mail.busy[w, 2], busy)
        level = busy_level(channel, busy)
    objects = mail.objects[w, r]
    num = forget(objects, tick)
    with_seen = kinds[KIND_CPM] > 0
    num = _receive_objects(channel, mail, w, slot, me, level, with_seen, scratch, objects, num)
    empty(objects, num)
    events = mail.events[w, r]
    num = forget(events, tick)
    if num > 0 or kinds[KIND_DENM] > 0:
        num = _receive_others(channel, mail, w, slot, me, level, KIND_DENM, scratch, events, num)
    empty(events, num)
    signals = mail.signals[w, r]
    num = forget(signals, tick)
    if num > 0 or kinds[KIND_SPAT] > 0:
        num = _receive_others(channel, mail, w, slot, me, level, KIND_SPAT, scratch, signals, num)
    empty(signals, num)


@kernel
def deliver(
    channel: Channel,
    mail: Mail,
    w: int,
    slot: int,
    key: np.uint64,
    tick: int,
    latency: int,
    scratch: V2xScratch,
) -> None:
    """Deliver the packets of one slot to all receivers of a world.

    `mail`: inboxes and counts are written. `slot`: slot of the packets that are received now.
    `latency`: ticks since the packets were sent. `scratch`: `receivers` must be filled.
    """
    kinds = scratch.kinds
    kinds[:] = 0
    for p in range(mail.num_packets[w, slot]):
        kinds[mail.packets[w, slot, p]["kind"]] += 1
    grant_access(channel, mail, w, slot, key, scratch)
    list_cams(scratch, mail.packets[w, slot], mail.num_packets[w, slot])
    before = mail.counts[w, COUNT_RECEIVED]
    scratch.tally[:] = 0
    for r in range(scratch.receivers.size):
        if scratch.receivers[r]["id"] >= 0:
            _receive(channel, mail, w, slot, r, tick, kinds, scratch)
    mail.delays[w, latency] += mail.counts[w, COUNT_RECEIVED] - before
    for band in range(NUM_BANDS):
        received = scratch.tally[2 * band + 1]
        mail.bands[w, band, 0] += scratch.tally[2 * band] + received
        mail.bands[w, band, 1] += received


@kernel
def _expire_and_sort(
    box: NDArray[np.void], tick: int, squared: NDArray[np.float64], x: float, y: float
) -> int:
    num = forget(box, tick)
    empty(box, num)
    sort_by_distance(box, num, squared, x, y)
    return num


@kernel
def age(mail: Mail, w: int, r: int, tick: int, scratch: V2xScratch) -> None:
    """Remove expired reports from a receiver's inboxes, and sort the remaining reports."""
    me = scratch.receivers[r]
    _expire_and_sort(mail.objects[w, r], tick, scratch.squared, me["x"], me["y"])
    _expire_and_sort(mail.events[w, r], tick, scratch.squared, me["x"], me["y"])
    _expire_and_sort(mail.signals[w, r], tick, scratch.squared, me["x"], me["y"])


@kernel
def receive_packet(
    mail: Mail, w: int, slot: int, p: int, r: int, delay: int, scratch: V2xScratch
) -> None:
    """Deliver one packet to one receiver, as decided by a network simulator.

    `mail`: inboxes and counts are written. `r`: an existing receiver. `delay`: ticks since the
    packet was sent. `scratch`: `receivers` must be filled.
    """
    me = scratch.receivers[r]
    packet = mail.packets[w, slot, p]
    if packet["kind"] == KIND_CAM or packet["kind"] == KIND_CPM:
        box = mail.objects[w, r]
    elif packet["kind"] == KIND_DENM:
        box = mail.events[w, r]
    else:
        box = mail.signals[w, r]
    tick = packet["tick"] + delay
    num = _expire_and_sort(box, tick, scratch.squared, me["x"], me["y"])
    for k in range(packet["first"], packet["first"] + packet["count"]):
        report = mail.reports[w, slot, k]
        is_own = packet["kind"] != KIND_SPAT and report["subject"] == me["id"]
        if is_own or report["expires"] < tick:
            continue
        place = find(box, num, report["subject"])
        if place < 0:
            num = insert(box, num, scratch.squared, report, me["x"], me["y"])
        elif is_better(report, box[place]):
            box[place] = report
            sort_by_distance(box, num, scratch.squared, me["x"], me["y"])
    mail.counts[w, COUNT_RECEIVED] += 1
    mail.delays[w, delay] += 1


@kernel
def _place_receivers(
    zoned: ZoneState,
    side: int,
    w: int,
    num: int,
    key: np.uint64,
    units: NDArray[np.void],
    mail: Mail,
    scratch: V2xScratch,
) -> None:
    """Write the positions of agents and roadside units; new receivers get empty inboxes."""
    receivers = scratch.receivers
    num_agents = receivers.size - units.size
    for r in range(num_agents):
        receivers[r]["id"] = -1
    for k in range(num):
        station = scratch.stations[k]
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
    common: SharedState,
    zoned: ZoneState,
    side: int,
    first: int,
    last: int,
    mail: Mail,
    scratch: V2xScratch,
) -> None:
    """Send the messages due in the current tick of some worlds, and receive arriving messages.

    Args:
        sending: schedule of the stations.
        channel: the radio channel.
        roads: the road arrays.
        types: VTYPE (num_types,).
        units: UNIT (num_units,), the roadside units.
        common: clocks, keys and signals of the worlds.
        zoned: vehicles of all zones.
        side: 0 or 1, the half of `ZoneState.rows` with the state at the current tick.
        first: first world.
        last: end of the worlds, exclusive.
        mail: state that outlives the tick; written.
        scratch: overwritten.
    """
    for w in range(first, last):
        tick = common.ticks[w]
        key = common.keys[w]
        num = gather(zoned, side, w, scratch.stations, scratch.spare)
        if sending.cpm_period > 0 or sending.unit_cpm_period > 0:
            for k in range(num):
                station = scratch.stations[k]
                scratch.vehicles[k] = zoned.rows[side, station["zone"], w, station["row"]]
            fill_grid(scratch.vehicles, num, scratch.bodies)
        slots = sending.latency + 1
        slot = tick % slots
        mail.num_packets[w, slot] = 0
        mail.num_reports[w, slot] = 0
        send_from_vehicles(
            sending, mail, w, slot, zoned, side, num, key, tick, types, channel.walls, scratch
        )
        send_from_units(sending, mail, w, slot, roads, common, units, types, channel.walls, scratch)
        mail.declared[w] = 0
        _place_receivers(zoned, side, w, num, key, units, mail, scratch)
        if not channel.external:
            arriving = (tick - sending.latency) % slots
            deliver(channel, mail, w, arriving, key, tick, sending.latency, scratch)


@kernel
def hand_out(
    receptions: NDArray[np.void], tick: int, latency: int, mail: Mail, w: int, scratch: V2xScratch
) -> None:
    """Deliver the receptions of this tick that a network simulator has returned.

    `receptions`: RECEPTION (n,), of packets in flight and existing receivers. `latency`: the
    longest delay, in ticks. `mail`: inboxes and counts are written. `scratch`: `receivers` as
    written by `exchange_messages`.
    """
    for r in range(scratch.receivers.size):
        if scratch.receivers[r]["id"] >= 0:
            age(mail, w, r, tick, scratch)
    for k in range(receptions.size):
        sent = receptions[k]["tick"]
        slot = sent % (latency + 1)
        receive_packet(
            mail, w, slot, receptions[k]["packet"], receptions[k]["receiver"], tick - sent, scratch
        )
