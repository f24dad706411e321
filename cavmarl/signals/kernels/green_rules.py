"""Rules of controllers: Webster's durations, gaps between vehicles, and counters of red lanes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import LaneWeights
from cavmarl.signals.kernels.green_choices import GREEN
from cavmarl.signals.kernels.lane_counts import NEAR_LINE
from cavmarl.signals.kernels.lane_history import (
    DETECTED_MS,
    FLOW,
    NOT_MEASURED,
    RED_VEHICLE_TICKS,
)

# Webster's formula of the cycle, and the usual limits of a cycle.
LOST_FACTOR, LOST_EXTRA_S = 1.5, 5.0
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 30.0, 120.0
START_LOSS_S = (
    2.0  # time of a green until vehicles leave at the saturation flow (Highway Capacity Manual)
)


@kernel
def plan_greens(
    served: LaneWeights,  # see `SignalTable`
    num_greens: NDArray[np.int32],  # (S,)
    num_openers: NDArray[np.int64],  # (N,) number of greens that open a lane
    saturation: float,  # number of vehicles that leave a lane in an interval of permanent green
    change_s: float,  # duration of yellow and all-red
    history: NDArray[np.int64],  # (W, N, HISTORY)
    green_s: NDArray[np.float64],  # (W, S, G) updated where a flow has been measured
) -> None:
    """Compute cycles and splits by Webster's formulas from the flows of the last interval.

    The flow of a lane is divided equally among the greens that open the lane. The critical flow of
    a green is the largest flow of its lanes.
    """
    most = green_s.shape[2]
    for w in range(green_s.shape[0]):
        if history[w, 0, FLOW] == NOT_MEASURED:
            continue
        for s in range(num_greens.size):
            ratios = green_s[w, s]
            total = 0.0
            for g in range(num_greens[s]):
                at = s * most + g
                ratios[g] = 0.0
                for entry in range(served.first[at], served.first[at + 1]):
                    lane = served.lanes[entry]
                    flow = history[w, lane, FLOW] / num_openers[lane]
                    ratios[g] = max(ratios[g], flow / saturation)
                total += ratios[g]
            lost_s = num_greens[s] * (START_LOSS_S + change_s)
            cycle_s = LONGEST_CYCLE_S
            if total < 1.0:
                cycle_s = (LOST_FACTOR * lost_s + LOST_EXTRA_S) / (1.0 - total)
            cycle_s = min(max(cycle_s, SHORTEST_CYCLE_S), LONGEST_CYCLE_S)
            for g in range(num_greens[s]):
                share = ratios[g] / total if total > 0.0 else 1.0 / num_greens[s]
                green_s[w, s, g] = max(cycle_s - lost_s, 0.0) * share + START_LOSS_S


@kernel
def find_followers(
    prolonging: LaneWeights,  # see `SignalTable`
    gap_ms: int,  # a detector that was occupied within this time prolongs the green
    dt: float,
    ticks: NDArray[np.int64],  # (W,)
    states: NDArray[np.int64],  # (W, S, HELD)
    history: NDArray[np.int64],  # (W, N, HISTORY)
    follows: NDArray[np.bool_],  # (W, S) output
) -> None:
    """Write whether vehicles follow each other over a detector of the current green."""
    most = (prolonging.first.size - 1) // follows.shape[1]
    for w in range(ticks.size):
        least_ms = ticks[w] * dt * 1e3 - gap_ms
        for s in range(follows.shape[1]):
            at = s * most + states[w, s, GREEN]
            follows[w, s] = False
            for entry in range(prolonging.first[at], prolonging.first[at + 1]):
                if history[w, prolonging.lanes[entry], DETECTED_MS] > least_ms:
                    follows[w, s] = True


@kernel
def find_demanded(
    served: LaneWeights,  # see `SignalTable`
    num_greens: NDArray[np.int32],  # (S,)
    threshold: int,  # vehicle ticks
    platoon: int,  # number of vehicles
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    states: NDArray[np.int64],  # (W, S, HELD)
    history: NDArray[np.int64],  # (W, N, HISTORY)
    wanted: NDArray[np.int64],  # (W, S) output
) -> None:
    """Write the green that red lanes demand, or the current green.

    A green is demanded if the vehicles on its red lanes have waited for `threshold` vehicle ticks.
    The most demanded green is written; on a tie, the first green in cyclic order. The current green
    stays while 1 to `platoon` vehicles are near the line on its lanes, so that the change does not
    separate them from the vehicles ahead.
    """
    most = (served.first.size - 1) // max(num_greens.size, 1)
    for w in range(wanted.shape[0]):
        for s in range(num_greens.size):
            green = states[w, s, GREEN]
            wanted[w, s] = green
            near = np.int64(0)
            at = s * most + green
            for entry in range(served.first[at], served.first[at + 1]):
                near += counts[w, served.lanes[entry], NEAR_LINE]
            if 0 < near <= platoon:
                continue
            highest = np.int64(threshold) - 1
            for k in range(1, num_greens[s]):
                g = (green + k) % num_greens[s]
                demand = np.int64(0)
                at = s * most + g
                for entry in range(served.first[at], served.first[at + 1]):
                    demand += history[w, served.lanes[entry], RED_VEHICLE_TICKS]
                if demand > highest:
                    wanted[w, s], highest = g, demand
