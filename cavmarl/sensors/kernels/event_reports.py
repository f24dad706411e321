"""Reports of what happens to agents' vehicles, in the tick in which it happens."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT, EVENT_COLLIDED
from cavmarl.sensors.kernels.rig_noise import is_lost
from cavmarl.sensors.kernels.rig_schedule import Due


@kernel
def report_events(
    worlds: Worlds,
    before: NDArray[np.void],
    ticks_per_step: int,
    tick_s: float,
    due: Due,
    stream: np.uint64,
    dropout: float,
    stamp_s: NDArray[np.float64],
    lost: NDArray[np.bool_],
    fresh: NDArray[np.int64],
    data: NDArray[np.int64],
) -> None:
    """Write a report for each owned agent with an event in this tick.

    Earlier reports move towards the first slot, the newest is the last.

    Args:
        worlds: committed rows.
        before: POSE (W, A) of the tick before.
        ticks_per_step: ticks a step; with each step VEHICLE["events"] begins anew.
        tick_s: seconds a tick.
        due: which worlds are asked.
        stream: of the sensor's random numbers.
        dropout: chance that a report is lost.
        stamp_s: (W, A, S) in s since the reset.
        lost: (W, A, S) which ones are lost.
        fresh: (W, A) reports of this step, up to now.
        data: (W, A, S, 2) EVENT_* bits, and the id of the vehicle that was hit, or -1.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        tick = worlds.ticks[w]
        begins_step = (tick - 1) % ticks_per_step == 0
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            pose = before[w, agent]
            known = 0 if begins_step or pose["id"] != row["id"] else pose["events"]
            events = row["events"] & ~known
            if events == 0:
                continue
            last = stamp_s.shape[2] - 1
            for slot in range(last):
                stamp_s[w, agent, slot] = stamp_s[w, agent, slot + 1]
                lost[w, agent, slot] = lost[w, agent, slot + 1]
                data[w, agent, slot, 0] = data[w, agent, slot + 1, 0]
                data[w, agent, slot, 1] = data[w, agent, slot + 1, 1]
            is_gone = is_lost(row, stream, tick, 0, dropout)
            stamp_s[w, agent, last] = tick * tick_s
            lost[w, agent, last] = is_gone
            data[w, agent, last, 0] = 0 if is_gone else events
            hit = row["hit"] if events & EVENT_COLLIDED else -1
            data[w, agent, last, 1] = 0 if is_gone else hit
            fresh[w, agent] += 1
