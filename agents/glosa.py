"""Green light optimal speed advice (GLOSA): arrives at the next signal while it is green.

The driver steers, follows and stops like the built-in driver. If it has received the timing of the
next signal in a message (SPAT), it drives no faster than the speed at which it reaches the line in
the earliest green that it can reach. If no speed of at least `SLOWEST_MPS` reaches a green, it
drives at `SLOWEST_MPS`. Of a signal whose greens are chosen, only the earliest time of the next
green is known. The driver then arrives no earlier. It does not know the queue before the signal.

Source: Eckhoff, Halmos, German: "Potentials and limitations of green light optimal speed advisory
    systems", IEEE VNC 2013.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import observation_parts
from cavmarl.policies.policy import Environment, Policy, built_in_actions

SLOWEST_MPS = 3.0
MARGIN_S = 1.0  # arrival after the beginning of a green
REACT_S = 2.0  # time to reach the advised speed
BRISK_MPS2 = 2.0  # assumed acceleration to the speed limit
BRAKE_MPS2 = 1.5
YELLOW_MPS2 = 4.5  # a driver who would have to brake harder passes at yellow
HALF_M = 2.5  # from the centre of the vehicle to its front

# Scales and indices of the features, see the table of any environment's card.
SPEED_SCALE = 40.0
LINE_SCALE_M = 300.0
SOON_S = 5.0
SIGNAL_FEATURES = 7  # the last features of `messages`
GO, LINE, CHANGE, RETURN = 1, 4, 5, 6
NEEDED = {
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
    "v2x.channel.range_m": 300.0,
    "sensors.messages.signal": True,
    "sensors.messages.timing": True,
    "sensors.ego.enabled": True,
    "action.kind": "continuous",
}

Floats = NDArray[np.float64]


def advised_mps(
    line_m: Floats,
    speed: Floats,
    limit: Floats,
    is_go: NDArray[np.bool_],
    change_s: Floats,
    return_s: Floats,
) -> Floats:
    """Return the highest speed in m/s that reaches a stop line in its earliest reachable green.

    Args:
        line_m: (…) distance to the line.
        speed: (…) present speed in m/s.
        limit: (…) highest speed in m/s.
        is_go: (…) whether the signal is green now.
        change_s: (…) time until the signal changes between green and red.
        return_s: (…) time until the signal changes back; infinite: not known.

    Returns:
        (…) m/s; `limit` if the line cannot be reached before the last known change.
    """
    soonest_s = line_m / limit + (limit - speed) ** 2 / (2.0 * BRISK_MPS2 * limit)
    is_in_first = is_go & (soonest_s <= change_s + limit / (2.0 * YELLOW_MPS2))
    begin_s = np.where(is_go, return_s, change_s) + MARGIN_S
    is_beyond = ~is_go & (soonest_s > return_s)
    wanted = np.clip(line_m / begin_s, np.minimum(SLOWEST_MPS, limit), limit)
    is_free = is_in_first | is_beyond | np.isinf(begin_s)
    found: Floats = np.where(is_free, limit, wanted)
    return found


class Glosa(Policy):
    """Limits the speed of the built-in driver by the advice.

    Args:
        env: the environment.
    """

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        config = env.config
        parts = observation_parts(config.sensors)
        if (
            not {"ego", "messages"} <= parts.keys()
            or not config.sensors.messages.timing
            or config.action.kind != "continuous"
        ):
            raise PolicyError(
                "glosa needs messages about the timing of signals, and continuous actions: create "
                f"the environment with overrides={NEEDED}"
            )
        self._ego, messages = parts["ego"].place, parts["messages"].place
        self._signal = slice(messages.stop - SIGNAL_FEATURES, messages.stop)
        self._frame = max(part.place.stop for part in parts.values())
        self._most_mps2 = config.action.acceleration_mps2

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): the built-in driver's actions, with the throttle of the advice."""
        actions = built_in_actions(self.env, mask)
        newest = observations[..., -self._frame :].astype(np.float64)
        ego, signal = newest[..., self._ego], newest[..., self._signal]
        speed, limit = ego[..., 0] * SPEED_SCALE, np.maximum(ego[..., 6] * SPEED_SCALE, 1.0)
        soon = signal[..., [CHANGE, RETURN]]
        is_known = soon[..., 0] > 0.0
        times_s = np.where(soon > 0.0, SOON_S / np.where(soon > 0.0, soon, 1.0) - SOON_S, np.inf)
        change_s, return_s = np.moveaxis(times_s, -1, 0)
        line_m = np.maximum(signal[..., LINE] * LINE_SCALE_M - HALF_M, 0.0)
        advice = advised_mps(line_m, speed, limit, signal[..., GO] > 0.0, change_s, return_s)
        accel = np.maximum((advice - speed) / REACT_S, -BRAKE_MPS2)
        throttle = np.clip(accel / self._most_mps2, -1.0, 1.0)
        is_limited = is_known & (advice < limit)
        actions[..., 0] = np.where(
            is_limited, np.minimum(actions[..., 0], throttle), actions[..., 0]
        )
        return actions


def make_policy(env: Environment) -> Policy:
    """Create the driver."""
    return Glosa(env)
