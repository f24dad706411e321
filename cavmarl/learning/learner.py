"""`Learner`: a network, its optimiser, and PPO's update."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import torch
from torch import Tensor, nn

from cavmarl.learning.batch import Batch
from cavmarl.learning.checkpoint import Parts
from cavmarl.learning.ppo_settings import PpoSettings
from cavmarl.policies.networks import ActorCritic

LEAST_DEVIATION = 0.02  # of an observation; those that hardly change are not blown up
NUMBERS = ("policy_loss", "value_loss", "entropy", "kl", "clipped")


class _Decisions(NamedTuple):
    """Those of a batch, N in all; `states` are of worlds, and `world` says which is whose."""

    observations: Tensor  # (N, D)
    actions: Tensor  # (N, …)
    log_probs: Tensor  # (N,)
    advantages: Tensor  # (N,)
    returns: Tensor  # (N,)
    world: Tensor  # (N,) rows of states
    states: Tensor  # (T · W, S)
    suggested: Tensor | None  # (N, …)


class Learner:
    """The network, its optimiser, and PPO's update (Schulman et al. 2017)."""

    def __init__(self, network: ActorCritic, settings: PpoSettings) -> None:
        self.network = network
        self.optimizer = torch.optim.Adam(network.parameters(), lr=settings.learning_rate, eps=1e-5)
        self._settings = settings

    def save(self) -> Parts:
        return {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load(self, saved: Parts) -> None:
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(saved["optimizer"])

    def imitation_weight(self, left: float) -> float:
        """How much the built-in driver's example counts with `left` of the run to go."""
        settings = self._settings
        return settings.imitation_weight * max(1.0 - (1.0 - left) / settings.imitation_share, 0.0)

    def update(self, batch: Batch, left: float) -> dict[str, float]:
        """Learn from the decisions of a batch; `left` is the share of the run that is left."""
        settings = self._settings
        share = left if settings.anneal else 1.0
        rate = settings.learning_rate * share
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        decisions = self._decisions(batch)
        sums: Counter[str] = Counter()
        parts = 0
        for _ in range(settings.epochs):
            order = torch.randperm(len(decisions.returns))
            for chosen in order.tensor_split(settings.minibatches):
                if chosen.numel() < 2:  # one decision has no advantage over others
                    continue
                sums.update(self._learn(decisions, chosen, share, left))
                parts += 1
        means = {name: sums[name] / max(parts, 1) for name in NUMBERS}
        return {**means, "learning_rate": rate}

    def _decisions(self, batch: Batch) -> _Decisions:
        acted = batch.acted
        advantages = batch.advantages(self._settings.gamma, self._settings.gae_lambda)
        step, world, _ = acted.nonzero(as_tuple=True)
        return _Decisions(
            batch.observations[acted],
            batch.actions[acted],
            batch.log_probs[acted],
            advantages[acted],
            (advantages + batch.values)[acted],
            step * acted.shape[1] + world,
            batch.states.flatten(0, 1),
            None if batch.suggested is None else batch.suggested[acted],
        )

    def _learn(
        self, decisions: _Decisions, chosen: Tensor, share: float, left: float
    ) -> dict[str, float]:
        settings, network = self._settings, self.network
        observations = decisions.observations[chosen]
        log_prob, entropy = network.evaluate(observations, decisions.actions[chosen])
        change = log_prob - decisions.log_probs[chosen]
        ratio = change.exp()
        advantages = decisions.advantages[chosen]
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        bounded = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        policy_loss = -torch.min(advantages * ratio, advantages * bounded).mean()
        values = network.value(observations, decisions.states[decisions.world[chosen]])
        value_loss = (values - decisions.returns[chosen]).square().mean()
        loss = (
            policy_loss
            + 0.5 * settings.value_weight * value_loss
            - settings.entropy_weight * share * entropy.mean()
        )
        if decisions.suggested is not None:
            distance = network.distance(observations, decisions.suggested[chosen])
            loss = loss + self.imitation_weight(left) * distance.mean()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        for part in (network.actor, network.critic):
            nn.utils.clip_grad_norm_(part.parameters(), settings.max_gradient_norm)
        self.optimizer.step()
        with torch.no_grad():
            kl = (ratio - 1.0 - change).mean()
            clipped = ((ratio - 1.0).abs() > settings.clip).float().mean()
            found = (policy_loss, value_loss, entropy.mean(), kl, clipped)
            return {name: number.item() for name, number in zip(NUMBERS, found, strict=True)}


class Scales:
    """Keeps the network's mean and deviation of observations: of all decisions of a run so far."""

    def __init__(self, network: ActorCritic) -> None:
        self._network = network
        self._count = 0
        self._squares = torch.zeros_like(network.deviation)

    def save(self) -> Parts:
        return {"count": self._count, "squares": self._squares}

    def load(self, saved: Parts) -> None:
        self._count, self._squares = saved["count"], saved["squares"]

    def add(self, observations: Tensor) -> None:
        """Take in the observations (N, D) of new decisions (Chan et al. 1979)."""
        network, new = self._network, observations.shape[0]
        if new == 0:
            return
        mean = observations.mean(0)
        apart = mean - network.mean
        total = self._count + new
        self._squares += (observations - mean).square().sum(0)
        self._squares += apart.square() * (self._count * new / total)
        network.mean += apart * (new / total)
        network.deviation.copy_((self._squares / total).sqrt().clamp(min=LEAST_DEVIATION))
        self._count = total
