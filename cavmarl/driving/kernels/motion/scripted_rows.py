"""Rows that follow a script: pedestrians and the vehicles of scenarios.

A script is computed before the first step. It has one FRAME per tick, and each FRAME names the next
FRAME. At some frames, the row waits for a cue. The place of a row depends only on its frame and on
the cues, so every owner moves the row in the same way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.driving.kernels.lanes.route_following import distance_left, free_speed, own_step
from cavmarl.driving.kernels.motion.motion import account, before_tick


@inlined_kernel
def stand_at(frame: np.void, row: np.void) -> None:
    """Copy the position and the speed of a FRAME to a row."""
    row["x"] = frame["x"]
    row["y"] = frame["y"]
    row["z"] = frame["z"]
    row["heading"] = frame["heading"]
    row["pitch"] = frame["pitch"]
    row["speed"] = frame["speed"]
    row["lane"] = frame["lane"]
    row["target_lane"] = frame["lane"]
    row["link"] = frame["link"]
    row["s"] = frame["s"]
    row["d"] = frame["d"]


@inlined_kernel
def _let_go(roads: RoadArrays, travel: TripTables, row: np.void, goal: int) -> None:
    """Turn a row into a background vehicle with a goal."""
    row["driver"] = DRIVER_BACKGROUND
    row["goal"] = goal
    row["way"] = goal * roads.lanes.shape[0]
    row["to_go"] = distance_left(roads, row, travel.steps[own_step(roads, row)])


@inlined_kernel
def follow_script(
    roads: RoadArrays,
    travel: TripTables,  # with the scripts
    cues: NDArray[np.int64],  # (T,) tick in which each cue was given, -1: not yet
    row: np.void,  # VEHICLE before the tick; overwritten with the state after it
    dt: float,  # length of the tick, s
) -> None:
    """Advance a scripted row by one tick."""
    before = before_tick(row)
    frame = travel.scripts.frames[row["goal"]]
    if frame["cue"] < 0 or cues[frame["cue"]] >= 0:
        row["goal"] = frame["following"]
        frame = travel.scripts.frames[row["goal"]]
    stand_at(frame, row)
    kind = travel.types[row["vtype"]]
    account(row, before, free_speed(roads.lanes[before.lane], kind, row["speed_factor"]), dt)
    if frame["released_to"] >= 0:
        _let_go(roads, travel, row, frame["released_to"])


@kernel
def note_cues(
    cues: NDArray[np.void],  # CUE (T,)
    rows: NDArray[np.void],  # VEHICLE (k, W, C), the committed rows of all zones
    num_owned: NDArray[np.int64],  # (k, W)
    ticks: NDArray[np.int64],  # (W,) ticks since reset
    came: NDArray[np.int64],  # (W, T) tick in which each cue was given, -1: not yet; updated
) -> None:
    """Record the cues of this tick: a cue is given at its time, or when an agent is near its place.

    The result does not depend on the order of rows or on their owners.
    """
    for w in range(ticks.size):
        for c in range(cues.size):
            cue = cues[c]
            if came[w, c] >= 0:
                continue
            if cue["tick"] >= 0:
                if ticks[w] >= cue["tick"]:
                    came[w, c] = ticks[w]
                continue
            for zone in range(rows.shape[0]):
                if _any_near(cue, rows[zone, w], num_owned[zone, w]):
                    came[w, c] = ticks[w]
                    break


@kernel
def _any_near(cue: np.void, rows: NDArray[np.void], num: int) -> bool:
    for i in range(num):
        row = rows[i]
        if row["driver"] == DRIVER_AGENT:
            dx = row["x"] - cue["x"]
            dy = row["y"] - cue["y"]
            if dx * dx + dy * dy <= cue["radius_m"] * cue["radius_m"]:
                return True
    return False
