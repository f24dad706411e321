"""Counts of the vehicles that cameras at S signals see on N watched lanes, in W worlds."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.rng import STREAM_CAMERA, uniform
from cavmarl.core.math.walls import behind_body
from cavmarl.core.records import record
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.roads.kernels.lanes_now import table_of
from cavmarl.signals.kernels.controlled_signals import ControlledSignals, LanePosts
from cavmarl.signals.kernels.lane_counts import count_vehicle
from cavmarl.signals.kernels.signal_steps import SignalRules, SignalWorlds

# A vehicle within the range of a camera.
IN_RANGE = record(
    ("x", np.float64),  # m, centre
    ("y", np.float64),
    ("cos", np.float64),  # cosine of the heading
    ("sin", np.float64),
    ("half_length", np.float64),  # m
    ("half_width", np.float64),
    ("middle_z", np.float64),  # m, z of the middle of the body
    ("top_z", np.float64),
    ("zone", np.int32),
    ("row", np.int32),
    ("lane", np.int32),  # index of the watched lane
    ("next", np.int32),  # next vehicle within the range of the same camera; -1: none
)


class Cameras(NamedTuple):
    """A camera at each signal, in the middle of its stop lines."""

    posts: LanePosts
    places: NDArray[np.float64]  # (S, 3) x, y, z in m
    range_m: float  # range along the lanes, from the stop line or from the start
    misses: float  # probability that a vehicle is missed
    in_range: NDArray[np.void]  # IN_RANGE (vehicles of a world,) scratch
    first: NDArray[np.int32]  # (S,) scratch


@kernel
def count_by_cameras(
    rules: SignalRules,
    worlds: SignalWorlds,
    cameras: Cameras,
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    counts: NDArray[np.int64],  # (W, N, COUNTS), overwritten in the chosen worlds
) -> None:
    """Count the vehicles on the watched lanes of the chosen worlds that cameras see.

    A camera sees a vehicle within its range if no other vehicle within its range blocks the line to
    the vehicle's middle, and if the camera does not miss the vehicle at random.
    """
    rows = worlds.rows[worlds.sides[0]]
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        counts[w] = 0
        lanes = worlds.lanes[table_of(worlds.lanes, w)]
        num = _list_in_range(rules.controlled, cameras, rows, worlds.num_owned, w)
        for i in range(num):
            found = cameras.in_range[i]
            row = rows[found["zone"], w, found["row"]]
            is_missed = cameras.misses > 0.0 and (
                uniform(worlds.keys[w], row["id"], worlds.ticks[w], STREAM_CAMERA) < cameras.misses
            )
            if not is_missed and not _is_hidden(cameras, i):
                count_vehicle(rules.controlled, lanes, rules.near_m, row, found["lane"], counts[w])


@kernel
def _list_in_range(
    controlled: ControlledSignals,
    cameras: Cameras,
    rows: NDArray[np.void],
    num_owned: NDArray[np.int64],
    w: int,
) -> int:
    """Write a world's vehicles to the scratch of the cameras; return the number of vehicles."""
    cameras.first[:] = -1
    num = 0
    for zone in range(rows.shape[0]):
        for i in range(num_owned[zone, w]):
            row = rows[zone, w, i]
            if is_off_lanes(row):
                continue
            n = controlled.lane_index[row["lane"]]
            if n < 0 or abs(row["s"] - cameras.posts.line_m[n]) > cameras.range_m:
                continue
            found = cameras.in_range[num]
            found["x"], found["y"] = row["x"], row["y"]
            found["cos"], found["sin"] = cos_sin(row["heading"])
            found["half_length"], found["half_width"] = 0.5 * row["length"], 0.5 * row["width"]
            found["middle_z"] = row["z"] + 0.5 * row["height"]
            found["top_z"] = row["z"] + row["height"]
            found["zone"], found["row"], found["lane"] = zone, i, n
            s = cameras.posts.signal[n]
            found["next"] = cameras.first[s]
            cameras.first[s] = num
            num += 1
    return num


@kernel
def _is_hidden(cameras: Cameras, i: int) -> bool:
    """Return whether another vehicle hides entry i of the scratch from its camera."""
    found = cameras.in_range[i]
    s = cameras.posts.signal[found["lane"]]
    x, y, z = cameras.places[s]
    dx, dy = found["x"] - x, found["y"] - y
    far = math.sqrt(dx * dx + dy * dy)
    if far == 0.0:
        return False
    cos, sin, falls = dx / far, dy / far, (z - found["middle_z"]) / far
    k = cameras.first[s]
    while k >= 0:
        other = cameras.in_range[k]
        if k != i:
            leaves_m = behind_body(other, x, y, cos, sin, far)
            if leaves_m > 0.0 and z - falls * leaves_m < other["top_z"]:
                return True
        k = other["next"]
    return False
