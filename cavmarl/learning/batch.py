"""`Batch`: what one round of steps brought, and its advantages."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class Batch:
    """What one round of `num_steps` steps brought; T steps, W worlds, A agents."""

    observations: Tensor  # (T, W, A, D)
    states: Tensor  # (T, W, S) of the worlds; S is 0 where the critic does not see them
    actions: Tensor  # (T, W, A, …) as sampled
    log_probs: Tensor  # (T, W, A) of them
    values: Tensor  # (T, W, A)
    rewards: Tensor  # (T, W, A)
    acted: Tensor  # (T, W, A) which entries are decisions
    next_values: Tensor  # (T, W, A) what was to be expected after the step; 0 where a vehicle ended
    goes_on: Tensor  # (T, W, A) whether entry t + 1 is of the same vehicle and episode
    # (T, W, A, …) what the built-in driver would have done, while it is imitated
    suggested: Tensor | None = None

    def advantages(self, gamma: float, gae_lambda: float) -> Tensor:
        """(T, W, A) generalised advantage estimates (Schulman et al. 2016); 0 where no agent acted.

        The sums go along the way of one vehicle: they begin anew where `goes_on` is False.
        """
        advantages = torch.zeros_like(self.values)
        following = torch.zeros_like(self.values[0])
        for t in reversed(range(self.values.shape[0])):
            delta = self.rewards[t] + gamma * self.next_values[t] - self.values[t]
            following = delta + gamma * gae_lambda * self.goes_on[t] * following
            following = following * self.acted[t]
            advantages[t] = following
        return advantages
