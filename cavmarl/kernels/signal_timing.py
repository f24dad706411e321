"""When a signal will show something else, as roadside units broadcast it (SPaT, SAE J2735)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays

__all__ = ["time_to_change"]


@kernel
def time_to_change(
    roads: RoadArrays, link: int, phase: NDArray[np.int32], time: float
) -> float:
    """Seconds until the signal of a link shows another letter; a whole cycle if it never does.

    Args:
        roads: the road arrays.
        link: LINK row that has a signal.
        phase: (num_signals,) PHASE rows that are on.
        time: s since the world's reset.
    """
    index = roads.links[link]["signal_index"]
    k = roads.links[link]["signal"]
    signal = roads.signals[k]
    first = signal["first_phase"]
    letter = roads.phase_states[roads.phases[phase[k]]["first_state"] + index]
    left = -((time - signal["offset_s"]) % signal["cycle_s"])
    for row in range(first, phase[k]):
        left += roads.phases[row]["duration_s"]
    # From the beginning of the phase that is on to that of the first with another letter.
    for step in range(signal["num_phases"]):
        row = first + (phase[k] - first + step) % signal["num_phases"]
        if roads.phase_states[roads.phases[row]["first_state"] + index] != letter:
            return max(left, 0.0)
        left += roads.phases[row]["duration_s"]
    return float(signal["cycle_s"])
