"""The history of lanes for controllers: detected vehicles, and how long vehicles have had red.

All values are whole numbers. They depend only on the ticks and the counts, so every process that
runs a part of a world computes the same values.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import (
    ControlledSignals,
    LaneWeights,
    SignalTicks,
)
from cavmarl.signals.kernels.green_choices import GREEN
from cavmarl.signals.kernels.lane_counts import STANDING, VEHICLES

# Columns of the history (W, N, HISTORY): W worlds, N lanes. `follow_lanes` updates the first two at
# each decision.
RED_TICKS = 0  # ticks of red since vehicles have been stopped on the lane without interruption
RED_VEHICLE_TICKS = 1  # since the lane became red: sum of ticks times vehicles on the lane
DETECTED_MS = 2  # time since the reset at which the lane's detector was last occupied
PASSED = 3  # number of vehicles that the detector has counted in the current interval
FLOW = 4  # number of vehicles that the detector counted in the last interval
HISTORY = 5

NOT_MEASURED = -1  # FLOW: the first interval has not ended


@kernel
def follow_detectors(
    controlled: ControlledSignals,
    interval: int,  # ticks of an interval in which vehicles are counted
    dt: float,
    chosen: NDArray[np.bool_],  # (W,) worlds in which a tick has ended
    ticks: NDArray[np.int64],  # (W,)
    detected_s: NDArray[np.float64],  # (W, D) see `roads.kernels.signal_phases.detect`
    history: NDArray[np.int64],  # (W, N, HISTORY) updated
) -> None:
    """Count the vehicles that reach the detectors in each tick.

    As with an induction loop, a vehicle counts if the detector was free in the previous tick.
    """
    for w in range(ticks.size):
        if not chosen[w]:
            continue
        before_s = (ticks[w] - 1) * dt
        before_ms = _milliseconds(before_s)
        for n in range(controlled.detector.size):
            detector = controlled.detector[n]
            if detector >= 0 and detected_s[w, detector] > before_s:
                lane = history[w, n]
                lane[PASSED] += lane[DETECTED_MS] < before_ms
                lane[DETECTED_MS] = _milliseconds(detected_s[w, detector])
        if ticks[w] > 0 and ticks[w] % interval == 0:
            for n in range(controlled.detector.size):
                history[w, n, FLOW] = history[w, n, PASSED]
                history[w, n, PASSED] = 0


@kernel
def follow_lanes(
    controlled: ControlledSignals,
    served: LaneWeights,  # see `SignalTable`
    durations: SignalTicks,
    chosen: NDArray[np.bool_],  # (W,) worlds in which a decision is due
    ticks: NDArray[np.int64],  # (W,)
    states: NDArray[np.int64],  # (W, S, HELD)
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    history: NDArray[np.int64],  # (W, N, HISTORY) updated
) -> None:
    """Add the time since the last decision to the lanes that are red, at each decision.

    A lane is red unless the current green opens a movement from it; during yellow and all-red, the
    next green counts. `RED_TICKS` restarts if no vehicle is stopped on the lane at a decision.
    """
    num_signals = controlled.row.size
    if num_signals == 0:
        return
    most = (served.first.size - 1) // num_signals
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        passed = durations.decide if ticks[w] > 0 else 0
        for s in range(num_signals):
            for n in controlled.incoming[s]:
                if n >= 0:
                    lane, count = history[w, n], counts[w, n]
                    lane[RED_TICKS] += passed
                    if count[STANDING] == 0:
                        lane[RED_TICKS] = 0
                    lane[RED_VEHICLE_TICKS] += passed * count[VEHICLES]
            at = s * most + states[w, s, GREEN]
            for entry in range(served.first[at], served.first[at + 1]):
                history[w, served.lanes[entry], RED_TICKS] = 0
                history[w, served.lanes[entry], RED_VEHICLE_TICKS] = 0


@kernel
def _milliseconds(seconds: float) -> int:
    return math.floor(seconds * 1e3 + 0.5)
