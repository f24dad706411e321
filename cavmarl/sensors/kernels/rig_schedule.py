"""When mounted sensors take samples: a pure function of a world's tick.

Sample k is due k · ticks / samples ticks after the phase, and delivered by the first tick at or
after that. So nothing has to be kept, and no migration, reset or repeated tick can move it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel


class SensorSchedule(NamedTuple):
    """The rate of a sensor: `samples` in `ticks` ticks, in lowest terms."""

    samples: int
    ticks: int
    phase: int  # tick of sample 0
    ticks_per_step: int
    slots: int  # the most samples in a step


class Due(NamedTuple):
    """What one sensor has to deliver in the present tick of each world."""

    num: NDArray[np.int64]  # (W,) samples
    first: NDArray[np.int64]  # (W,) number of the first one, since the reset
    slot: NDArray[np.int64]  # (W,) where it is written; the last of a step lies in the last slot


@kernel
def taken(schedule: SensorSchedule, tick: int) -> int:
    """How many samples are taken at or before a tick."""
    since = tick - schedule.phase
    if since < 0:
        return 0
    return since * schedule.samples // schedule.ticks + 1


@kernel
def stamp_of(schedule: SensorSchedule, number: int, tick: int, tick_s: float) -> float:
    """The time of a sample in s since the reset, delivered by `tick`.

    Of a sensor with several samples a tick it may lie between two; all others sense the state of
    the tick, and that is what the stamp says.
    """
    if schedule.samples <= schedule.ticks:
        return tick * tick_s
    return (schedule.phase + number * schedule.ticks / schedule.samples) * tick_s


@kernel
def call_due(
    schedule: SensorSchedule, ticks: NDArray[np.int64], chosen: NDArray[np.bool_], due: Due
) -> bool:
    """Write what is due in the chosen worlds, and nothing for the others.

    `ticks`: (W,) since each world's reset.

    Returns:
        whether anything is.
    """
    found = False
    for w in range(ticks.size):
        due.num[w] = 0
        if not chosen[w]:
            continue
        tick = ticks[w]
        before = taken(schedule, tick - 1)
        count = taken(schedule, tick) - before
        if count > 0:
            step_end = -(-tick // schedule.ticks_per_step) * schedule.ticks_per_step
            due.num[w] = count
            due.first[w] = before
            due.slot[w] = schedule.slots - (taken(schedule, step_end) - before)
            found = True
    return found
