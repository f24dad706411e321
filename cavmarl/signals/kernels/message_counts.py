"""Counts of the vehicles in messages that roadside units at signals have received."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.geometry import project
from cavmarl.roads.kernels.lanes_now import table_of
from cavmarl.signals.kernels.controlled_signals import ControlledSignals
from cavmarl.signals.kernels.lane_counts import (
    LENGTH_MM,
    NEAR_LINE,
    SPEED_PPM,
    STANDING,
    STANDING_MPS,
    STOOD_TICKS,
    VEHICLES,
    estimate_standing_time,
)
from cavmarl.signals.kernels.signal_steps import SignalRules, SignalWorlds

LEAST_ALONG = 0.5  # cosine of the largest angle between a vehicle and its lane


class UnitLanes(NamedTuple):
    """The roadside unit at each signal, and the lanes that the signal observes."""

    receivers: NDArray[np.int64]  # (S,) rows of the units' inboxes
    first: NDArray[np.int64]  # (S + 1,) lanes of signal s: lanes[first[s] : first[s + 1]]
    lanes: NDArray[np.int64]  # (N,) indices of watched lanes
    first_point: NDArray[np.int32]  # (N,) POINT row of each lane
    num_points: NDArray[np.int32]  # (N,)
    half_width_m: NDArray[np.float64]  # (N,)
    points: NDArray[np.void]  # POINT (num_points,) of the map
    full: NDArray[np.int64]  # (1,) number of full inboxes, summed over decisions


@kernel
def count_by_messages(
    rules: SignalRules,
    worlds: SignalWorlds,
    units: UnitLanes,
    inboxes: NDArray[np.void],  # REPORT (W, receivers, most), see `v2x.kernels.v2x_records`
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    counts: NDArray[np.int64],  # (W, N, COUNTS) of the previous decision, overwritten where chosen
) -> None:
    """Count the vehicles in the inboxes of the units, by lane at the reported positions.

    A vehicle is on the lane with the nearest centre line, if it is not beside this lane and has
    about the same direction.
    """
    controlled = rules.controlled
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        lanes = worlds.lanes[table_of(worlds.lanes, w)]
        for n in range(counts.shape[1]):
            stood = counts[w, n, STOOD_TICKS]
            counts[w, n] = 0
            counts[w, n, STOOD_TICKS] = stood
        for s in range(units.receivers.size):
            box = inboxes[w, units.receivers[s]]
            num = 0
            while num < box.size and box[num]["sender"] >= 0:
                n, along_m = _lane_of(controlled, units, s, box[num])
                if n >= 0:
                    found, speed = counts[w, n], abs(box[num]["speed"])
                    found[VEHICLES] += 1
                    found[STANDING] += speed < STANDING_MPS
                    share = speed / lanes[controlled.lane_row[n]]["speed_mps"]
                    found[SPEED_PPM] += math.floor(share * 1e6 + 0.5)
                    found[LENGTH_MM] += math.floor(box[num]["length"] * 1e3 + 0.5)
                    front_m = along_m + 0.5 * box[num]["length"]
                    found[NEAR_LINE] += controlled.length_m[n] - front_m <= rules.near_m
                num += 1
            units.full[0] += num == box.size
        for n in range(counts.shape[1]):
            estimate_standing_time(rules.durations.decide, counts[w, n])


@kernel
def _lane_of(
    controlled: ControlledSignals, units: UnitLanes, s: int, report: np.void
) -> tuple[int, float]:
    """Return the lane of signal s on which a reported vehicle is, or -1, and its position in m."""
    cos, sin = cos_sin(report["heading"])
    found, place_m, least_m = -1, 0.0, math.inf
    for k in range(units.first[s], units.first[s + 1]):
        n = units.lanes[k]
        along_m, beside_m, lane_cos, lane_sin = project(
            units.points, units.first_point[n], units.num_points[n], report["x"], report["y"]
        )
        if (
            0.0 <= along_m <= controlled.length_m[n]
            and abs(beside_m) <= units.half_width_m[n]
            and abs(beside_m) < least_m
            and cos * lane_cos + sin * lane_sin >= LEAST_ALONG
        ):
            found, place_m, least_m = n, along_m, abs(beside_m)
    return found, place_m
