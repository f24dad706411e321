"""`begin_with`: start a run with a driver's weights if the run has the driver's observations."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import PolicyError
from cavmarl.learning.actor_critic import ActorCritic, load_network
from cavmarl.networks.network_files import CONTINUOUS_ACTIONS, NetworkConfig
from cavmarl.sensors.observed import feature_names

OF_OBSERVATIONS = (
    "mean",
    "deviation",
    "body.0.weight",
    "actor.0.weight",
    "critic.0.weight",
)  # tensors whose last axis begins with the elements of an observation


def begin_with(network: ActorCritic, config: NetworkConfig, folder: Path) -> int:
    """Copy the weights of a driver into a network; return how many decisions they come from.

    Observations that the driver does not have get the weight 0, so that the network first decides
    as the driver does.

    Args:
        network: the initialised network.
        config: its configuration.
        folder: folder of the driver.

    Raises:
        PolicyError: the driver has another form, or needs observations that the run does not have.
    """
    driver, its_config = load_network(folder)
    held = driver.state_dict()
    if its_config.sensors != config.sensors:
        held = _widened(held, network.state_dict(), _columns(its_config, config, folder))
    try:
        network.load_state_dict(held)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise PolicyError(f"--start {folder}: does not fit this run: {reason}") from error
    return its_config.agent_steps


def _names(sensors: SensorsConfig) -> list[tuple[int, str, str]]:
    """Return (age in frames, sensor, feature) of each element of an observation."""
    names, stack = feature_names(sensors), sensors.stack
    return [(stack - 1 - frame, *name) for frame in range(stack) for name in names]


def _columns(driver: NetworkConfig, run: NetworkConfig, folder: Path) -> Tensor:
    """Return the index in a run's observation of each element of a driver's observation."""
    known = {name: k for k, name in enumerate(_names(run.sensors))}
    names = _names(driver.sensors)
    if missing := [name for name in names if name not in known]:
        _, sensor, feature = missing[0]
        raise PolicyError(
            f"--start {folder}: observes {len(missing)} numbers that this run does not, first "
            f"'{feature}' of the sensor '{sensor}'; leave its sensors on"
        )
    columns = [known[name] for name in names]
    if driver.residual:
        columns += range(run.observation_size - CONTINUOUS_ACTIONS, run.observation_size)
    return torch.tensor(columns)


def _widened(
    held: dict[str, Tensor], wanted: dict[str, Tensor], columns: Tensor
) -> dict[str, Tensor]:
    """Widen a driver's tensors to longer observations; a critic's state stays at the end."""
    found = dict(held)
    for name in held.keys() & wanted.keys() & set(OF_OBSERVATIONS):
        old, size = held[name], wanted[name].shape[-1]
        state = torch.arange(size - (old.shape[-1] - len(columns)), size)
        found[name] = torch.full(
            (*old.shape[:-1], size), 1.0 if name == "deviation" else 0.0, dtype=old.dtype
        )
        found[name][..., torch.cat([columns, state])] = old
    return found
