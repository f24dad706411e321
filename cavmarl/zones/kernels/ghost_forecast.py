"""Forecast of a row one tick later: nodes only send words of a ghost that differ from the forecast.

Sender and receiver compute the same forecast, with the same operations on the same numbers. So the
received rows are always exact, bit for bit; a good forecast only saves bytes.

A background driver chooses an acceleration (`throttle`). Speed, rates and sums follow from it, as
in `motion.move_background` and `motion.account`. The position on the map is sent, since it depends
on the roads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS, STANDING_MPS
from cavmarl.zones.kernels.row_bounds import Bounds

# The offset in words of each field in a VEHICLE record; the lane is in the low half of its word.
PLACES = {
    "s": 1, "speed": 3, "lane": 5, "speed_factor": 8, "wait_s": 9, "accel": 21, "jerk": 23,
    "throttle": 26, "tick": 29, "to_go": 30, "distance_m": 31, "free_s": 32, "step_to_go": 33,
    "step_jerk": 34,
}  # fmt: skip
S, SPEED, LANE, FACTOR, WAIT_S, ACCEL, JERK, THROTTLE, *_REST = PLACES.values()
TICK, TO_GO, DISTANCE, FREE_S, STEP_TO_GO, STEP_JERK = _REST
_LOW = np.int64((1 << 32) - 1)

Words = NDArray[np.int64]
Floats = NDArray[np.float64]


class Forecast(NamedTuple):
    """The constants and the scratch memory of forecasts. The step of a row is a PLAN record."""

    dt: float  # length of a tick in s
    ticks_per_step: int
    way_to_go: int  # index of the step's `to_go` among the words of a row and its step
    limits: Floats  # (lanes,) m/s
    beyond: Floats  # (lanes,) m from a lane's start to the end of its link
    row_bounds: Bounds  # bounds of the indices in a row
    bounds: Bounds  # bounds of the indices in a row followed by its step
    words: Words  # scratch: the forecast of a row and its step
    floats: Floats  # the same memory


@inlined_kernel
def is_known(bits: np.uint64, word: int) -> bool:
    """Return whether the bit of a word is set."""
    return bool(bits >> np.uint64(word) & np.uint64(1))


@inlined_kernel
def write_forecast(
    forecast: Forecast,
    before: Floats,  # the row one tick ago, with its step
    before_words: Words,  # the same memory
    row: Floats,  # the current row; a word of the forecast is read only after it is written
    row_words: Words,  # the same memory
    known: np.uint64,  # one bit per word; words with the bit 1 are not written
    found: Floats,  # output: a copy of the row one tick ago, or `row` itself
    found_words: Words,  # the same memory
) -> None:
    """Write the words that change in every tick, each word after the words on which it depends."""
    dt = forecast.dt
    if not is_known(known, SPEED):
        speed = before[SPEED] + row[THROTTLE] * dt
        found[SPEED] = min(max(speed, 0.0), MAX_SPEED_MPS)
    if not is_known(known, ACCEL):
        found[ACCEL] = (row[SPEED] - before[SPEED]) / dt
    if not is_known(known, JERK):
        if row[SPEED] == 0.0 and before[SPEED] == 0.0:
            found[JERK] = -before[ACCEL] / dt
        else:
            found[JERK] = (row[ACCEL] - before[ACCEL]) / dt
    if not is_known(known, S):
        found[S] = before[S] + row[SPEED] * dt
    driven = abs(before[SPEED]) * dt
    if not is_known(known, DISTANCE):
        found[DISTANCE] = before[DISTANCE] + driven
    if not is_known(known, FREE_S):
        limit = forecast.limits[_lane(forecast, before_words)]
        found[FREE_S] = before[FREE_S] + driven / (before[FACTOR] * limit)
    if not is_known(known, WAIT_S):
        found[WAIT_S] = before[WAIT_S] + dt if abs(row[SPEED]) < STANDING_MPS else 0.0
    if not is_known(known, TO_GO):
        found[TO_GO] = row[forecast.way_to_go] + (
            -row[S] + forecast.beyond[_lane(forecast, row_words)]
        )
    begins = before_words[TICK] % forecast.ticks_per_step == 0  # whether a step begins
    if not is_known(known, STEP_TO_GO):
        found[STEP_TO_GO] = before[TO_GO] if begins else before[STEP_TO_GO]
    if not is_known(known, STEP_JERK):
        found[STEP_JERK] = (0.0 if begins else before[STEP_JERK]) + abs(row[JERK]) * dt
    if not is_known(known, TICK):
        found_words[TICK] = before_words[TICK] + 1


@inlined_kernel
def _lane(forecast: Forecast, row: Words) -> int:
    lane = row[LANE] & _LOW
    return int(lane) if lane < forecast.limits.size else 0
