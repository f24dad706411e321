"""The packets of a tick in the channel, sorted by position and sender, and the channel load.

Most packets are CAMs, one per vehicle. A receiver first lists all packets within reach. Their
distances and random numbers are then computed in one loop over contiguous memory, which the
compiler vectorizes; only table look-ups are done one by one. Functions with named tuples of arrays
as arguments are inlined: passing a tuple per receiver would take longer than the rest.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.neighbors import cell_at, cell_columns, cell_rows
from cavmarl.core.math.rng import mix
from cavmarl.core.math.walls import is_cut
from cavmarl.v2x.kernels.v2x_channel import Channel, chance_at, draw, gets_access, is_heard
from cavmarl.v2x.kernels.v2x_inbox import find, insert, is_better
from cavmarl.v2x.kernels.v2x_records import (
    BANDS_PER_M,
    COUNT_NO_ACCESS,
    COUNT_REACHABLE,
    COUNT_RECEIVED,
    KIND_CAM,
    NUM_BANDS,
    Air,
    HeardCams,
    Mail,
    V2xScratch,
)


@kernel
def _fill_air(
    air: Air, packets: NDArray[np.void], num: int, cams: bool, access: NDArray[np.bool_]
) -> None:
    """Sort the packets with channel access into cells: the CAMs, or all other packets."""
    start = air.cells.start
    cell = air.cells.cell
    start[:] = 0
    for p in range(num):
        if access[p] and (packets[p]["kind"] == KIND_CAM) == cams:
            c = cell_at(air.cells, packets[p]["x"], packets[p]["y"])
            cell[p] = c
            start[c] += 1
    for c in range(1, start.size):
        start[c] += start[c - 1]
    for p in range(num - 1, -1, -1):
        if access[p] and (packets[p]["kind"] == KIND_CAM) == cams:
            start[cell[p]] -= 1
            place = start[cell[p]]
            air.x[place] = packets[p]["x"]
            air.y[place] = packets[p]["y"]
            air.sender[place] = packets[p]["sender"]
            air.word[place] = packets[p]["word"]
            air.which[place] = p


@inlined_kernel
def count_within(air: Air, x: float, y: float, radius_m: float) -> int:
    """Return the number of packets sent within a distance."""
    cells = air.cells
    if radius_m == math.inf:
        return int(cells.start[cells.start.size - 1])
    limit = radius_m * radius_m
    first_column, last_column = cell_columns(cells, x, radius_m)
    first_row, last_row = cell_rows(cells, y, radius_m)
    count = 0
    for j in range(first_row, last_row + 1):
        begin = cells.start[j * cells.num_x + first_column]
        end = cells.start[j * cells.num_x + last_column + 1]
        for b in range(begin, end):
            dx = air.x[b] - x
            dy = air.y[b] - y
            count += dx * dx + dy * dy <= limit
    return count


@inlined_kernel
def load_around(channel: Channel, scratch: V2xScratch, x: float, y: float) -> float:
    """Return the channel load around a position; above 1, not all packets fit in a tick."""
    count = count_within(scratch.cams, x, y, channel.sensing_m)
    count += count_within(scratch.others, x, y, channel.sensing_m)
    return channel.load * count


@kernel
def _first_slot(sender: int, slots: int) -> int:
    """Return the first slot to search for a sender in a table of `slots` slots, a power of 2."""
    place: int = np.int64(mix(np.uint64(sender)) & np.uint64(slots - 1))  # type: ignore[assignment]
    return place


@kernel
def list_cams(scratch: V2xScratch, packets: NDArray[np.void], num: int) -> None:
    """Fill the hash table `scratch.cam_of` with the sent CAMs, by sender."""
    table = scratch.cam_of
    table[:] = -1
    for p in range(num):
        if scratch.access[p] and packets[p]["kind"] == KIND_CAM:
            place = _first_slot(packets[p]["sender"], table.size)
            while table[place] >= 0:
                place = (place + 1) & (table.size - 1)
            table[place] = p


@inlined_kernel
def find_cam(scratch: V2xScratch, packets: NDArray[np.void], sender: int) -> int:
    table = scratch.cam_of
    place = _first_slot(sender, table.size)
    while table[place] >= 0 and packets[table[place]]["sender"] != sender:
        place = (place + 1) & (table.size - 1)
    return int(table[place])


@kernel
def grant_access(
    channel: Channel, mail: Mail, w: int, slot: int, key: np.uint64, scratch: V2xScratch
) -> None:
    """Grant channel access and sort a tick's packets by place; overload blocks some packets."""
    packets = mail.packets[w, slot]
    num = mail.num_packets[w, slot]
    scratch.access[:num] = True
    _fill_air(scratch.cams, packets, num, True, scratch.access)
    _fill_air(scratch.others, packets, num, False, scratch.access)
    if channel.load == 0.0:
        return
    are_all_on = True
    for p in range(num):
        packet = packets[p]
        load = load_around(channel, scratch, packet["x"], packet["y"])
        if not gets_access(key, packet["sender"], packet["tick"], packet["kind"], load):
            scratch.access[p] = False
            are_all_on = False
            mail.counts[w, COUNT_NO_ACCESS] += 1
    if not are_all_on:
        _fill_air(scratch.cams, packets, num, True, scratch.access)
        _fill_air(scratch.others, packets, num, False, scratch.access)


