"""Induction loops near signals: readings, and estimates of the number of vehicles.

Each watched lane has a loop where vehicles enter its observed part, and a loop where they leave it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.signals.kernels.controlled_signals import ControlledSignals
from cavmarl.signals.kernels.lane_counts import (
    LENGTH_MM,
    NEAR_LINE,
    SPEED_PPM,
    STANDING,
    VEHICLES,
    estimate_standing_time,
)
from cavmarl.signals.kernels.signal_steps import SignalRules, SignalWorlds

# The loops of a lane.
ENTRY = 0
EXIT = 1

# Columns of the readings (W, N, 2, READINGS) of loops at the last decision.
COUNT = 0  # number of vehicles that reached the loop since the previous decision
COVERED_TICKS = 1  # ticks since the previous decision in which a vehicle was over the loop
FREE_TICKS = 2  # ticks since the last vehicle left the loop; 0: a vehicle is over it
READINGS = 3

# Columns of the state (W, N, 2, DETECTED) of loops.
NEW_COUNT = 0  # COUNT since the last decision
NEW_COVERED = 1  # COVERED_TICKS since the last decision
IS_COVERED = 2
SINCE = 3  # tick at which the loop became covered or free
DETECTED = 4

CAR_MM = 5000  # assumed length of a vehicle


class Loops(NamedTuple):
    """The loops of the watched lanes, and parameters of the estimates."""

    begin_m: NDArray[np.float64]  # (N, 2) positions of the loops on the lanes
    end_m: NDArray[np.float64]  # (N, 2)
    room: NDArray[np.int64]  # (N,) number of stopped vehicles that fit between entry and exit
    clear_ticks: NDArray[np.int64]  # (N,) time in which a vehicle drives from loop to loop
    standing_ticks: int  # a vehicle that covers a loop for this time counts as stopped
    detected: NDArray[np.int64]  # (W, N, 2, DETECTED)
    covered: NDArray[np.bool_]  # (N, 2) scratch


@kernel
def read_loops(
    rules: SignalRules,
    worlds: SignalWorlds,
    loops: Loops,
    chosen: NDArray[np.bool_],  # (W,) worlds whose tick ends
) -> None:
    """Update the state of the loops at the end of a tick.

    A loop is covered in a tick if a vehicle with its centre on the lane was over the loop in this
    tick. The loop counts a vehicle when it becomes covered.
    """
    rows = worlds.rows[worlds.sides[0]]
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        _cover(rules.controlled, rules.dt, loops, rows, worlds.num_owned, w)
        tick = worlds.ticks[w]
        for n in range(loops.covered.shape[0]):
            for which in range(2):
                state = loops.detected[w, n, which]
                is_covered = loops.covered[n, which]
                state[NEW_COVERED] += is_covered
                if is_covered != (state[IS_COVERED] > 0):
                    state[NEW_COUNT] += is_covered
                    state[IS_COVERED] = is_covered
                    state[SINCE] = tick


@kernel
def _cover(
    controlled: ControlledSignals,
    dt: float,
    loops: Loops,
    rows: NDArray[np.void],
    num_owned: NDArray[np.int64],
    w: int,
) -> None:
    """Write which loops are covered in the current tick of a world."""
    loops.covered[:] = False
    for zone in range(rows.shape[0]):
        for i in range(num_owned[zone, w]):
            row = rows[zone, w, i]
            if is_off_lanes(row):
                continue
            n = controlled.lane_index[row["lane"]]
            if n < 0:
                continue
            front = row["s"] + 0.5 * row["length"]
            rear = row["s"] - 0.5 * row["length"] - max(row["speed"], 0.0) * dt
            for which in range(2):
                if front >= loops.begin_m[n, which] and rear <= loops.end_m[n, which]:
                    loops.covered[n, which] = True


@kernel
def estimate_by_loops(
    rules: SignalRules,
    worlds: SignalWorlds,
    loops: Loops,
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    readings: NDArray[np.int64],  # (W, N, 2, READINGS), overwritten in the chosen worlds
    counts: NDArray[np.int64],  # (W, N, COUNTS) of the previous decision; overwritten
) -> None:
    """Write the readings of the loops, and estimate the vehicles between both loops of a lane.

    Source of the balance of entries and exits: Sharma, Bullock, Bonneson, "Input-output and hybrid
        techniques for real-time prediction of delay and maximum queue length at signalized
        intersections" (2007).
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        tick = worlds.ticks[w]
        for n in range(loops.room.size):
            entry, leaves = readings[w, n, ENTRY], readings[w, n, EXIT]
            between = counts[w, n, VEHICLES] - (leaves[FREE_TICKS] == 0)
            for which in range(2):
                _read(loops.detected[w, n, which], tick, readings[w, n, which])
            between = max(between, 0) + entry[COUNT] - leaves[COUNT]
            if leaves[FREE_TICKS] >= loops.clear_ticks[n]:
                between = min(between, entry[COUNT])  # earlier vehicles have passed the exit loop
            if _stands(loops, w, n, ENTRY, tick):
                between = loops.room[n]
            vehicles = max(between, 0) + (leaves[FREE_TICKS] == 0)
            vehicles = min(vehicles, loops.room[n])
            standing = vehicles if _stands(loops, w, n, EXIT, tick) else 0
            found = counts[w, n]
            found[VEHICLES] = vehicles
            found[STANDING] = standing
            found[SPEED_PPM] = (vehicles - standing) * 1_000_000
            found[LENGTH_MM] = vehicles * CAR_MM
            found[NEAR_LINE] = leaves[FREE_TICKS] == 0
            estimate_standing_time(rules.durations.decide, found)


@kernel
def _read(state: NDArray[np.int64], tick: int, reading: NDArray[np.int64]) -> None:
    """Write the reading of a loop, and begin the next interval."""
    reading[COUNT] = state[NEW_COUNT]
    reading[COVERED_TICKS] = state[NEW_COVERED]
    reading[FREE_TICKS] = 0 if state[IS_COVERED] else tick - state[SINCE] + 1
    state[NEW_COUNT] = state[NEW_COVERED] = 0


@kernel
def _stands(loops: Loops, w: int, n: int, which: int, tick: int) -> bool:
    """Return whether a vehicle is stopped over a loop."""
    state = loops.detected[w, n, which]
    return bool(state[IS_COVERED] and tick - state[SINCE] >= loops.standing_ticks)
