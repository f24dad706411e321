"""Scores of greens: weighted sums of counts on lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.signals.kernels.green_choices import GREEN, KEEP


class LaneWeights(NamedTuple):
    """Weights of lanes for each green of each signal, in CSR form."""

    first: NDArray[np.int64]  # (S · G + 1,) entries of green g of signal s: from s · G + g
    lanes: NDArray[np.int32]  # (num_entries,) indices of watched lanes
    weights: NDArray[np.int64]  # (num_entries,)


@kernel
def choose_best(
    table: LaneWeights,
    column: int,  # of the counts
    cyclic: bool,  # see `green_choices.choose_greens`
    num_greens: NDArray[np.int32],  # (S,)
    counts: NDArray[np.int64],  # (W, N, COUNTS)
    states: NDArray[np.int64],  # (W, S, HELD)
    masks: NDArray[np.bool_],  # (W, S, G)
    decides: NDArray[np.bool_],  # (W,)
    choices: NDArray[np.int64],  # (W, S) output; KEEP where it is not time for a decision
) -> None:
    """Choose the allowed green of the highest score; of equal ones, the first in cyclic order.

    With cyclic choices, the next green begins if any other green has a higher score.
    """
    most = masks.shape[2]
    for w in range(decides.size):
        for s in range(num_greens.size):
            choices[w, s] = KEEP
            if not decides[w]:
                continue
            green = states[w, s, GREEN]
            keeps = masks[w, s, 0 if cyclic else green]
            best, best_score = -1, np.int64(0)
            for k in range(num_greens[s]):
                g = (green + k) % num_greens[s]  # the present green first
                if not (keeps if k == 0 else masks[w, s, 1 if cyclic else g]):
                    continue
                score = np.int64(0)
                at = s * most + g
                for entry in range(table.first[at], table.first[at + 1]):
                    score += table.weights[entry] * counts[w, table.lanes[entry], column]
                if best < 0 or score > best_score:
                    best, best_score = g, score
            choices[w, s] = (0 if best == green else 1) if cyclic else best
