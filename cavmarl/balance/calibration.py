"""Extension, off by default: weights of the LoadScore from logged step times.

The paper's weights are empirical. The score stands for the share of a worker that its shards do
not get: speed = 1 - score. A worker that took `tick_s` for shards that cost `load_s` has lost the
share 1 - load_s / tick_s, and the weights are those that explain the lost shares best, none below
0, scaled to sum to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cavmarl.balance.least_squares import fit_non_negative
from cavmarl.balance.load_score import WEIGHTS, Utilisation

__all__ = ["Calibration", "LoggedTick", "calibrate"]


class LoggedTick(NamedTuple):
    """What a worker took for its shards.

    Attributes:
        use: what others used of it.
        load_s: what its shards cost, seconds a tick.
        tick_s: how long it took, at least `load_s`.
    """

    use: Utilisation
    load_s: float
    tick_s: float


@dataclass(frozen=True)
class Calibration:
    """Fitted weights.

    Attributes:
        weights: of CPU, RAM and GPU; they sum to 1.
        rows: from how many logged ticks.
        explained: whether the use of anything explains lost time; if not, the weights are those
            that were given.
    """

    weights: tuple[float, float, float]
    rows: int
    explained: bool


def calibrate(
    log: Sequence[LoggedTick], given: tuple[float, float, float] = WEIGHTS
) -> Calibration:
    """Fit weights to logged ticks; ticks without a load say nothing.

    Args:
        log: of any workers.
        given: weights to keep where nothing can be learnt.
    """
    rows = [row for row in log if row.load_s > 0.0]
    if not rows:
        return Calibration(given, 0, explained=False)
    used = np.array([(row.use.cpu, row.use.ram, row.use.gpu) for row in rows])
    lost = np.array([1.0 - row.load_s / row.tick_s for row in rows])
    found = fit_non_negative(used, lost)
    total = float(found.sum())
    if total == 0.0:
        return Calibration(given, len(rows), explained=False)
    cpu, ram, gpu = (found / total).tolist()
    return Calibration((cpu, ram, gpu), len(rows), explained=True)
