"""A driver for dense single-lane traffic that accelerates so gently that no wave can grow.

Its target speed is slightly below the speed of uniform flow and rises by 0.03 m/s per second; after
a stop it rises hardly faster, and it never exceeds the speed from which it can brake behind the
vehicle ahead. The vehicles behind follow without stopping. In `ring22`, this dissolves the
stop-and-go waves of 21 human drivers; in other environments, it is of no use. It reads the world's
clock, which is not in the sensors, and steers towards a point ahead on its path (pure pursuit:
Coulter 1992). It needs `sensors.ego`, `sensors.route`, `sensors.lanes` and continuous actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.core.math.elementary_arrays import atan2_all
from cavmarl.engine.spaces import observation_parts
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy

MOST_MPS = 4.5
GAIN_MPS2 = 0.03
CATCH_UP_MPS2 = 0.035
BRAKE_MPS2 = 1.5
REACT_S = 0.6
STAND_M = 1.5  # distance between the bumpers of stopped vehicles
WHEELBASE_M = 3.0

# Scales of the features, see the table of any environment's card.
SPEED_SCALE = 40.0
HALF_M = 10.0


class GentlePolicy(Policy):
    """Follows its lane at a scheduled speed.

    Args:
        env: the environment.
    """

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        config = env.config
        parts = observation_parts(config.sensors)
        needed = {"ego", "route", "lanes"}
        if not needed <= parts.keys() or config.action.kind != "continuous":
            raise PolicyError(
                "gentle needs sensors of lanes and route and continuous actions: create the "
                "environment with overrides={'sensors.lanes.range_m': 100.0, "
                "'sensors.route.points': 3, 'action.kind': 'continuous'}"
            )
        self._ego, self._lanes = parts["ego"].place, parts["lanes"].place
        # Use the second point of the route, or its only point.
        at = parts["route"].place.start + 2 * min(1, config.sensors.route.points - 1)
        self._aim = slice(at, at + 2)
        self._aim_scale_m = config.sensors.route.points * config.sensors.route.spacing_m
        self._steering_rad = config.action.steering_rad
        self._frame = sum(part.place.stop - part.place.start for part in parts.values())
        self._accel_mps2 = config.action.acceleration_mps2
        self._tick_s = config.clock.sim_dt_s

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): throttle for the scheduled speed, and steering along the lane."""
        if isinstance(self.env, CavEnv):
            raise PolicyError("act_batch() drives a make_vec; a parallel_env is driven by act()")
        return self._controls(observations)

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions for one world."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        return {
            agent: self._controls(np.asarray(seen)[None, None])[0, 0]
            for agent, seen in observations.items()
            if agent in self.env.agents
        }

    def _controls(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actions (W, A, 2)."""
        newest = observations[..., -self._frame :].astype(np.float64)
        ahead_m, left_m = np.moveaxis(newest[..., self._aim] * self._aim_scale_m, -1, 0)
        squared = np.maximum(ahead_m**2 + left_m**2, 1.0)
        steering = atan2_all(2.0 * WHEELBASE_M * left_m, squared) / self._steering_rad
        controls = np.stack([self._throttle(newest), np.clip(steering, -1.0, 1.0)], axis=-1)
        return controls.astype(np.float32)

    def _throttle(self, newest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the throttle (W, A)."""
        ego, lanes = newest[..., self._ego], newest[..., self._lanes]
        with np.errstate(divide="ignore"):
            gap_m = HALF_M / lanes[..., 0] - HALF_M
        speed = ego[..., 0] * SPEED_SCALE
        front = speed + lanes[..., 1] * SPEED_SCALE
        room_m = gap_m - STAND_M
        safe = np.sqrt(2.0 * BRAKE_MPS2 * np.maximum(room_m, 0.0) + front**2)
        safe = np.where(room_m > 0.0, safe, 0.0)
        seconds = np.asarray(self.env.worlds.ticks())[:, None] * self._tick_s
        due = np.minimum(np.minimum(GAIN_MPS2 * seconds, MOST_MPS), safe)
        wanted = np.minimum(due, speed + CATCH_UP_MPS2 * REACT_S)
        throttle: NDArray[np.float64] = (wanted - speed) / REACT_S / self._accel_mps2
        return np.maximum(throttle, -1.0)


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create the driver."""
    return GentlePolicy(env)
