"""What the `history` sensor writes: what the vehicle was told to do in the last steps.

The numbers of the steps before stand in the frame before, which `shift_frames` has left them in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.sensors.kernels.sense import ACCEL_SCALE, SPEED_SCALE, STEERING_SCALE, unit

HISTORY_FEATURES = 3  # of a step


class HistorySensor(NamedTuple):
    """What the vehicle did before."""

    at: int
    size: int  # numbers; 0: off


@kernel
def observe_history(
    row: np.void, entered: bool, at: int, size: int, observation: NDArray[np.float32]
) -> None:
    """Move the steps back by one and write the newest; all are the newest of one that entered.

    `size` numbers from `at` on, the last step first.
    """
    for k in range(at + size - 1, at + HISTORY_FEATURES - 1, -1):
        observation[k] = observation[k - HISTORY_FEATURES]
    observation[at] = unit(row["throttle"] / ACCEL_SCALE)
    observation[at + 1] = unit(row["steering"] / STEERING_SCALE)
    observation[at + 2] = unit(row["speed"] / SPEED_SCALE)
    if entered:
        for k in range(at + HISTORY_FEATURES, at + size):
            observation[k] = observation[k - HISTORY_FEATURES]
