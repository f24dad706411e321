"""Actions of all agents at once: whether each is in range, and what it means."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def decode_pairs(
    actions: NDArray[Any],  # (W, A, 2) floats
    mask: NDArray[np.bool_],  # (W, A) whose are read; those of others count as 0
    acceleration_mps2: float,  # what a throttle of 1 means
    steering_rad: float,  # what a steering of 1 means
    last: NDArray[np.float64],  # (W, A, 2) is written, the actions themselves
    controls: NDArray[np.float64],  # (W, A, 2) is written, what they mean
) -> bool:  # whether all are within [-1, 1]; False of what is no number, too
    """Decode shares of the largest throttle and steering angle; nothing if one is out of range."""
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            if mask[w, agent]:
                for k in range(2):
                    if not abs(actions[w, agent, k]) <= 1.0:
                        return False
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            throttle = 0.0
            steering = 0.0
            if mask[w, agent]:
                throttle = float(actions[w, agent, 0]) + 0.0  # of -0.0 too, 0.0
                steering = float(actions[w, agent, 1]) + 0.0
            last[w, agent, 0] = throttle
            last[w, agent, 1] = steering
            controls[w, agent, 0] = throttle * acceleration_mps2
            controls[w, agent, 1] = steering * steering_rad
    return True


@kernel
def decode_choices(
    actions: NDArray[Any],  # (W, A) whole numbers
    mask: NDArray[np.bool_],  # (W, A) whose are read; others stay idle
    idle: int,  # the choice that changes nothing
    choices: int,  # how many there are
    last: NDArray[np.int64],  # (W, A) is written
) -> bool:  # whether all are choices
    """Take over choices; nothing if one is none."""
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            if mask[w, agent] and not 0 <= actions[w, agent] < choices:
                return False
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            last[w, agent] = actions[w, agent] if mask[w, agent] else idle
    return True
