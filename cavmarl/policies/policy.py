"""Policies: what maps observations to actions, and how a name or a path becomes one.

`agents/` holds the policies that come with cavmarl: `NAME.py` defines `make_policy(env)`; a folder
holds the weights of a trained network. Both are files that are read, not modules that are imported.
"""

from __future__ import annotations

import importlib.util
import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from cavmarl.config.driver_form import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    differing_keys,
    form_of,
    form_of_driver,
)
from cavmarl.config.driver_names import SHIELDED, find_driver, name_of_driver, shared_drivers
from cavmarl.core.errors import PolicyError
from cavmarl.core.tracebacks import fault_in
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


def load_policy(policy: str | Path, env: Environment) -> Policy:
    """Seat a policy in an environment.

    Args:
        policy: a name of `agents/`, a folder with model.safetensors and config.json, or a `.py`
            file that defines `make_policy(env)`; several with `+` between them share the agents by
            turns (`merge_ippo+idm`: agents 0, 2, … and agents 1, 3, …); `shielded:` before a driver
            lets the built-in one act where that would brake harder.
        env: a `CavEnv`, also wrapped, or a `CavVectorEnv`.

    Raises:
        PolicyError: nothing of that name, a broken file, or a network made for other observations
            or actions than this environment's.
    """
    if isinstance(env, ParallelEnv):
        env = env.unwrapped
    if not isinstance(env, CavEnv | CavVectorEnv):
        raise PolicyError(
            f"env is a {type(env).__name__}: pass what parallel_env() or make_vec() returned"
        )
    if parts := shared_drivers(policy):
        return SharedPolicy(env, [load_policy(part, env) for part in parts])
    if isinstance(policy, str) and policy.startswith(SHIELDED):
        from cavmarl.policies.shield import ShieldedPolicy  # it is a `Policy`

        return ShieldedPolicy(env, load_policy(policy.removeprefix(SHIELDED), env))
    path = find_driver(policy)
    if path.is_dir():
        return _load_network_policy(path, env)
    return _load_script(path, env)


def policy_files(policy: str | Path) -> tuple[Path, ...]:
    """The files that make a policy what it is: its script, or its weights and their description."""
    if parts := shared_drivers(policy):
        return tuple(dict.fromkeys(file for part in parts for file in policy_files(part)))
    path = find_driver(policy.removeprefix(SHIELDED) if isinstance(policy, str) else policy)
    if not path.is_dir():
        return (path,)
    files = (path / WEIGHTS_FILE, path / CONFIG_FILE)
    for file in files:
        if not file.is_file():
            raise PolicyError(f"no {file.name} in {path}: not the folder of a trained driver")
    return files


def _load_script(path: Path, env: Environment) -> Policy:
    """Run a `.py` file and let its `make_policy` seat the policy."""
    spec = importlib.util.spec_from_file_location(f"cavmarl_policy_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise PolicyError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the file is the user's: it may raise anything
        raise PolicyError(fault_in(path, error)) from error
    make_policy = getattr(module, "make_policy", None)
    if not inspect.isfunction(make_policy):
        raise PolicyError(f"{path}: defines no function make_policy(env)")
    policy = make_policy(env)
    if not isinstance(policy, Policy):
        raise PolicyError(
            f"{path}: make_policy returned a {type(policy).__name__}, not a cavmarl.Policy"
        )
    return policy


def _load_network_policy(folder: Path, env: Environment) -> NetworkPolicy:
    from cavmarl.policies.driver_network import load_driver_network  # imports pydantic

    network = load_driver_network(folder)
    config, name, here = network.config, name_of_driver(folder), env.config
    size = flat_observation_space(here).shape[0]
    if unlike := differing_keys(form_of(config.sensors, config.action), here):
        lines = (f"{key} is {there} for it, {ours} here" for key, (there, ours) in unlike.items())
        cure = {key: there for key, (there, _) in unlike.items()}
        raise PolicyError(
            f"The policy {name} expects different {_parts(unlike)} from those that this "
            f"environment provides ({'; '.join(lines)}). It observes {config.sensed} numbers, and "
            f"this environment gives {size}. Add --sensors-of {name} to the command, or "
            f"sensors_of={name!r} in Python, or pass these overrides: {cure}"
        )
    if config.sensed != size:
        raise PolicyError(
            f"{name}: observes {config.sensed} numbers, but its sensors give {size} in "
            "this version: train it again"
        )
    return NetworkPolicy(env, network)


def _parts(keys: Iterable[str]) -> str:
    """Return the parts of an environment that the keys belong to, in words."""
    found = {key.partition(".")[0] for key in keys}
    names = {"sensors": "sensors", "action": "actions"}
    return " and ".join(name for key, name in names.items() if key in found)


def driver_keys(policy: str | Path) -> dict[str, Any]:
    """Return what a trained driver sees and does: overrides that make any environment fit for it.

    Raises PolicyError: nothing of that name, or no trained driver.
    """
    return form_of_driver(policy)
