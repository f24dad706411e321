"""Validation and decoding of the actions of all agents."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def decode_pairs(
    actions: NDArray[Any],  # (W, A, 2) floats
    mask: NDArray[np.bool_],  # (W, A) agents whose actions are read; others count as 0
    acceleration_mps2: float,  # acceleration at throttle 1
    steering_rad: float,  # steering angle at steering 1
    last: NDArray[np.float64],  # (W, A, 2) is written: the decoded throttle and steering
    controls: NDArray[np.float64],  # (W, A, 2) is written, m/s² and rad
) -> bool:  # whether all actions are within [-1, 1]; NaN is not
    """Decode throttle and steering in [-1, 1]. Write nothing if an action is out of range."""
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
                throttle = float(actions[w, agent, 0]) + 0.0  # -0.0 becomes 0.0
                steering = float(actions[w, agent, 1]) + 0.0
            last[w, agent, 0] = throttle
            last[w, agent, 1] = steering
            controls[w, agent, 0] = throttle * acceleration_mps2
            controls[w, agent, 1] = steering * steering_rad
    return True


@kernel
def decode_choices(
    actions: NDArray[Any],  # (W, A) whole numbers
    mask: NDArray[np.bool_],  # (W, A) agents whose actions are read; others stay idle
    idle: int,  # the choice that changes nothing
    choices: int,  # number of choices
    last: NDArray[np.int64],  # (W, A) is written
) -> bool:  # whether all actions are valid choices
    """Copy choices. Write nothing if one is invalid."""
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            if mask[w, agent] and not 0 <= actions[w, agent] < choices:
                return False
    for w in range(mask.shape[0]):
        for agent in range(mask.shape[1]):
            last[w, agent] = actions[w, agent] if mask[w, agent] else idle
    return True
