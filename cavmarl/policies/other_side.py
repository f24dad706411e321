"""`OtherSide`: lets a trained driver drive on the other side of the road.

A driver that was trained in right-hand traffic sees a left-hand map as its mirror image: left and
right are exchanged in its observations, and in its actions. The reverse holds for a driver that was
trained in left-hand traffic.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.core.records.codes import ACTION_LANE_LEFT, ACTION_LANE_RIGHT
from cavmarl.sensors.observed.exchanged_sides import exchange_sides


class OtherSide:
    """Exchanges left and right in observations and actions; applied twice, it changes nothing.

    Args:
        config: the environment.

    Raises:
        PolicyError: left and right cannot be exchanged in its observations or actions.
    """

    def __init__(self, config: EnvConfig) -> None:
        if config.observation.mode == "sensors":
            raise PolicyError(
                "observation.mode = sensors: samples of mounted sensors cannot be mirrored; use a "
                "driver that was trained on this side of the road"
            )
        try:
            self._index, self._sign = exchange_sides(config.sensors)
        except ConfigError as error:
            raise PolicyError(
                f"{error}; use a driver that was trained on this side of the road, or other sensors"
            ) from error
        self._choices = _exchanged_choices(config.action)

    def observations(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return observations (…, D) with left and right exchanged."""
        exchanged: NDArray[np.float32] = seen[..., self._index] * self._sign
        exchanged += np.float32(0.0)  # turns -0.0 into 0.0
        return exchanged

    def actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return actions with left and right exchanged: pairs (…, 2), or choices (…)."""
        if self._choices is not None:
            chosen: NDArray[Any] = self._choices[actions]
            return chosen
        exchanged = actions.copy()
        exchanged[..., 1] = 0.0 - actions[..., 1]
        return exchanged


def _exchanged_choices(action: ActionConfig) -> NDArray[np.int64] | None:
    """Return the mirror image of each choice; None: actions are not choices."""
    if action.kind == "continuous":
        return None
    choices = np.arange(action.choices, dtype=np.int64)
    if action.kind == "discrete":
        choices[[ACTION_LANE_LEFT, ACTION_LANE_RIGHT]] = ACTION_LANE_RIGHT, ACTION_LANE_LEFT
        return choices
    steering = action.grid_steering
    if tuple(-angle for angle in reversed(steering)) != steering:
        raise PolicyError(
            f"action.grid_steering = {list(steering)}: is not symmetric, so that actions cannot "
            "be mirrored; use a driver that was trained on this side of the "
            "road"
        )
    return choices.reshape(-1, len(steering))[:, ::-1].ravel()
