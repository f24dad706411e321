"""Tables of S signals that agents control, and of N watched lanes before and after them."""

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
    incoming: NDArray[np.int32]  # (S, I) indices of lanes before the signal; -1: none
    outgoing: NDArray[np.int32]  # (S, O) lanes after the signal
    approach: NDArray[np.int32]  # (S, A) incoming lanes, and lanes that lead to them
    lane_row: NDArray[np.int32]  # (N,) LANE rows
    lane_index: NDArray[np.int32]  # (L,) index of each LANE among the N lanes; -1: not watched
    length_m: NDArray[np.float64]  # (N,)
    speed_mps: NDArray[np.float64]  # (N,) speed limits
    detector: NDArray[np.int32]  # (N,) DETECTOR rows of lanes before the signals; -1: none


class LaneWeights(NamedTuple):
    """Weights of lanes for each green of each signal, in CSR form."""

    first: NDArray[np.int64]  # (S · G + 1,) entries of green g of signal s: from s · G + g
    lanes: NDArray[np.int32]  # (num_entries,) indices of watched lanes
    weights: NDArray[np.int64]  # (num_entries,)


class LanePosts(NamedTuple):
    """Where watched lanes are observed: from the signal at their end, or else at their start."""

    signal: NDArray[np.int32]  # (N,) index of the signal that observes the lane
    leads_in: NDArray[np.bool_]  # (N,) whether the signal is at the end of the lane
    line_m: NDArray[np.float64]  # (N,) position of the stop line; 0 if the signal is at the start


class SignalTicks(NamedTuple):
    """The durations of a `SignalsConfig` in ticks."""

    decide: int
    yellow: int
    all_red: int
    min_green: int
    max_green: int  # 0: no maximum
    longest_red: int  # 0: no limit
    flow_interval: int
