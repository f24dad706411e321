"""What a row most likely is a tick later: of a ghost, only what is different goes between nodes.

Both ends foresee the same, by the same operations on the same numbers, and what is not as foreseen
is sent. So rows arrive bit for bit whatever a driver does; how many bytes it takes depends on this.

A driver of the background chooses an acceleration (`throttle`). Speed, rates and accounts follow
from it, as `motion.move_background` and `motion.account` have them; where it is on the map follows
from the roads, and is sent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS, STANDING_MPS
from cavmarl.zones.kernels.row_bounds import Bounds

# Which words of a VEHICLE record fields are; the lane is in the low half of its word.
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
    """What it takes to foresee a row."""

    dt: float  # s of a tick
    ticks_per_step: int
    way_to_go: int  # the word of a row with its step that is the step's `to_go`
    limits: Floats  # (lanes,) m/s
    beyond: Floats  # (lanes,) m from a lane's start that its link has before it, to the link's end
    row_bounds: Bounds  # of the indices in a row
    bounds: Bounds  # of those in a row with its step
    words: Words  # scratch: a row and its step, as foreseen
    floats: Floats  # the same


@inlined_kernel
def is_told(told: np.uint64, word: int) -> bool:
    """Whether the bit of a word is set."""
    return bool(told >> np.uint64(word) & np.uint64(1))


@inlined_kernel
def foresee(
    law: Forecast,
    before: Floats,  # the row a tick ago, with its step
    before_words: Words,  # the same
    row: Floats,  # what it is: of what is foreseen, only what has been written is read
    row_words: Words,  # the same
    told: np.uint64,  # bits of words that are known, and not written
    found: Floats,  # written: a copy of the row before, or `row` itself
    found_words: Words,  # the same
) -> None:
    """Write the words that change in every tick, those that others follow from first."""
    dt = law.dt
    if not is_told(told, SPEED):
        speed = before[SPEED] + row[THROTTLE] * dt
        found[SPEED] = min(max(speed, 0.0), MAX_SPEED_MPS)
    if not is_told(told, ACCEL):
        found[ACCEL] = (row[SPEED] - before[SPEED]) / dt
    if not is_told(told, JERK):
        if row[SPEED] == 0.0 and before[SPEED] == 0.0:
            found[JERK] = -before[ACCEL] / dt
        else:
            found[JERK] = (row[ACCEL] - before[ACCEL]) / dt
    if not is_told(told, S):
        found[S] = before[S] + row[SPEED] * dt
    driven = abs(before[SPEED]) * dt
    if not is_told(told, DISTANCE):
        found[DISTANCE] = before[DISTANCE] + driven
    if not is_told(told, FREE_S):
        limit = law.limits[_lane(law, before_words)]
        found[FREE_S] = before[FREE_S] + driven / (before[FACTOR] * limit)
    if not is_told(told, WAIT_S):
        found[WAIT_S] = before[WAIT_S] + dt if abs(row[SPEED]) < STANDING_MPS else 0.0
    if not is_told(told, TO_GO):
        found[TO_GO] = row[law.way_to_go] + (-row[S] + law.beyond[_lane(law, row_words)])
    begins = before_words[TICK] % law.ticks_per_step == 0  # a step
    if not is_told(told, STEP_TO_GO):
        found[STEP_TO_GO] = before[TO_GO] if begins else before[STEP_TO_GO]
    if not is_told(told, STEP_JERK):
        found[STEP_JERK] = (0.0 if begins else before[STEP_JERK]) + abs(row[JERK]) * dt
    if not is_told(told, TICK):
        found_words[TICK] = before_words[TICK] + 1


@inlined_kernel
def _lane(law: Forecast, row: Words) -> int:
    lane = row[LANE] & _LOW
    return int(lane) if lane < law.limits.size else 0
