"""Scores of greens: weighted sums of counts on lanes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.controlled_signals import LaneWeights
from cavmarl.signals.kernels.green_choices import GREEN, KEEP
from cavmarl.signals.kernels.lane_history import RED_TICKS


@kernel
def choose_best(
    table: LaneWeights,
    column: int,  # column of the counts
    served: LaneWeights,  # see `SignalTable`
    longest_red: int,  # ticks, see `SignalTicks`
    cyclic: bool,  # see `green_choices.choose_greens`
    num_greens: NDArray[np.int32],  # (S,)
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    history: NDArray[np.int64],  # (W, N, HISTORY)
    states: NDArray[np.int64],  # (W, S, HELD)
    masks: NDArray[np.bool_],  # (W, S, G)
    decides: NDArray[np.bool_],  # (W,)
    choices: NDArray[np.int64],  # (W, S) output; KEEP where no decision is due
) -> None:
    """Choose the allowed green with the highest score; on a tie, the first in cyclic order.

    A green has priority if a stopped vehicle on one of its lanes has had red for at least
    `longest_red`; among several such greens, the green with the longest red wins. With cyclic
    choices, the next green starts if any other green ranks before the current green.
    """
    most = masks.shape[2]
    for w in range(decides.size):
        for s in range(num_greens.size):
            choices[w, s] = KEEP
            if not decides[w]:
                continue
            green = states[w, s, GREEN]
            keeps = masks[w, s, 0 if cyclic else green]
            best, best_red, best_score = -1, np.int64(0), np.int64(0)
            for k in range(num_greens[s]):
                g = (green + k) % num_greens[s]  # the current green first
                if not (keeps if k == 0 else masks[w, s, 1 if cyclic else g]):
                    continue
                score = np.int64(0)
                at = s * most + g
                for entry in range(table.first[at], table.first[at + 1]):
                    score += table.weights[entry] * counts[w, table.lanes[entry], column]
                red = np.int64(0)
                for entry in range(served.first[at], served.first[at + 1]):
                    red = max(red, history[w, served.lanes[entry], RED_TICKS])
                if longest_red == 0 or red < longest_red:
                    red = np.int64(0)
                if best < 0 or red > best_red or (red == best_red and score > best_score):
                    best, best_red, best_score = g, red, score
            choices[w, s] = (0 if best == green else 1) if cyclic else best
