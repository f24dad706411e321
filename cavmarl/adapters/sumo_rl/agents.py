"""`QLAgent`: tabular Q-learning."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from cavmarl.adapters.sumo_rl.exploration import EpsilonGreedy


class QLAgent:
    """Tabular Q-learning for states that can be keys of a dict.

    Source: Watkins, "Learning from delayed rewards" (1989).

    Args:
        starting_state: first state.
        state_space: not read; scripts for sumo-rl pass it.
        action_space: a Discrete space.
        alpha: learning rate.
        gamma: discount of a step.
        exploration_strategy: chooses actions; default: `EpsilonGreedy()`.

    Attributes:
        q_table: action values of each state that the agent has visited.
        state: current state.
        action: last action; None before the first one.
        acc_reward: sum of all rewards.
    """

    def __init__(
        self,
        starting_state: Hashable,
        state_space: Any,
        action_space: Any,
        alpha: float = 0.5,
        gamma: float = 0.95,
        exploration_strategy: EpsilonGreedy | None = None,
    ) -> None:
        self.state = starting_state
        self.state_space = state_space
        self.action_space = action_space
        self.alpha = alpha
        self.gamma = gamma
        self.exploration = exploration_strategy or EpsilonGreedy()
        self.action: int | None = None
        self.acc_reward = 0.0
        self.q_table: dict[Hashable, list[float]] = {}
        self._values(starting_state)

    def act(self) -> int:
        """Choose an action for the current state."""
        self.action = self.exploration.choose(self.q_table, self.state, self.action_space)
        return self.action

    def learn(self, next_state: Hashable, reward: float, done: bool = False) -> None:
        """Update the value of the last action, and move to the next state.

        As in sumo-rl, `done` is not read: episodes end by truncation only.
        """
        if self.action is None:
            raise ValueError("learn() before act(): choose an action first")
        values = self._values(self.state)
        target = reward + self.gamma * max(self._values(next_state))
        values[self.action] += self.alpha * (target - values[self.action])
        self.state = next_state
        self.acc_reward += reward

    def _values(self, state: Hashable) -> list[float]:
        return self.q_table.setdefault(state, [0.0] * int(self.action_space.n))
