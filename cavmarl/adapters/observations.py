"""What the views share: the form of observations, keys that views decide, specs with a horizon."""

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
    """Refuse keywords and overrides of a caller that hold keys which the view decides."""
    for key in keys:
        if any(key in mapping for mapping in given if mapping is not None):
            raise ConfigError(
                f"{key}: this view decides it; cavmarl.parallel_env and make_vec leave it to you"
            )


class WithSpec:
    """Base of a view whose spec, which Gymnasium sets, tells the horizon of this very one.

    The ids have none: Gymnasium would cut at it what `max_cycles` or `horizon_s` makes longer.
    """

    _spec: EnvSpec | None = None
    _horizon: int  # in steps

    @property
    def spec(self) -> EnvSpec | None:
        """How it was made; None if not by Gymnasium."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=self._horizon)


class ObservationForm:
    """Leads from flat observations, which `CavVectorEnv` gives, to those of `observation.kind`.

    Args:
        config: the environment.

    Attributes:
        space: of one agent: a flat Box, or a Dict with one Box a sensor.

    Raises:
        ConfigError: samples of sensors in a form that this cannot give.
    """

    def __init__(self, config: EnvConfig) -> None:
        form = config.observation
        if form.mode != "ground_truth" and form.kind != "flat":
            raise ConfigError(
                f"observation.mode = {form.mode!r}, observation.kind = {form.kind!r}: this adapter "
                "gives flat numbers; use observation.kind = flat, or make_vec or parallel_env"
            )
        self.space = observation_space(config)
        self._stack = config.sensors.stack
        self._parts = observation_parts(config.sensors) if form.kind == "dict" else None

    def __call__(self, flat: NDArray[np.float32]) -> Observations:
        """Observations of any number of agents: (…, D) as they are, or (…, *shape) a sensor."""
        if self._parts is None:
            return flat
        frames = flat.reshape(*flat.shape[:-1], self._stack, -1)
        return named_observation(self._parts, frames)
