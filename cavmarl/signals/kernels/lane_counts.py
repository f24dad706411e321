"""Counts of vehicles on the N watched lanes near signals, in W worlds.

All counts are whole numbers, so their sums do not depend on the order or the owners of vehicles.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.roads.kernels.lanes_now import table_of
from cavmarl.signals.kernels.controlled_signals import ControlledSignals

# Columns of the counts (W, N, COUNTS) on lanes.
VEHICLES = 0
STANDING = 1
STOOD_TICKS = 2  # sum of the ticks for which vehicles have been stopped on this lane
SPEED_PPM = 3  # sum of speeds as shares of the desired speed, in millionths
LENGTH_MM = 4  # sum of the lengths of vehicles
NEAR_LINE = 5  # number of vehicles whose front is near the end of the lane
COUNTS = 6

STANDING_MPS = 0.1  # below this speed a vehicle counts as stopped, as in SUMO
NOT_COUNTED = -1

_LANE_SHIFT = 32


@kernel
def count_vehicle(
    controlled: ControlledSignals,
    lanes: NDArray[np.void],  # LANE (L,) of the world
    near_m: float,  # see `count_lanes`
    row: np.void,  # VEHICLE
    lane: int,  # index of a watched lane
    counts: NDArray[np.int64],  # (N, COUNTS) updated
) -> None:
    """Add a vehicle to the counts of its lane."""
    found = counts[lane]
    speed = abs(row["speed"])
    desired = lanes[row["lane"]]["speed_mps"] * max(row["speed_factor"], 1e-3)
    found[VEHICLES] += 1
    found[STANDING] += speed < STANDING_MPS
    if row["lane_stood"] >= 0:
        found[STOOD_TICKS] += row["lane_stood"] & ((1 << _LANE_SHIFT) - 1)
    found[SPEED_PPM] += math.floor(speed / desired * 1e6 + 0.5)
    found[LENGTH_MM] += math.floor(row["length"] * 1e3 + 0.5)
    front_m = row["s"] + 0.5 * row["length"]
    found[NEAR_LINE] += controlled.length_m[lane] - front_m <= near_m


@kernel
def estimate_standing_time(
    ticks: int,  # ticks since the previous decision
    counts: NDArray[np.int64],  # (COUNTS,) of a lane; STOOD_TICKS is from the previous decision
) -> None:
    """Estimate the sum of stopped times, for sensors that cannot track vehicles.

    Each stopped vehicle is assumed to have been stopped since the previous decision.
    """
    stood = counts[STOOD_TICKS] + counts[STANDING] * ticks
    counts[STOOD_TICKS] = stood if counts[STANDING] > 0 else 0


@kernel
def count_standing(
    rows: NDArray[np.void],  # VEHICLE (k, W, C), "lane_stood" is updated
    num_owned: NDArray[np.int64],  # (k, W)
    lane_index: NDArray[np.int32],  # see `ControlledSignals`
    chosen: NDArray[np.bool_],  # (W,) worlds in which a tick has passed
) -> None:
    """Count how long each vehicle has been stopped on its lane, if the lane is watched."""
    for zone in range(rows.shape[0]):
        for w in range(rows.shape[1]):
            if not chosen[w]:
                continue
            for i in range(num_owned[zone, w]):
                row = rows[zone, w, i]
                if is_off_lanes(row) or lane_index[row["lane"]] < 0:
                    row["lane_stood"] = NOT_COUNTED
                    continue
                lane = np.int64(row["lane"])
                stood = row["lane_stood"]
                if stood < 0 or stood >> _LANE_SHIFT != lane:
                    stood = lane << _LANE_SHIFT
                if abs(row["speed"]) < STANDING_MPS:
                    stood += 1
                row["lane_stood"] = stood


@kernel
def count_lanes(
    controlled: ControlledSignals,
    lanes: NDArray[np.void],  # see `Worlds`
    near_m: float,  # distance from the end of a lane, for NEAR_LINE
    rows: NDArray[np.void],  # VEHICLE (k, W, C)
    num_owned: NDArray[np.int64],  # (k, W)
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    counts: NDArray[np.int64],  # (W, N, COUNTS), overwritten in the chosen worlds
) -> None:
    """Count the vehicles on the watched lanes of the chosen worlds."""
    for w in range(rows.shape[1]):
        if not chosen[w]:
            continue
        counts[w] = 0
        own_lanes = lanes[table_of(lanes, w)]
        for zone in range(rows.shape[0]):
            for i in range(num_owned[zone, w]):
                row = rows[zone, w, i]
                if is_off_lanes(row):
                    continue
                n = controlled.lane_index[row["lane"]]
                if n >= 0:
                    count_vehicle(controlled, own_lanes, near_m, row, n, counts[w])
