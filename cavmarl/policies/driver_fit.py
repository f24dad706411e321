"""Checks whether a trained driver fits the sensors and actions of an environment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from cavmarl.config.driver_form import differing_keys, form_of
from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import flat_observation_space

if TYPE_CHECKING:
    from cavmarl.networks.network_files import NetworkConfig


def check_fit(config: NetworkConfig, here: EnvConfig, name: str, driver: str) -> None:
    """Raise an error if a network was trained with other sensors or actions.

    Args:
        config: configuration of the network.
        here: configuration of the environment.
        name: name of the network in messages.
        driver: argument of `--sensors-of` that gives an environment the sensors of the network.

    Raises:
        PolicyError: the network does not fit; the message lists keys, values and the remedy.
    """
    size = flat_observation_space(here).shape[0]
    if unlike := differing_keys(form_of(config.sensors, config.action), here):
        lines = (f"{key} is {there} for it, {ours} here" for key, (there, ours) in unlike.items())
        cure = {key: there for key, (there, _) in unlike.items()}
        raise PolicyError(
            f"The policy {name} expects different {_parts(unlike)} than this "
            f"environment provides ({'; '.join(lines)}). It observes {config.sensed} numbers, and "
            f"this environment gives {size}. Add --sensors-of {driver} to the command, or "
            f"sensors_of={driver!r} in Python, or pass these overrides: {cure}"
        )
    if config.sensed != size:
        raise PolicyError(
            f"{name}: observes {config.sensed} numbers, but its sensors give {size} in "
            "this version; train it again"
        )


def _parts(keys: Iterable[str]) -> str:
    """Return the parts of an environment that the keys belong to, in words."""
    found = {key.partition(".")[0] for key in keys}
    names = {"sensors": "sensors", "action": "actions"}
    return " and ".join(name for key, name in names.items() if key in found)
