"""Tables about the signals that agents control, for kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class ControlledSignals(NamedTuple):
    """The record arrays of a `SignalTable`, for kernels."""

    row: NDArray[np.int32]  # (S,) SIGNAL rows
    controller: NDArray[np.int32]  # (S,) index in a world's controllers
    first_phase: NDArray[np.int32]  # (S,) PHASE row of the first green
    num_greens: NDArray[np.int32]  # (S,)
    incoming: NDArray[np.int32]  # (S, I) lanes before the signal, indices of lanes; -1: none
    outgoing: NDArray[np.int32]  # (S, O) lanes behind the signal
    approach: NDArray[np.int32]  # (S, A) incoming lanes, and lanes that lead to them
    lane_row: NDArray[np.int32]  # (N,) LANE rows
    lane_index: NDArray[np.int32]  # (L,) index of each LANE among the N; -1: not watched
    length_m: NDArray[np.float64]  # (N,)
    speed_mps: NDArray[np.float64]  # (N,) speed limits


class SignalTicks(NamedTuple):
    """The durations of a `SignalsConfig` in ticks."""

    decide: int
    yellow: int
    all_red: int
    min_green: int
    max_green: int  # 0: no maximum