@inlined_kernel
def hears(
    channel: Channel, me: np.void, level: int, word: np.uint64, x: float, y: float, squared: float
) -> bool:
    """Return whether a receiver receives a packet sent within reach from (x, y)."""
    if channel.sure:
        return True
    number = draw(me["word"], word)
    return is_heard(channel, level, number, me["x"], me["y"], x, y, math.sqrt(squared))


@inlined_kernel
def band_of(distance_m: float) -> int:
    """Return the index of the band in which a reception at this distance is counted."""
    return min(int(distance_m * BANDS_PER_M), NUM_BANDS - 1)


@inlined_kernel
def refresh_by_cams(
    channel: Channel,
    me: np.void,
    level: int,
    packets: NDArray[np.void],
    reports: NDArray[np.void],
    scratch: V2xScratch,
    box: NDArray[np.void],
    num: int,
) -> None:
    """Update the reports of known senders with the senders' newest CAMs."""
    limit = channel.reach_m * channel.reach_m
    for k in range(num):
        p = find_cam(scratch, packets, box[k]["subject"])
        if p < 0:
            continue
        packet = packets[p]
        dx = packet["x"] - me["x"]
        dy = packet["y"] - me["y"]
        squared = dx * dx + dy * dy
        if squared <= limit and hears(
            channel, me, level, packet["word"], packet["x"], packet["y"], squared
        ):
            report = reports[packet["first"]]
            if is_better(report, box[k]):
                box[k] = report


@inlined_kernel
def _list_within(
    air: Air, own: int, x: float, y: float, reach_m: float, limit: float, heard: HeardCams
) -> int:
    """List the packets of other senders within a distance, and return their number."""
    cells = air.cells
    near = 0
    first_column, last_column = cell_columns(cells, x, reach_m)
    first_row, last_row = cell_rows(cells, y, reach_m)
    for j in range(first_row, last_row + 1):
        begin = cells.start[j * cells.num_x + first_column]
        end = cells.start[j * cells.num_x + last_column + 1]
        # Here and below, write each entry before it is tested, because a branch would often be
        # mispredicted.
        for b in range(begin, end):
            dx = air.x[b] - x
            dy = air.y[b] - y
            squared = dx * dx + dy * dy
            heard.place[near] = b
            heard.squared[near] = squared
            heard.word[near] = air.word[b]
            near += (squared <= limit) & (air.sender[b] != own)
    return near


@inlined_kernel
def _drop_lost(channel: Channel, me: np.void, level: int, scratch: V2xScratch, num: int) -> int:
    """Keep the received packets among the first `num` of `scratch.heard`; return their number."""
    air = scratch.cams
    place = scratch.heard.place
    squared = scratch.heard.squared
    words = scratch.heard.word
    distances = scratch.heard.distance
    numbers = scratch.heard.number
    tally = scratch.tally
    of_receiver = me["word"]
    x = me["x"]
    y = me["y"]
    clear = channel.clear[level]
    for k in range(num):
        distances[k] = math.sqrt(squared[k])
        numbers[k] = draw(of_receiver, words[k])
    has_walls = channel.blocked.shape[0] > 0 and channel.walls.segments.shape[0] > 0
    kept = 0
    for k in range(num):
        distance_m = distances[k]
        is_received = numbers[k] < chance_at(clear, distance_m)
        # A packet that is received even behind a building needs no test for buildings.
        if (
            has_walls
            and is_received
            and numbers[k] >= chance_at(channel.blocked[level], distance_m)
        ):
            b = place[k]
            is_received = not is_cut(channel.walls, x, y, air.x[b], air.y[b])
        tally[2 * band_of(distance_m) + is_received] += 1
        place[kept] = place[k]
        squared[kept] = squared[k]
        kept += is_received
    return kept


@inlined_kernel
def add_cams(
    channel: Channel,
    mail: Mail,
    w: int,
    me: np.void,
    level: int,
    packets: NDArray[np.void],
    reports: NDArray[np.void],
    scratch: V2xScratch,
    box: NDArray[np.void],
    num: int,
) -> int:
    """Add the nearest senders that are new to a receiver; return the number of known senders."""
    air = scratch.cams
    reach_m = channel.reach_m
    limit = reach_m * reach_m
    x = me["x"]
    y = me["y"]
    own = me["id"]
    if channel.sure:
        reachable = count_within(air, x, y, reach_m)
        p = find_cam(scratch, packets, own)
        if p >= 0:
            dx = packets[p]["x"] - x
            dy = packets[p]["y"] - y
            reachable -= dx * dx + dy * dy <= limit
        if num == box.size:
            # The inbox is full: ignore stations farther away than all known stations.
            limit = min(limit, scratch.squared[num - 1])
            reach_m = math.sqrt(limit)
        heard = _list_within(air, own, x, y, reach_m, limit, scratch.heard)
        received = reachable
    else:
        reachable = _list_within(air, own, x, y, reach_m, limit, scratch.heard)
        heard = _drop_lost(channel, me, level, scratch, reachable)
        received = heard
    mail.counts[w, COUNT_REACHABLE] += reachable
    mail.counts[w, COUNT_RECEIVED] += received
    for k in range(heard):
        if num < box.size or scratch.heard.squared[k] <= scratch.squared[num - 1]:
            b = scratch.heard.place[k]
            # The subject of a CAM is its sender.
            if find(box, num, air.sender[b]) < 0:
                report = reports[packets[air.which[b]]["first"]]
                num = insert(box, num, scratch.squared, report, x, y)
    return num
