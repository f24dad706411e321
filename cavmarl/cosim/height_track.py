"""Height and pitch of a vehicle over a whole drive, from GNSS, IMU and odometry.

A Kalman filter and a backward smoother (Rauch, Tung, Striebel, 1965) estimate height, speed and
pitch. The force along the body minus the acceleration is a share of gravity, which gives the pitch.
Pitch and speed give the change of the height, and GNSS keeps the height from drifting.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cavmarl.sensors.kernels.vehicle_readings import GRAVITY_MPS2

_DRIFT = (0.02, 0.3, 0.02)  # model error per square root of a second: m, m/s, rad
_FIRST = (3.0, 1.0, 0.1)  # initial standard deviations: m, m/s, rad


@dataclass
class HeightTrack:
    """The readings of one drive, step by step."""

    gnss_m: float  # standard deviations of a GNSS height and, below, of a speed
    speed_mps: float
    _steps: list[tuple[float, float, float | None, float | None]] = field(default_factory=list)

    def add(
        self, elapsed_s: float, force_mps2: float, speed_mps: float | None, height_m: float | None
    ) -> None:
        """Add a step: force along the body, wheel speed, GNSS height; None: no sample."""
        self._steps.append((elapsed_s, force_mps2, speed_mps, height_m))

    def smoothed(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return height in m and pitch in rad, positive uphill, of each step."""
        heights = [step[3] for step in self._steps if step[3] is not None]
        state = np.array([heights[0] if heights else 0.0, self._steps[0][2] or 0.0, 0.0])
        spread = np.diag(_FIRST) ** 2
        before, after = [], []  # (state, spread), predicted and corrected
        slopes = []
        for elapsed_s, force, speed, height in self._steps:
            slope = np.array(
                [
                    [1.0, elapsed_s * state[2], elapsed_s * state[1]],
                    [0.0, 1.0, -GRAVITY_MPS2 * elapsed_s],
                    [0.0, 0.0, 1.0],
                ]
            )
            climb = elapsed_s * state[1] * state[2]
            faster = elapsed_s * (force - GRAVITY_MPS2 * state[2])
            state = state + np.array([climb, faster, 0.0])
            spread = slope @ spread @ slope.T + np.diag(_DRIFT) ** 2 * max(elapsed_s, 1e-6)
            before.append((state, spread))
            slopes.append(slope)
            for axis, seen, deviation in (
                (1, speed, self.speed_mps),
                (0, height, self.gnss_m),
            ):
                if seen is not None:
                    gain = spread[:, axis] / (spread[axis, axis] + deviation**2)
                    state = state + gain * (seen - state[axis])
                    spread = spread - np.outer(gain, spread[axis])
            after.append((state, spread))
        states = [after[-1][0]]
        for k in range(len(after) - 2, -1, -1):
            gain = after[k][1] @ slopes[k + 1].T @ np.linalg.inv(before[k + 1][1])
            states.append(after[k][0] + gain @ (states[-1] - before[k + 1][0]))
        found = np.array(states[::-1])
        return found[:, 0], found[:, 2]
