"""Observations with left and right exchanged, as in the mirrored world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.observed import sensors_of


def exchange_sides(config: SensorsConfig) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return how to exchange left and right in a flat observation: `seen[..., index] * sign`.

    The exchange is its own inverse. It follows from the `Sides` of each sensor.

    Raises:
        ConfigError: a sensor in use does not define the exchange, or its settings do not allow it.
    """
    index: list[int] = []
    sign: list[float] = []
    for sensor in sensors_of(config):
        names = [feature.name for feature in sensor.features(config)]
        if not names:
            continue
        if sensor.sides is None:
            raise ConfigError(
                f"sensors.{sensor.name}: left and right cannot be exchanged in its features"
            )
        if reason := sensor.sides.refusal(config):
            raise ConfigError(f"sensors.{sensor.name}: {reason}")
        start = len(index)
        places = {name: start + k for k, name in enumerate(names)}
        index += [places[sensor.sides.partner(config, name)] for name in names]
        sign += [-1.0 if sensor.sides.is_negated(name) else 1.0 for name in names]
    size = len(index)
    frames = size * np.arange(config.stack, dtype=np.intp)
    whole = (frames[:, None] + np.array(index, dtype=np.intp)).ravel()
    return whole, np.tile(np.array(sign, dtype=np.float32), config.stack)
