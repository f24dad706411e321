"""Cooperative adaptive cruise control: car following by messages of the vehicle ahead.

The driver steers, stops and yields like the built-in driver, and is as careful near junctions.
Behind a vehicle whose messages it receives, it uses the acceleration of van Arem, van Driel,
Visser: "The impact of cooperative adaptive cruise control on traffic-flow characteristics", IEEE
Trans. ITS 7 (4), 2006. A radar measures gap and relative speed (the sensor `lanes`). A radar cannot
measure the acceleration of the vehicle ahead in time, so messages transmit it (the sensor
`messages`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.engine.spaces import observation_parts
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy, suggested

SPEED_GAIN = 1.0  # 1/s, towards the limit
ACCEL_GAIN = 1.0
APPROACH_GAIN = 0.58  # 1/s
GAP_GAIN = 0.1  # 1/s²
HEADWAY_S = 0.5  # behind a vehicle that sends its acceleration
MIN_GAP_M = 2.0
SAME_M = 4.0  # a message and a measurement within this distance belong to the same vehicle

# Scales of the features, see the table of any environment's card.
SPEED_SCALE = 40.0
ACCEL_SCALE = 10.0
LENGTH_SCALE = 20.0
HALF_M = 10.0
OBJECT_FEATURES = 11
LANE_CHANGE = 9  # index in the features of `ego`
CROSSING = 10  # index in the features of `lanes`
OWN_LENGTH_M = 5.0

NEEDED = {
    "v2x.enabled": True,
    "sensors.messages.objects": 8,
    "sensors.lanes.range_m": 100.0,
    "sensors.signal.enabled": True,
    "sensors.ego.enabled": True,
    "action.kind": "continuous",
}


class CaccPolicy(Policy):
    """Follows senders of messages by CACC, and otherwise drives like the built-in driver.

    Args:
        env: the environment.
    """

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        config = env.config
        parts = observation_parts(config.sensors)
        if (
            not {"ego", "signal", "lanes", "messages"} <= parts.keys()
            or config.sensors.messages.objects == 0
            or config.action.kind != "continuous"
        ):
            raise PolicyError(
                f"cacc needs messages, sensors of lanes and signals, and continuous "
                f"actions: create the environment with overrides={NEEDED}"
            )
        self._places = {name: part.place for name, part in parts.items()}
        self._frame = sum(place.stop - place.start for place in self._places.values())
        self._scale_m = config.sensors.messages.range_m
        self._objects = config.sensors.messages.objects
        self._accel_mps2 = config.action.acceleration_mps2

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): the built-in driver's steering, and the throttle of either driver."""
        newest = observations[..., -self._frame :].astype(np.float64)
        actions: NDArray[Any] = self._suggested(mask.shape).copy()
        follows, accel = self._follow(newest)
        followed = np.clip(accel / self._accel_mps2, -1.0, 1.0)
        # Other vehicles matter near junctions, too, so use the more careful throttle.
        careful = np.minimum(followed, actions[..., 0])
        throttle = np.where(self._near_others(newest), careful, followed)
        actions[..., 0] = np.where(follows, throttle, actions[..., 0])
        return actions.astype(np.float32)

    def _suggested(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the built-in driver's actions, (W, A, 2)."""
        found = suggested(self.env)
        if not isinstance(found, dict):
            return np.asarray(found)
        actions = np.zeros((*shape, 2), dtype=np.float32)
        for agent, action in found.items():
            actions[0, self.env.possible_agents.index(agent)] = action
        return actions

    def _part(self, newest: NDArray[np.float64], name: str) -> NDArray[np.float64]:
        part: NDArray[np.float64] = newest[..., self._places[name]]
        return part

    def _near_others(self, newest: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (W, A) whether a line, a crossing vehicle or a lane change is ahead."""
        ego, signal = self._part(newest, "ego"), self._part(newest, "signal")
        crossing = self._part(newest, "lanes")[..., CROSSING]
        found: NDArray[np.bool_] = (
            (signal[..., 0] > 0.0) | (crossing > 0.0) | (ego[..., LANE_CHANGE] != 0.0)
        )
        return found

    def _gap_m(self, newest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gap (W, A) to the vehicle ahead on the ego path; inf: none in range."""
        closeness = self._part(newest, "lanes")[..., 0]
        with np.errstate(divide="ignore"):
            gap: NDArray[np.float64] = HALF_M / closeness - HALF_M
        return gap

    def _follow(self, newest: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return (W, A) whether the vehicle ahead sends, and the acceleration behind it."""
        ego, lanes = self._part(newest, "ego"), self._part(newest, "lanes")
        gap_m = self._gap_m(newest)
        reports = self._part(newest, "messages")[..., : self._objects * OBJECT_FEATURES]
        reports = reports.reshape(*reports.shape[:-1], self._objects, OBJECT_FEATURES)
        centre_m = hypot_all(reports[..., 1], reports[..., 2]) * self._scale_m
        between_m = centre_m - 0.5 * (reports[..., 8] * LENGTH_SCALE + OWN_LENGTH_M)
        ahead = (reports[..., 0] > 0.0) & (reports[..., 1] > 0.0) & (reports[..., 10] > 0.0)
        with np.errstate(invalid="ignore"):
            off_m = np.where(ahead, np.abs(between_m - gap_m[..., None]), np.inf)
        which = np.argmin(off_m, axis=-1)[..., None]
        follows = np.take_along_axis(off_m, which, axis=-1)[..., 0] < SAME_M
        accel = np.take_along_axis(reports[..., 7], which, axis=-1)[..., 0] * ACCEL_SCALE
        speed = ego[..., 0] * SPEED_SCALE
        wanted_m = np.maximum(HEADWAY_S * speed, MIN_GAP_M)
        cooperative = (
            ACCEL_GAIN * accel
            + APPROACH_GAIN * lanes[..., 1] * SPEED_SCALE
            + GAP_GAIN * (np.where(follows, gap_m, 0.0) - wanted_m)
        )
        free = SPEED_GAIN * (ego[..., 6] * SPEED_SCALE - speed)
        return follows, np.minimum(cooperative, free)


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create a driver with cooperative adaptive cruise control."""
    return CaccPolicy(env)
