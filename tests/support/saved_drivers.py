"""Saved untrained drivers for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cavmarl.env.vector import CavVectorEnv, make_vec


def small_vec(**overrides: Any) -> CavVectorEnv:
    """Return two worlds of `merge`; `a__b` is the key `a.b`."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return make_vec("merge", num_envs=2, agents=3, background=4, overrides=keys)


def save_driver(folder: Path, vec: CavVectorEnv, **form: Any) -> Path:
    """Save an untrained driver for an environment; `form` sets fields of `NetworkConfig`."""
    import torch

    from cavmarl.learning.actor_critic import ActorCritic, save_network
    from cavmarl.networks.network_files import NetworkConfig

    torch.manual_seed(0)
    config = NetworkConfig(
        environment=vec.config.name,
        observation_size=vec.single_observation_space.shape[0] + 2 * form.get("residual", False),
        sensors=vec.config.sensors,
        action=vec.config.action,
        **{"hidden": (8, 8)} | form,
    )
    save_network(folder, ActorCritic(config), config)
    return folder
