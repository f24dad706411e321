"""The packets of one tick on the air: by place, by sender, and how much of it they take."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import cell_at, cell_columns, cell_rows
from cavmarl.core.math.rng import mix
from cavmarl.core.numba import inlined_kernel, kernel
from cavmarl.v2x.kernels.v2x_channel import Channel, gets_access
from cavmarl.v2x.kernels.v2x_records import COUNT_NO_ACCESS, KIND_CAM, Air, Mail, V2xScratch


@kernel
def _fill_air(
    air: Air, packets: NDArray[np.void], num: int, cams: bool, access: NDArray[np.bool_]
) -> None:
    """Sort the packets that are on the air into cells: CAMs, or all others."""
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
    """How many packets are sent within a distance."""
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
def load_around(channel: Channel, room: V2xScratch, x: float, y: float) -> float:
    """Share of the tick that all packets take that one hears there; above 1, they do not fit."""
    count = count_within(room.cams, x, y, channel.sensing_m)
    count += count_within(room.others, x, y, channel.sensing_m)
    return channel.load * count


@kernel
def _place_of(sender: int, slots: int) -> int:
    """Where the search for a sender begins in a table of `slots` places, a power of 2."""
    place: int = np.int64(mix(np.uint64(sender)) & np.uint64(slots - 1))  # type: ignore[assignment]
    return place


@kernel
def list_cams(room: V2xScratch, packets: NDArray[np.void], num: int) -> None:
    """Make `room.cam_of` the table of the CAMs that are on the air, by sender."""
    table = room.cam_of
    table[:] = -1
    for p in range(num):
        if room.access[p] and packets[p]["kind"] == KIND_CAM:
            place = _place_of(packets[p]["sender"], table.size)
            while table[place] >= 0:
                place = (place + 1) & (table.size - 1)
            table[place] = p


@inlined_kernel
def find_cam(room: V2xScratch, packets: NDArray[np.void], sender: int) -> int:
    """The CAM of a sender, or -1."""
    table = room.cam_of
    place = _place_of(sender, table.size)
    while table[place] >= 0 and packets[table[place]]["sender"] != sender:
        place = (place + 1) & (table.size - 1)
    return int(table[place])


@kernel
def let_on_the_air(
    channel: Channel, mail: Mail, w: int, slot: int, key: np.uint64, room: V2xScratch
) -> None:
    """Sort the packets of a tick by place; where the air is too busy, not all of them get on it."""
    packets = mail.packets[w, slot]
    num = mail.num_packets[w, slot]
    room.access[:num] = True
    _fill_air(room.cams, packets, num, True, room.access)
    _fill_air(room.others, packets, num, False, room.access)
    if channel.load == 0.0:
        return
    are_all_on = True
    for p in range(num):
        packet = packets[p]
        load = load_around(channel, room, packet["x"], packet["y"])
        if not gets_access(key, packet["sender"], packet["tick"], packet["kind"], load):
            room.access[p] = False
            are_all_on = False
            mail.counts[w, COUNT_NO_ACCESS] += 1
    if not are_all_on:
        _fill_air(room.cams, packets, num, True, room.access)
        _fill_air(room.others, packets, num, False, room.access)
