"""Frame stacks: an observation holds the last few frames, oldest first.

Past frames are stored only in an agent's observation, in the output arrays. So they move with the
outputs when an agent moves to another zone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT


@kernel
def has_entered(row: np.void, ticks_per_step: int) -> bool:
    """Return whether a vehicle entered during the last step or at reset."""
    return bool(row["departed"] > row["tick"] - ticks_per_step)


@kernel
def newest_frame(observation: NDArray[np.float32], stack: int) -> int:
    return observation.size - observation.size // stack


@kernel
def shift_frames(observation: NDArray[np.float32], stack: int, kept_at: int, kept: int) -> None:
    """Move all frames back by one. Clear the newest, except `kept` numbers from `kept_at` on."""
    newest = newest_frame(observation, stack)
    size = observation.size - newest
    for k in range(newest):
        observation[k] = observation[k + size]
    observation[newest : newest + kept_at] = 0.0
    observation[newest + kept_at + kept :] = 0.0


@kernel
def repeat_frame(observation: NDArray[np.float32], stack: int) -> None:
    """Copy the newest frame to all others, for an agent that has just entered."""
    newest = newest_frame(observation, stack)
    size = observation.size - newest
    for k in range(newest):
        observation[k] = observation[newest + k % size]


@kernel
def fill_stacks(
    worlds: Worlds,
    ticks_per_step: int,
    stack: int,
    chosen: NDArray[np.bool_],
    observations: NDArray[np.float32],
) -> None:
    """Repeat the first frame of every vehicle that entered during the last step.

    `observations`: (W, A, D), in which the newest frames are complete.
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] == DRIVER_AGENT and has_entered(row, ticks_per_step):
                repeat_frame(observations[w, row["agent"]], stack)
