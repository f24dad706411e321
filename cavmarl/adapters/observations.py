"""Parts shared by the adapters (views of worlds for other libraries).

The form of observations, keys that a view sets itself, and specs with a horizon.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.spaces import named_observation, observation_parts, observation_space

Observations = NDArray[np.float32] | dict[str, NDArray[Any]]


def refuse_decided(keys: Iterable[str], *given: Mapping[str, Any] | None) -> None:
    """Raise an error if arguments or overrides have keys that the view sets itself."""
    for key in keys:
        if any(key in mapping for mapping in given if mapping is not None):
            raise ConfigError(
                f"{key}: this view sets it; use cavmarl.parallel_env or make_vec to choose it"
            )


class WithSpec:
    """Base of a view whose Gymnasium spec has the horizon of the environment.

    The registered ids have no horizon: with one, Gymnasium would truncate episodes that `overrides`
    make longer.
    """

    _spec: EnvSpec | None = None
    _horizon: int  # in steps

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec; None if Gymnasium did not make this object."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=self._horizon)


def refuse_signal_agents(config: EnvConfig, what: str = "this adapter") -> None:
    """Raise a ConfigError if signals have agents, which `what` would ignore."""
    if refusal := config.refusal_of_agents(what):
        raise ConfigError(refusal)


class ObservationForm:
    """Converts flat observations of `CavVectorEnv` to the form of `observation.kind`.

    Args:
        config: configuration of the environment.

    Attributes:
        space: space of one agent: a flat Box, or a Dict with one Box per sensor.

    Raises:
        ConfigError: the observations are sensor samples in a form that is not supported.
    """

    def __init__(self, config: EnvConfig) -> None:
        form = config.observation
        if form.mode != "ground_truth" and form.kind != "flat":
            raise ConfigError(
                f"observation.mode = {form.mode!r}, observation.kind = {form.kind!r}: this adapter "
                "supports flat numbers; use observation.kind = flat, or make_vec or parallel_env"
            )
        self.space = observation_space(config)
        self._stack = config.sensors.stack
        self._parts = observation_parts(config.sensors) if form.kind == "dict" else None

    def __call__(self, flat: NDArray[np.float32]) -> Observations:
        """Return observations of any number of agents: (…, D), or (…, *shape) for each sensor."""
        if self._parts is None:
            return flat
        frames = flat.reshape(*flat.shape[:-1], self._stack, -1)
        return named_observation(self._parts, frames)
