"""Observations that hold the last few: frames one after the other, oldest first.

The frames of an agent stand in the output arrays at its index and nowhere else, so who carries the
outputs of an agent carries its past.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel

__all__ = ["newest_frame", "repeat_frame", "shift_frames"]


@kernel
def shift_frames(observation: NDArray[np.float32], stack: int) -> None:
    """Drop the oldest frame; the newest one becomes 0."""
    size = observation.size // stack
    for k in range(observation.size - size):
        observation[k] = observation[k + size]
    observation[observation.size - size :] = 0.0


@kernel
def newest_frame(observation: NDArray[np.float32], stack: int) -> NDArray[np.float32]:
    """A view of the newest frame."""
    size = observation.size // stack
    return observation[observation.size - size :]


@kernel
def repeat_frame(observation: NDArray[np.float32], stack: int) -> None:
    """Make all frames the newest one: what an agent sees that has just entered."""
    size = observation.size // stack
    newest = observation.size - size
    for k in range(newest):
        observation[k] = observation[newest + k % size]
