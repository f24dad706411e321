"""The kernel of the `history` sensor: the controls and speeds of the last steps.

The numbers of earlier steps come from the previous frame, where `shift_frames` keeps them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.sensors.kernels.sense import ACCEL_SCALE, SPEED_SCALE, STEERING_SCALE, unit

HISTORY_FEATURES = 3  # number of features per step


class HistorySensor(NamedTuple):
    """Settings of the `history` sensor."""

    at: int
    size: int  # number of values; 0: off


@kernel
def observe_history(
    row: np.void, entered: bool, at: int, size: int, observation: NDArray[np.float32]
) -> None:
    """Move the steps back by one and write the newest step; if `entered`, write it to all steps.

    Writes `size` numbers, starting at `at`, with the last step first.
    """
    for k in range(at + size - 1, at + HISTORY_FEATURES - 1, -1):
        observation[k] = observation[k - HISTORY_FEATURES]
    observation[at] = unit(row["throttle"] / ACCEL_SCALE)
    observation[at + 1] = unit(row["steering"] / STEERING_SCALE)
    observation[at + 2] = unit(row["speed"] / SPEED_SCALE)
    if entered:
        for k in range(at + HISTORY_FEATURES, at + size):
            observation[k] = observation[k - HISTORY_FEATURES]
