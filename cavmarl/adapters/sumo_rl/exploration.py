"""`EpsilonGreedy`: random actions with a probability that decays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class EpsilonGreedy:
    """Choose a random action with probability epsilon, else the action of the highest value.

    Args:
        initial_epsilon: first probability.
        min_epsilon: lowest probability.
        decay: factor by which each choice reduces the probability.

    Attributes:
        epsilon: current probability.
    """

    def __init__(
        self, initial_epsilon: float = 1.0, min_epsilon: float = 0.0, decay: float = 0.99
    ) -> None:
        self.initial_epsilon = initial_epsilon
        self.min_epsilon = min_epsilon
        self.decay = decay
        self.epsilon = initial_epsilon

    def choose(self, q_table: Mapping[Any, Sequence[float]], state: Any, action_space: Any) -> int:
        """Return an action for a state whose action values are in `q_table`."""
        explores = np.random.random() < self.epsilon
        self.epsilon = max(self.min_epsilon, self.epsilon * self.decay)
        return int(action_space.sample() if explores else np.argmax(q_table[state]))

    def reset(self) -> None:
        """Return to the first probability."""
        self.epsilon = self.initial_epsilon
