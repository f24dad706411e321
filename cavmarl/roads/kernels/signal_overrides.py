"""Signal states that the caller shows instead of the states of the signals' programs.

If worlds allow such states, the phases of a world (num_signals + num_links,) have one more column
per link: 0, or 1 + the SIGNAL_* code that the caller shows. Otherwise the columns do not exist.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.arrays import RoadArrays

NOT_OVERRIDDEN = -1


@inlined_kernel
def overridden_state(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> int:
    """Return the SIGNAL_* code that the caller shows at a link, or NOT_OVERRIDDEN."""
    column = roads.signals.shape[0] + link
    return int(phase[column]) - 1 if column < phase.size else NOT_OVERRIDDEN
