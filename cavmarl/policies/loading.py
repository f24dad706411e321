"""Loading of policies: a name or a path becomes a policy that drives in an environment.

`agents/` contains the policies of cavmarl: `NAME.py` defines `make_policy(env)`; a folder
holds the weights of a trained network. Both are files that are read, not modules that are imported.
"""

from __future__ import annotations

import importlib.util
import inspect
from pathlib import Path
from typing import Any

from pettingzoo import ParallelEnv

from cavmarl.config.driver_form import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    form_of_driver,
)
from cavmarl.config.driver_names import SHIELDED, find_driver, name_of_driver, shared_drivers
from cavmarl.core.errors import PolicyError
from cavmarl.core.tracebacks import fault_in
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.driver_fit import check_fit
from cavmarl.policies.map_check import meet_map
from cavmarl.policies.model_files import make_policy, model_files
from cavmarl.policies.policy import Environment, NetworkPolicy, Policy, SharedPolicy
from cavmarl.policies.shield import ShieldedPolicy


def load_policy(policy: str | Path, env: Environment, *, beside_signals: bool = False) -> Policy:
    """Load a policy for an environment.

    Args:
        policy: a name of `agents/`, a folder with model.safetensors and config.json, a `.py` file
            that defines `make_policy(env)`, or a model file of stable-baselines3 (`.zip`),
            TorchScript (`.pt`, `.ts`) or ONNX (`.onnx`); see docs/guides/evaluate.md. Policies
            joined by `+` share the agents in turn (`merge_ippo+idm`: agents 0, 2, … and agents 1,
            3, …). With the prefix `shielded:`, the built-in driver acts instead of the policy
            whenever it would brake harder.
        env: a `CavEnv`, possibly wrapped, or a `CavVectorEnv`.
        beside_signals: whether the caller itself acts for the agents of signals, if there are any.

    Raises:
        PolicyError: the policy does not exist, a file is broken, or a network was made for other
            observations or actions than this environment's, or for the other side of the road with
            sensors that cannot be mirrored; or signals have agents for which nothing acts.
        MissingExtraError: the library of a model file is not installed.

    Warns:
        UntrainedMapWarning: a trained driver was not trained on maps of this kind.
    """
    if isinstance(env, ParallelEnv):
        env = env.unwrapped
    if not isinstance(env, CavEnv | CavVectorEnv):
        raise PolicyError(
            f"env is a {type(env).__name__}: pass what parallel_env() or make_vec() returned"
        )
    refusal = env.config.refusal_of_agents("a policy")
    if refusal and not beside_signals:
        raise PolicyError(f"{refusal}, or load_policy(…, beside_signals=True)")
    return _load(policy, env)


def _load(policy: str | Path, env: Environment) -> Policy:
    if parts := shared_drivers(policy):
        return SharedPolicy(env, [_load(part, env) for part in parts])
    if isinstance(policy, str) and policy.startswith(SHIELDED):
        return ShieldedPolicy(env, _load(policy.removeprefix(SHIELDED), env))
    path = find_driver(policy)
    if path.is_dir():
        return _load_network_policy(path, env)
    if path.suffix != ".py":
        return make_policy(path, env)
    return _load_script(path, env)


def policy_files(policy: str | Path) -> tuple[Path, ...]:
    """Return the files of a policy: its script or model, or its weights and configuration."""
    if parts := shared_drivers(policy):
        return tuple(dict.fromkeys(file for part in parts for file in policy_files(part)))
    path = find_driver(policy.removeprefix(SHIELDED) if isinstance(policy, str) else policy)
    if not path.is_dir():
        return model_files(path)
    files = (path / WEIGHTS_FILE, path / CONFIG_FILE)
    for file in files:
        if not file.is_file():
            raise PolicyError(f"no {file.name} in {path}; give the folder of a trained driver")
    return files


def _load_script(path: Path, env: Environment) -> Policy:
    """Run a `.py` file and let its `make_policy` make the policy."""
    spec = importlib.util.spec_from_file_location(f"cavmarl_policy_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise PolicyError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the user's file may raise any exception
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
    from cavmarl.networks.driver_network import load_driver_network  # imports pydantic

    network, name = load_driver_network(folder), name_of_driver(folder)
    check_fit(network.config, env.config, name, name)
    return NetworkPolicy(env, network, meet_map(env, name, network.config.maps))


def driver_keys(policy: str | Path) -> dict[str, Any]:
    """Return the overrides that give an environment a driver's sensors and actions.

    Raises PolicyError: the driver does not exist, or is not a trained driver.
    """
    return form_of_driver(policy)
