"""A driver for dense traffic on one lane that speeds up so gently that no wave can grow.

It drives towards a little less than the speed of uniform flow, by 0.03 m/s more each second, and
never faster than it can brake behind the vehicle ahead. Those behind follow without a stop. In
`ring22` this dissolves the stop and go of 21 human drivers; elsewhere it is of no use. It reads the
world's clock, which no sensor shows, and steers by the built-in driver's suggestions. It needs
`sensors.ego`, `sensors.lanes` and continuous actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import observation_parts
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy

MOST_MPS = 4.5
GAIN_MPS2 = 0.03
BRAKE_MPS2 = 1.5
REACT_S = 0.6
STAND_M = 1.5  # between the bumpers

# Scales of the features, see the table of any environment's card.
SPEED_SCALE = 40.0
HALF_M = 10.0


class GentlePolicy(Policy):
    """Steers as the built-in driver does, and asks for the speed that is due.

    Args:
        env: where it drives.
    """

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        config = env.config
        parts = observation_parts(config.sensors)
        if not {"ego", "lanes"} <= parts.keys() or config.action.kind != "continuous":
            raise PolicyError(
                "gentle needs a look at lanes and continuous actions: make the environment with "
                "overrides={'sensors.lanes.range_m': 100.0, 'action.kind': 'continuous'}"
            )
        self._ego, self._lanes = parts["ego"].place, parts["lanes"].place
        self._frame = sum(part.place.stop - part.place.start for part in parts.values())
        self._accel_mps2 = config.action.acceleration_mps2
        self._tick_s = config.clock.sim_dt_s

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """(W, A, 2): the built-in driver's steering, and the throttle for the speed that is due."""
        if isinstance(self.env, CavEnv):
            raise PolicyError("act_batch() drives a make_vec; a parallel_env is driven by act()")
        actions = cast(NDArray[Any], self.env.suggest_actions()).copy()
        actions[..., 0] = self._throttle(observations)
        return actions

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """The same for one world."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        actions = self.env.suggest_actions()
        for agent, action in actions.items():
            action[0] = self._throttle(np.asarray(observations[agent])[None, None])[0, 0]
        return actions

    def _throttle(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """(W, A)."""
        newest = observations[..., -self._frame :].astype(np.float64)
        ego, lanes = newest[..., self._ego], newest[..., self._lanes]
        with np.errstate(divide="ignore"):
            gap_m = HALF_M / lanes[..., 0] - HALF_M
        speed = ego[..., 0] * SPEED_SCALE
        front = speed + lanes[..., 1] * SPEED_SCALE
        room_m = gap_m - STAND_M
        safe = np.sqrt(2.0 * BRAKE_MPS2 * np.maximum(room_m, 0.0) + front**2)
        safe = np.where(room_m > 0.0, safe, 0.0)
        seconds = np.asarray(self.env.worlds.ticks())[:, None] * self._tick_s
        wanted = np.minimum(np.minimum(GAIN_MPS2 * seconds, MOST_MPS), safe)
        throttle: NDArray[np.float64] = (wanted - speed) / REACT_S / self._accel_mps2
        return np.clip(throttle, -1.0, 0.5)


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Seat the driver."""
    return GentlePolicy(env)
