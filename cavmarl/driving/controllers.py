"""`CONTROLLER`: what a world knows of one actuated signal program."""

from __future__ import annotations

import numpy as np

CONTROLLER = np.dtype(
    [
        ("phase", np.int64),  # PHASE row that is on
        ("since_ms", np.int64),  # when it began, since reset
        ("next_ms", np.int64),  # when to look whether it goes on
    ],
    align=True,
)
