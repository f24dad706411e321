"""Policies: map observations of agents to actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import (
    flat_observation,
    flat_observation_space,
    frames_space,
    observation_parts,
)
from cavmarl.env.parallel import CavEnv
from cavmarl.env.roadside_agents import VEHICLES
from cavmarl.env.vector import CavVectorEnv

if TYPE_CHECKING:
    from cavmarl.networks.driver_network import DriverNetwork
    from cavmarl.policies.other_side import OtherSide

Environment = CavEnv | CavVectorEnv


class Policy(ABC):
    """Drives the vehicles of the agents of one environment.

    Args:
        env: environment of the policy; `act` is for a `CavEnv`, `act_batch` for a `CavVectorEnv`.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env

    @cached_property
    def _nothing(self) -> dict[str, NDArray[np.float64]]:
        """Zeros by sensor, which replace the sensors that a vehicle of a fleet does not carry."""
        config = self.env.config
        if not (config.population.fleet and config.observation.mode == "sensors"):
            return {}
        spaces = frames_space(config).spaces
        return {name: np.zeros(box.shape or ()) for name, box in spaces.items()}

    def reset(self, seed: int | None = None) -> None:  # noqa: B027 - most have nothing to reset
        """Start a new episode; `seed` seeds the random numbers of policies that use them."""

    @abstractmethod
    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the actions of all agents of all worlds.

        Args:
            observations: (W, A, D) worlds, agents, numbers per observation; flat.
            mask: (W, A) agents that act; other actions are ignored.

        Returns:
            (W, A, 2) float32 within [-1, 1], or (W, A) int64 choices.
        """

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions of a `CavEnv`'s agents for the observations of `reset` or `step`.

        Agents that have just left are among the observations and get no action.
        """
        env = self.env
        if not isinstance(env, CavEnv):
            raise PolicyError("act() needs a parallel_env; use act_batch() with a make_vec")
        vehicles = env.possible_agents[: env.config.population.num_ids]
        index = {agent: k for k, agent in enumerate(vehicles)}
        live = [agent for agent in env.agents if agent in index and agent in observations]
        size = flat_observation_space(env.config).shape[0]
        names: Iterable[str] = observation_parts(env.config.sensors)
        stack = env.config.sensors.stack
        if env.config.observation.mode == "sensors":
            names, stack = env.config.rig, 1
        batch = np.zeros((1, len(index), size), dtype=np.float32)
        mask = np.zeros((1, len(index)), dtype=np.bool_)
        for agent in live:
            seen = observations[agent]
            if isinstance(seen, Mapping):
                seen = flat_observation(names, {**self._nothing, **seen}, stack)
            batch[0, index[agent]] = seen
            mask[0, index[agent]] = True
        actions = self.act_batch(batch, mask)[0]
        return {agent: actions[index[agent]] for agent in live}


class NetworkPolicy(Policy):
    """A trained network that drives with its most likely actions.

    Args:
        env: environment of the policy.
        network: the network.
        other_side: exchanges left and right, if the network was trained on maps with traffic on the
            other side of the road.
    """

    def __init__(
        self, env: Environment, network: DriverNetwork, other_side: OtherSide | None = None
    ) -> None:
        super().__init__(env)
        self.network = network
        self._other_side = other_side

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the network's most likely actions where `mask` is set, else 0."""
        exchange = self._other_side
        if exchange is not None:
            observations = exchange.observations(observations)
        if self.network.config.residual:
            proposed = built_in_actions(self.env, mask)
            if exchange is not None:
                proposed = exchange.actions(proposed)
            observations = np.concatenate([observations, proposed], axis=-1)
        best = self.network.best(observations[mask])
        if exchange is not None:
            best = exchange.actions(best)
        actions = np.zeros((*mask.shape, *best.shape[1:]), dtype=best.dtype)
        actions[mask] = best
        return actions


class SharedPolicy(Policy):
    """Several drivers in one world.

    Args:
        env: the environment.
        drivers: the drivers.
        turns: index of each agent's driver; None: agent k has driver k modulo their number.
    """

    def __init__(
        self, env: Environment, drivers: Sequence[Policy], turns: Sequence[int] | None = None
    ) -> None:
        super().__init__(env)
        self.drivers = tuple(drivers)
        in_turn = np.arange(env.config.population.num_ids) % len(self.drivers)
        self._turns = in_turn if turns is None else np.array(turns, dtype=np.int64)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; all drivers get the same seed."""
        for driver in self.drivers:
            driver.reset(seed)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return each driver's actions for its agents."""
        turn = self._turns
        actions: NDArray[Any] | None = None
        for k, driver in enumerate(self.drivers):
            own = driver.act_batch(observations, mask & (turn == k))
            if actions is None:
                actions = own.copy()
            else:
                actions[:, turn == k] = own[:, turn == k]
        assert actions is not None
        return actions


def suggested(env: Environment) -> Any:
    """Return the built-in driver's actions: an array (W, A, …), or for a `CavEnv` a dict."""
    found = env.suggest_actions()
    if isinstance(env, CavVectorEnv):
        return found[VEHICLES] if isinstance(found, dict) else found
    vehicles = env.possible_agents[: env.config.population.num_ids]
    return {agent: found[agent] for agent in vehicles if agent in found}


def built_in_actions(env: Environment, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return the built-in driver's actions: a new array (W, A, …) as in `Policy.act_batch`.

    `mask`: (W, A), defines the shape. Raises PolicyError: actions are discrete.
    """
    if env.config.action.kind != "continuous":
        raise PolicyError(
            f"action.kind = {env.config.action.kind}: this driver needs throttle and steering; "
            "make the environment with overrides={'action.kind': 'continuous'}"
        )
    found = suggested(env)
    if isinstance(env, CavVectorEnv):
        return np.array(found)
    actions = np.zeros((*mask.shape, 2), dtype=np.float32)
    for k, agent in enumerate(env.possible_agents[: mask.shape[1]]):
        if agent in found:
            actions[0, k] = found[agent]
    return actions
