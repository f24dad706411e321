"""`Collector`: drives worlds with a network and keeps what comes of it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavmarl.config.env import TERMS
from cavmarl.env.vector import CavVectorEnv
from cavmarl.learning.batch import Batch
from cavmarl.learning.checkpoint import Parts, bytes_of, tensor_of
from cavmarl.learning.log import WINDOW
from cavmarl.parallel.local_worlds import kept_elsewhere
from cavmarl.policies.networks import ActorCritic

# Worlds that step; what goes between them and the tensors; what the network decides; the updates.
PHASES = ("simulation", "transfer", "inference", "learning")
ARRIVAL, COLLISION, OFF_ROAD = (TERMS.index(t) for t in ("arrival", "collision", "off_road"))


class RunClock:
    """Adds up wall time by phase."""

    def __init__(self) -> None:
        self.spent_s = dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """The time of a block goes to this phase; not to be nested."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.spent_s[name] += time.perf_counter() - began

    def take(self) -> dict[str, float]:
        """What has been spent since this was last asked."""
        taken, self.spent_s = self.spent_s, dict.fromkeys(PHASES, 0.0)
        return taken


class Trips:
    """Returns and ends of the last `WINDOW` trips, and those under way in W worlds, A agents."""

    def __init__(self, num_envs: int, num_agents: int) -> None:
        self._returns = np.zeros((num_envs, num_agents))
        self._ended: deque[list[float]] = deque(maxlen=WINDOW)
        self._count = 0

    def add(
        self, rewards: NDArray[Any], done: NDArray[Any], cut: NDArray[Any], terms: NDArray[Any]
    ) -> None:
        """Take in one step; `done` (W, A) ends trips, `cut` (W, A) forgets them."""
        self._returns += rewards
        ends = terms[done][:, [ARRIVAL, COLLISION, OFF_ROAD]]
        self._ended.extend(np.column_stack([self._returns[done], ends]).tolist())
        self._count += len(ends)
        self._returns[done | cut] = 0.0

    def save(self) -> Parts:
        returns = torch.from_numpy(self._returns)
        return {"returns": returns, "ended": list(self._ended), "count": self._count}

    def load(self, saved: Parts) -> None:
        self._returns[:] = saved["returns"].numpy()
        self._ended.extend(saved["ended"])
        self._count = saved["count"]

    def means(self) -> dict[str, float]:
        """Of the last trips; and how many there have been."""
        names = ("trip_return", "success", "collision", "off_road")
        columns = np.array(self._ended).mean(axis=0) if self._ended else np.full(4, np.nan)
        return {"trips": self._count, **dict(zip(names, columns.tolist(), strict=True))}


class Collector:
    """Drives the worlds with a network and keeps what comes of it.

    What worlds see lies in memory that they share with torch, and is copied once, into the batch.
    If the critic sees their states, they begin anew in the next step: the last state of an episode
    is gone when they do so in the same. Other networks of the same shape can take the place of
    `network` between two batches. Random actions are drawn by `generator`; None: by torch's own.
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

    def save(self) -> Parts:
        """Where worlds, trips and the random numbers of its own stand; not those of torch."""
        generator = None if self._generator is None else self._generator.get_state()
        kept = {"trips": self.trips.save(), "generator": generator}
        if kept_elsewhere(self.vec.config):
            return kept
        return {**kept, "worlds": tensor_of(self.vec.save_state()), "mask": self._mask.clone()}

    def load(self, saved: Parts) -> None:
        """Go on from what `save` gave; worlds that it could not save have begun new episodes."""
        self.trips.load(saved["trips"])
        if self._generator is not None:
            self._generator.set_state(saved["generator"])
        if "worlds" in saved:
            self.vec.load_state(bytes_of(saved["worlds"]))
            self._mask = saved["mask"]
            self._states = self._look()

    def _empty(self, with_suggested: bool) -> Batch:
        shape = (self._num_steps, *self._mask.shape)
        continuous = self.network.continuous
        actions = torch.zeros((*shape, 2)) if continuous else torch.zeros(shape, dtype=torch.int64)
        log_probs, values, rewards, next_values = (torch.zeros(shape) for _ in range(4))
        acted, goes_on = (torch.zeros(shape, dtype=torch.bool) for _ in range(2))
        observations = torch.zeros((*shape, self._observations.shape[-1]))
        states = torch.zeros((self._num_steps, *self._states.shape))
        suggested = torch.zeros_like(actions) if with_suggested else None
        return Batch(
            observations, states, actions, log_probs, values, rewards, acted, next_values, goes_on,
            suggested,
        )  # fmt: skip

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
