"""`Collector`: drives worlds with a network and keeps what comes of it."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from cavmarl.env.vector import CavVectorEnv
from cavmarl.learning.batch import Batch
from cavmarl.learning.run_clock import RunClock
from cavmarl.learning.trips import Trips
from cavmarl.policies.networks import ActorCritic


class Collector:
    """Drives the worlds with a network and keeps what comes of it.

    What worlds see lies in memory that they share with torch, and is copied once, into the batch.

    Args:
        vec: the worlds. If the critic sees their states, they begin anew in the next step: the
            last state of an episode is gone when they do so in the same.
        network: that decides. Others of the same shape can take its place between two batches.
        num_steps: of a batch.
        seed: of the worlds.
        generator: of the random actions; None: torch's own.

    Attributes:
        vec: the worlds.
        network: that decides.
        trips: how the last ones went.
        clock: where the time went.
    """

    def __init__(
        self,
        vec: CavVectorEnv,
        network: ActorCritic,
        num_steps: int,
        seed: int,
        generator: torch.Generator | None = None,
    ) -> None:
        self.vec = vec
        self.network = network
        self.trips = Trips(vec.num_envs, vec.num_agents)
        self.clock = RunClock()
        self._num_steps = num_steps
        self._generator = generator
        self._sees_states = network.state_size > 0
        infos = vec.reset(seed=seed)[1]
        self._mask = torch.from_numpy(infos["mask"])
        self._observations = torch.from_numpy(vec.worlds.arrays.observations)
        self._states = self._look()

    @torch.inference_mode()
    def collect(self, with_suggested: bool) -> Batch:
        """`num_steps` steps of all worlds, on request with what the built-in driver would do."""
        spent_s = self.clock.spent_s
        began, simulated_s = time.perf_counter(), self.vec.simulated_s
        before_s = sum(spent_s.values())
        batch = self._empty(with_suggested)
        for t in range(self._num_steps):
            self._step(batch, t)
        with self.clock.phase("inference"):
            self._evaluate(batch)
        spent_s["simulation"] += self.vec.simulated_s - simulated_s
        elsewhere_s = sum(spent_s.values()) - before_s
        spent_s["transfer"] += time.perf_counter() - began - elsewhere_s
        return batch

    def _empty(self, with_suggested: bool) -> Batch:
        shape = (self._num_steps, *self._mask.shape)
        continuous = self.network.continuous
        actions = torch.zeros((*shape, 2)) if continuous else torch.zeros(shape, dtype=torch.int64)
        log_probs, values, rewards, next_values = (torch.zeros(shape) for _ in range(4))
        acted, goes_on = (torch.zeros(shape, dtype=torch.bool) for _ in range(2))
        return Batch(
            torch.zeros((*shape, self._observations.shape[-1])),
            torch.zeros((self._num_steps, *self._states.shape)),
            actions,
            log_probs,
            values,
            rewards,
            acted,
            next_values,
            goes_on,
            torch.zeros_like(actions) if with_suggested else None,
        )

    def _step(self, batch: Batch, t: int) -> None:
        """Let the network decide, and write down what is entry `t` of a batch."""
        if batch.suggested is not None:
            with self.clock.phase("simulation"):
                batch.suggested[t] = torch.from_numpy(self.vec.suggest_actions())
        mask, actions = self._mask, batch.actions[t]
        batch.observations[t] = self._observations
        batch.states[t] = self._states
        with self.clock.phase("inference"):
            sampled, log_prob = self.network.sample(batch.observations[t, mask], self._generator)
        actions[mask] = sampled
        batch.log_probs[t, mask] = log_prob
        given = actions.clamp(-1.0, 1.0) if self.network.continuous else actions
        _, reward, ended, cut_off, infos = self.vec.step(given.numpy())
        self._mask = torch.from_numpy(infos["mask"])
        self._states = self._look()
        batch.rewards[t] = torch.from_numpy(reward)
        batch.acted[t] = torch.from_numpy(infos["acted"])
        batch.goes_on[t] = torch.from_numpy(infos["acted"] & infos["mask"] & ~ended & ~cut_off)
        if cut_off.any():
            cut = torch.from_numpy(cut_off)
            last = torch.from_numpy(infos["final_observations"][cut_off])
            batch.next_values[t, cut] = self._value(last, self._states, cut)
        self.trips.add(reward, infos["vehicle_done"], cut_off, infos["terms"])

    def _evaluate(self, batch: Batch) -> None:
        acted, goes_on = batch.acted, batch.goes_on
        batch.values[acted] = self._value(batch.observations[acted], batch.states, acted)
        after, going = torch.zeros(self._mask.shape), goes_on[-1]
        after[going] = self._value(self._observations[going], self._states, going)
        following = torch.cat([batch.values[1:], after[None]])
        batch.next_values = torch.where(goes_on, following, batch.next_values)

    def _value(self, observations: Tensor, states: Tensor, chosen: Tensor) -> Tensor:
        """Of the chosen (…, W, A) observations (N, D), in their worlds' states (…, W, S)."""
        *world, _ = chosen.nonzero(as_tuple=True)
        return self.network.value(observations, states[tuple(world)])

    def _look(self) -> Tensor:
        """States (W, S) of the worlds; S is 0 where the critic does not see them."""
        if not self._sees_states:
            return torch.zeros((self.vec.num_envs, 0))
        with self.clock.phase("simulation"):
            return torch.from_numpy(self.vec.state())
