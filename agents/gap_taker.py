"""A driver that crosses a road in a gap, known from messages before its line or seen from the edge.

The driver steers like the built-in driver. At a line where it must yield, it assumes that known
vehicles keep their speed: vehicles that it sees, or receives messages of
(`sensors.conflicts.heard`). It crosses if no known vehicle comes within `GAP_S` of the time that it
needs. If it has received any message in the last seconds, it decides before the line. Otherwise, it
first stops at the edge of the other road and decides by the vehicles that it sees from there. It is
made for straight paths over one road, and needs the sensors `ego`, `signal` and `conflicts` with
`heard`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import observation_parts
from cavmarl.policies.policy import Environment, Policy, built_in_actions

GAP_S = 0.8  # minimum time between the ego vehicle and another vehicle in the conflict area
BRISK_MPS2 = 2.5
STOP_MPS2 = 2.0
LEAST_MPS = 3.0  # assumed lower bound of the speed of a moving vehicle nearer than `NEAR_M`
NEAR_M = 15.0
STANDING_MPS = 0.3
LINE_M = 0.2  # stopping distance before the line
EDGE_M = 4.2  # distance of the other road's edge behind the line
HEARD_S = 3.0
LENGTH_M, HALF_M = 5.0, 2.5
ASIDE_M = 1.2  # half of a width, plus a margin

# Scales and indices of the features, see the table of any environment's card.
SPEED_SCALE = 40.0
RATIO = 10.0  # m and m/s that are scaled to 0.5
SIZE = 11
NEEDED = {
    "sensors.conflicts.count": 6,
    "sensors.conflicts.heard": True,
    "sensors.signal.enabled": True,
    "sensors.ego.enabled": True,
    "v2x.enabled": True,
    "action.kind": "continuous",
}

Floats = NDArray[np.float64]


def straight(ratio: Floats) -> Floats:
    """Invert the scaling value / (RATIO + abs(value)); return m or m/s."""
    found: Floats = ratio * RATIO / np.maximum(1.0 - np.abs(ratio), 1e-6)
    return found


def time_for(way_m: Floats, speed: Floats, limit: Floats) -> Floats:
    """Return the time in s for a distance, accelerating up to a limit; 0 if the distance is 0."""
    speed, way_m = np.minimum(speed, limit), np.maximum(way_m, 0.0)
    ramp_m = (limit**2 - speed**2) / (2.0 * BRISK_MPS2)
    within = (np.sqrt(speed**2 + 2.0 * BRISK_MPS2 * way_m) - speed) / BRISK_MPS2
    beyond = (limit - speed) / BRISK_MPS2 + (way_m - ramp_m) / limit
    found: Floats = np.where(way_m < ramp_m, within, beyond)
    return found


class GapTaker(Policy):
    """Crosses in a known gap."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        config = env.config
        parts = observation_parts(config.sensors)
        if (
            not {"ego", "signal", "conflicts"} <= parts.keys()
            or not config.sensors.conflicts.heard
            or config.action.kind != "continuous"
        ):
            raise PolicyError(
                f"gap_taker needs sensors of crossing vehicles, continuous actions: create the "
                f"environment with overrides={NEEDED}"
            )
        self._places = {name: part.place for name, part in parts.items()}
        self._frame = max(part.place.stop for part in parts.values())
        self._signal_m = config.sensors.signal.range_m
        self._most_mps2 = config.action.acceleration_mps2
        self._dt_s = config.clock.ctrl_dt_s
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forget the state of all agents; nothing is drawn."""
        self._beyond_m = np.zeros((0, 0))  # (W, A) distance of the front beyond the line
        self._silent_s = np.zeros((0, 0))  # time since the last message
        self._goes = np.zeros((0, 0), dtype=np.bool_)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): the built-in driver's steering, and this driver's throttle."""
        if self._goes.shape != mask.shape:
            self._beyond_m, self._silent_s = np.zeros(mask.shape), np.full(mask.shape, np.inf)
            self._goes = np.zeros(mask.shape, dtype=np.bool_)
        actions = built_in_actions(self.env, mask)
        newest = observations[..., -self._frame :].astype(np.float64)
        ego, signal = newest[..., self._places["ego"]], newest[..., self._places["signal"]]
        others = newest[..., self._places["conflicts"]].reshape(*mask.shape, -1, SIZE)
        speed, limit = ego[..., 0] * SPEED_SCALE, np.maximum(ego[..., 6] * SPEED_SCALE, 1.0)
        accel = np.minimum(
            self._follow(others, speed, limit), self._cross(others, signal, speed, limit)
        )
        actions[..., 0] = np.clip(accel / self._most_mps2, -1.0, 1.0)
        return actions

    def _follow(self, others: Floats, speed: Floats, limit: Floats) -> Floats:
        """Return the acceleration (W, A) by IDM behind the nearest vehicle on the ego path."""
        ahead_m, aside_m = straight(others[..., 2]), straight(others[..., 3])
        is_ahead = (others[..., 0] > 0.0) & (others[..., 6] > 0.5)
        is_ahead &= (ahead_m > 0.0) & (np.abs(aside_m) < 1.5)
        gap_m = np.where(is_ahead, np.maximum(ahead_m - LENGTH_M, 0.1), 1e6)
        slower = -straight(others[..., 4])
        wanted_m = 2.0 + np.maximum(
            speed[..., None] * (1.0 + slower / (2.0 * np.sqrt(BRISK_MPS2 * 4.0))), 0.0
        )
        closest = (wanted_m / gap_m).max(-1, initial=0.0)
        of_limit = (speed / limit) ** 2
        found: Floats = BRISK_MPS2 * (1.0 - of_limit * of_limit - closest**2)
        return found

    def _cross(self, others: Floats, signal: Floats, speed: Floats, limit: Floats) -> Floats:
        """Return the largest acceleration (W, A) that a line, or the edge behind it, allows."""
        before = signal[..., 0] > 0.0
        to_line_m = signal[..., 1] * self._signal_m - HALF_M
        self._beyond_m = np.where(before, -to_line_m, self._beyond_m + speed * self._dt_s)
        known = others[..., 0] > 0.0
        heard = (known & (others[..., 9] == 0.0)).any(-1)
        self._silent_s = np.where(heard, 0.0, self._silent_s + self._dt_s)
        hears = self._silent_s < HEARD_S
        stop_m = np.where(hears, -LINE_M, EDGE_M)
        left_m = stop_m - self._beyond_m
        clear = ~self._in_the_way(others, speed, limit)
        looked = (left_m < 0.4) & (speed < STANDING_MPS)
        cannot_stop = left_m < speed**2 / (2.0 * STOP_MPS2) + 0.5
        self._goes = (self._goes & (self._beyond_m > -NEAR_M)) | (
            clear & np.where(hears, cannot_stop, looked)
        )
        self._goes |= left_m < -1.0  # beyond the edge, the vehicle continues
        wanted = np.sqrt(2.0 * STOP_MPS2 * np.maximum(left_m - 0.2, 0.0))
        free = self._goes | (hears & clear) | (signal[..., 5] == 0.0) & before
        found: Floats = np.where(free, np.inf, (wanted - speed) / (2.0 * self._dt_s))
        return found

    def _in_the_way(self, others: Floats, speed: Floats, limit: Floats) -> NDArray[np.bool_]:
        """Return (W, A) whether a known vehicle will be in the conflict area at the same time."""
        ahead_m, aside_m = straight(others[..., 2]), straight(others[..., 3])
        across = straight(others[..., 5])
        crosses = (others[..., 0] > 0.0) & (np.abs(others[..., 6]) < 0.5)
        speed, limit = speed[..., None], limit[..., None]
        enters_s = time_for(ahead_m - HALF_M - ASIDE_M, speed, limit)
        leaves_s = time_for(ahead_m + HALF_M + ASIDE_M, speed, limit)
        away_m, moves = np.abs(aside_m), np.abs(across) > STANDING_MPS
        rate = np.maximum(np.abs(across), np.where(away_m < NEAR_M, LEAST_MPS, STANDING_MPS))
        comes = aside_m * across < 0.0
        there_m = HALF_M + ASIDE_M
        arrives_s = np.maximum(away_m - there_m, 0.0) / rate
        gone_m = np.where(comes, away_m + there_m, there_m - away_m)
        gone_s = np.maximum(gone_m, 0.0) / np.maximum(np.abs(across), STANDING_MPS)
        meets = (enters_s - GAP_S < gone_s) & (arrives_s - GAP_S < leaves_s)
        counts = crosses & (ahead_m + HALF_M + ASIDE_M > 0.0) & (gone_m > 0.0)
        counts &= np.where(moves, True, away_m < there_m)  # a stopped vehicle yields to it
        found: NDArray[np.bool_] = np.logical_or.reduce(counts & meets, axis=-1)
        return found


def make_policy(env: Environment) -> Policy:
    """Create the driver."""
    return GapTaker(env)
