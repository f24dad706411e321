"""Policies: what maps observations of agents to their actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import flat_observation, flat_observation_space, observation_parts
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv

if TYPE_CHECKING:
    from cavmarl.policies.driver_network import DriverNetwork

Environment = CavEnv | CavVectorEnv


class Policy(ABC):
    """Drives the agents of one environment.

    Args:
        env: where it drives; a `CavEnv` is driven by `act`, a `CavVectorEnv` by `act_batch`.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env

    def reset(self, seed: int | None = None) -> None:  # noqa: B027 - most have nothing to reset
        """Begin anew; `seed` roots the random numbers of a policy that draws any."""

    @abstractmethod
    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Actions of all agents of all worlds.

        Args:
            observations: (W, A, D) flat.
            mask: (W, A) agents that act; the others' actions are not read.

        Returns:
            (W, A, 2) float32 within [-1, 1], or (W, A) int64 choices.
        """

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Actions of the agents of a `CavEnv`, from what its `reset` or `step` returned.

        Agents that have just left are among the observations and get no action.
        """
        env = self.env
        if not isinstance(env, CavEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        index = {agent: k for k, agent in enumerate(env.possible_agents)}
        live = [agent for agent in env.agents if agent in observations]
        size = flat_observation_space(env.config).shape[0]
        names: Iterable[str] = observation_parts(env.config.sensors)
        stack = env.config.sensors.stack
        if env.config.observation.mode == "sensors":
            names, stack = env.config.rig, 1
        batch = np.zeros((1, len(index), size), dtype=np.float32)
        mask = np.zeros((1, len(index)), dtype=np.bool_)
        for agent in live:
            seen = observations[agent]
            batch[0, index[agent]] = (
                flat_observation(names, seen, stack) if isinstance(seen, Mapping) else seen
            )
            mask[0, index[agent]] = True
        actions = self.act_batch(batch, mask)[0]
        return {agent: actions[index[agent]] for agent in live}


class NetworkPolicy(Policy):
    """A trained network, driving by its most likely actions."""

    def __init__(self, env: Environment, network: DriverNetwork) -> None:
        super().__init__(env)
        self.network = network

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """The network's most likely actions where `mask`, 0 elsewhere."""
        if self.network.config.residual:
            proposed = built_in_actions(self.env, mask)
            observations = np.concatenate([observations, proposed], axis=-1)
        best = self.network.best(observations[mask])
        actions = np.zeros((*mask.shape, *best.shape[1:]), dtype=best.dtype)
        actions[mask] = best
        return actions


class SharedPolicy(Policy):
    """Several drivers in one world: agent k is driven by driver k modulo their number."""

    def __init__(self, env: Environment, drivers: Sequence[Policy]) -> None:
        super().__init__(env)
        self.drivers = tuple(drivers)

    def reset(self, seed: int | None = None) -> None:
        """Begin anew, each driver with the same seed."""
        for driver in self.drivers:
            driver.reset(seed)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Each driver's actions of its agents."""
        turn = np.arange(mask.shape[1]) % len(self.drivers)
        actions: NDArray[Any] | None = None
        for k, driver in enumerate(self.drivers):
            own = driver.act_batch(observations, mask & (turn == k))
            if actions is None:
                actions = own.copy()
            else:
                actions[:, turn == k] = own[:, turn == k]
        assert actions is not None
        return actions


def built_in_actions(env: Environment, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """What the built-in driver would do: (W, A, …) as `Policy.act_batch` returns it, to be changed.

    `mask`: (W, A), for its form. Raises PolicyError: actions are numbers of choices.
    """
    if env.config.action.kind != "continuous":
        raise PolicyError(
            f"action.kind = {env.config.action.kind}: this driver gives throttle and steering; "
            "make the environment with overrides={'action.kind': 'continuous'}"
        )
    found = env.suggest_actions()
    if isinstance(env, CavVectorEnv):
        return np.array(found)
    actions = np.zeros((*mask.shape, 2), dtype=np.float32)
    for k, agent in enumerate(env.possible_agents):
        if agent in found:
            actions[0, k] = found[agent]
    return actions
