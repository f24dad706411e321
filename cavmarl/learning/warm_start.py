"""`begin_with`: start a run with a driver's weights, also if their observations differ."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from torch import Tensor

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import PolicyError
from cavmarl.learning.actor_critic import ActorCritic, load_network
from cavmarl.networks.network_files import CONTINUOUS_ACTIONS, NetworkConfig
from cavmarl.sensors.observed import feature_names

log = logging.getLogger(__name__)

OF_OBSERVATIONS = (
    "mean",
    "deviation",
    "body.0.weight",
    "actor.0.weight",
    "critic.0.weight",
)  # tensors whose last axis begins with the elements of an observation


def begin_with(network: ActorCritic, config: NetworkConfig, folder: Path) -> int:
    """Copy a driver's weights into a network; return how many decisions the driver learned from.

    Observations that the driver does not have get the weight 0, so that the network first decides
    like the driver. Observations that the run does not have are left out and logged. The network
    then first decides as the driver does when these observations have their mean values.

    Args:
        network: the initialised network.
        config: its configuration.
        folder: folder of the driver.

    Raises:
        PolicyError: the driver has another architecture or another kind of action.
    """
    driver, its_config = load_network(folder)
    held = driver.state_dict()
    if its_config.sensors != config.sensors:
        held = _fitted(held, network.state_dict(), *_columns(its_config, config, folder))
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


def _columns(driver: NetworkConfig, run: NetworkConfig, folder: Path) -> tuple[Tensor, Tensor]:
    """Return the indices, in the driver's and the run's array, of the numbers that both observe."""
    known = {name: k for k, name in enumerate(_names(run.sensors))}
    names = _names(driver.sensors)
    kept = [k for k, name in enumerate(names) if name in known]
    if missing := [name for name in names if name not in known]:
        _, sensor, feature = missing[0]
        log.warning(
            "--start %s: the driver observes %d numbers that this run does not, first '%s' of the "
            "sensor '%s'; the run starts without them",
            folder, len(missing), feature, sensor,
        )  # fmt: skip
    columns = [known[names[k]] for k in kept]
    if driver.residual:
        kept += range(len(names), len(names) + CONTINUOUS_ACTIONS)
        columns += range(run.observation_size - CONTINUOUS_ACTIONS, run.observation_size)
    return torch.tensor(kept), torch.tensor(columns)


def _fitted(
    held: dict[str, Tensor], wanted: dict[str, Tensor], kept: Tensor, columns: Tensor
) -> dict[str, Tensor]:
    """Fit a driver's tensors to other observations; a critic's state stays at the end."""
    found = dict(held)
    observed = held["mean"].shape[-1]
    for name in held.keys() & wanted.keys() & set(OF_OBSERVATIONS):
        old, size = held[name], wanted[name].shape[-1]
        num_states = old.shape[-1] - observed
        found[name] = torch.full(
            (*old.shape[:-1], size), 1.0 if name == "deviation" else 0.0, dtype=old.dtype
        )
        found[name][..., columns] = old[..., kept]
        found[name][..., size - num_states :] = old[..., observed:]
    return found
