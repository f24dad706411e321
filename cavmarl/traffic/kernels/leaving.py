"""Removal of vehicles from their shard when their trip has ended.

`demand_generator.settle` counts these vehicles and orders replacements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import DepartureQueue, Worlds
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_LEARNED,
    EVENT_ARRIVED,
    EVENTS_THAT_END,
)
from cavmarl.zones.kernels.zone_lookup import note_outer


@kernel
def _has_ended(row: np.void, driver: int, ticks_per_step: int) -> bool:
    ending = EVENT_ARRIVED
    if driver == DRIVER_AGENT or driver == DRIVER_LEARNED:
        ending = EVENTS_THAT_END
    if row["driver"] != driver or not row["events"] & ending:
        return False
    acted: bool = row["departed"] <= row["tick"] - ticks_per_step
    return driver != DRIVER_AGENT or acted


@kernel
def _remove_outer(worlds: Worlds, w: int, rows: NDArray[np.void], i: int, last: int) -> None:
    """Remove row i from the list of rows that other zones may see, and rename row `last` to i."""
    outer = worlds.outer[w]
    num = worlds.num_outer[w]
    place = 0
    while place < num and outer[place]["row"] < i:
        place += 1
    if place < num and outer[place]["row"] == i:
        num -= 1
        for n in range(place, num):
            outer[n] = outer[n + 1]
    if place < num and outer[num - 1]["row"] == last:
        for n in range(num - 1, place, -1):
            outer[n] = outer[n - 1]
        note_outer(outer[place], rows[i], i)
    worlds.num_outer[w] = num


@kernel
def leave(
    departures: DepartureQueue,
    worlds: Worlds,
    rows: NDArray[np.void],
    driver: int,
    ticks_per_step: int,
) -> None:
    """Move to `departures.passing` the owned vehicles of a kind of driver whose trips have ended.

    Trips of background vehicles end at arrival. Trips of agents that have acted, and of background
    vehicles that a network drives, also end after a collision or off the road.

    `departures`: `passing` is written. `worlds`: the numbers of rows are written. `rows`: VEHICLE
    (W, C), the rows from which vehicles are removed. `ticks_per_step`: ticks of a step; agents that
    entered within the last step have not acted.
    """
    for w in range(worlds.ticks.shape[0]):
        is_background = driver == DRIVER_BACKGROUND or driver == DRIVER_LEARNED
        if is_background and worlds.num_through[w] == 0:
            continue
        i = 0
        while i < worlds.num_owned[w]:
            if not _has_ended(rows[w, i], driver, ticks_per_step):
                i += 1
                continue
            departures.passing[w, departures.num_passing[w]] = rows[w, i]
            departures.num_passing[w] += 1
            last_owned = worlds.num_owned[w] - 1
            last = worlds.num_rows[w] - 1
            rows[w, i] = rows[w, last_owned]
            rows[w, last_owned] = rows[w, last]  # move the last ghost into the gap
            worlds.num_owned[w] = last_owned
            worlds.num_rows[w] = last
            if worlds.num_outer[w] >= 0:
                _remove_outer(worlds, w, rows[w], i, last_owned)


@kernel
def drop_ghosts(departures: DepartureQueue, worlds: Worlds, rows: NDArray[np.void]) -> None:
    """Remove ghosts of the vehicles in `departures.passing`."""
    for w in range(worlds.ticks.shape[0]):
        for n in range(departures.num_passing[w]):
            vehicle = departures.passing[w, n]["id"]
            for i in range(worlds.num_owned[w], worlds.num_rows[w]):
                if rows[w, i]["id"] == vehicle:
                    last = worlds.num_rows[w] - 1
                    rows[w, i] = rows[w, last]
                    worlds.num_rows[w] = last
                    break
