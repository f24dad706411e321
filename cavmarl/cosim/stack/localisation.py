"""Localisation by GNSS, IMU and odometry: an extended Kalman filter of x, y, heading and speed.

The bias of the fixes, east and north, is part of the state. `GnssInertial` assumes that it is
0, because GNSS alone cannot separate it from the position.

The model is that of Thrun, Burgard, Fox: "Probabilistic Robotics", 2005, chapter 3.3, with the
kinematic bicycle's slip angle: the centre moves at heading + asin(r L / 2 v) where r is the yaw
rate and L the wheelbase, here the vehicle's length. The first fix gives the position. The heading
is the direction of the lane there, reversed if the fixes move the other way. If a sensor detects
lane markings, they give the distance from the centre of the lane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import wrap_angle
from cavmarl.cosim.stack.hd_map import HdMap, OnLane
from cavmarl.cosim.stack.stack_types import (
    EgoPose,
    Mission,
    Readings,
    SensorSamples,
    StackMount,
    StackSensor,
)
from cavmarl.sensors.kernels.vehicle_readings import GRAVITY_MPS2
from cavmarl.sensors.mounted.geodesy import Geodesy

# Standard deviations of the model's error per square root of a second, and of sensors without
# noise in their settings.
_DRIFT = (0.1, 0.1, 0.01, 0.5)
_LEAST = {"gnss": 0.05, "odometry": 0.02, "lane_d": 0.05, "lane_heading": 0.02}
_FIRST_HEADING_RAD = 0.3
_LANE_SEARCH_M = 8.0
_LANE_MATCH_M = 4.0
_LANE_SURE_M = 0.6  # deviation of the position below which neighbouring lanes can be distinguished
_GATE = 9.0  # squared Mahalanobis distance beyond which lane measurements are rejected
_COURSE_M = 8.0  # distance driven before the course of the fixes is compared with the heading
_STRAIGHT_RAD = 0.5
_SIZE = 6  # x, y, heading, speed, bias of the fixes east and north


class GnssInertial:
    """The localisation stage `gnss_imu`.

    `sensors`: sensors of the vehicle, with at least one GNSS. `geodesy`: the map's georeference.
    """

    bias_m = 0.0  # standard deviation of the bias of fixes
    bias_drift_m = 0.0  # standard deviation of its change per second

    def __init__(
        self, sensors: Sequence[StackSensor], geodesy: Geodesy, hd_map: HdMap, tick_s: float
    ) -> None:
        self._by_type = {sensor.type: sensor for sensor in sensors}
        self._geodesy = geodesy
        self._map = hd_map
        self._tick_s = tick_s
        self._state: NDArray[np.float64] | None = None
        self._spread = np.eye(_SIZE)
        self._yaw_rate = 0.0
        self._before_s: float | None = None
        self._anchor: tuple[float, float] | None = None
        self._driven_m = self._turned_rad = 0.0

    @property
    def bias(self) -> tuple[float, float]:
        """Estimated bias of the fixes east and north, in m."""
        east, north = self._get()[4:].tolist()
        return east, north

    def reset_pose(self, pose: EgoPose) -> None:
        """Set the pose of the vehicle, known to within some centimetres."""
        self._set((pose.x_m, pose.y_m, pose.heading_rad, pose.speed_mps), (0.05, 0.05, 0.02, 0.2))
        self._anchor = None

    def locate(self, readings: Readings, mission: Mission, time_s: float) -> EgoPose | None:
        """Predict the state at `time_s` and update it by the sensors' samples."""
        elapsed_s = 0.0 if self._before_s is None else time_s - self._before_s
        self._before_s = time_s
        fix = self._fix(readings)
        if self._state is None:
            if fix is None:
                return None
            self._begin(fix, readings)
        elif elapsed_s > 0.0:
            self._predict(readings, mission, elapsed_s)
        if fix is not None:
            self._update_by_fix(fix)
        speed = self._newest(readings, "odometry")
        if speed is not None:
            deviation = self._deviation("odometry", 0, _LEAST["odometry"])
            ahead = float(speed[0]) - float(self._get()[3])
            self._update(np.array([0.0, 0.0, 0.0, 1.0]), ahead, deviation, gate=math.inf)
        self._update_by_lane(readings)
        return self._pose()

    def _pose(self) -> EgoPose:
        x_m, y_m, heading, speed_mps = self._get()[:4].tolist()
        return EgoPose(x_m, y_m, wrap_angle(heading), max(0.0, speed_mps), self._yaw_rate)

    def _set(self, place: Sequence[float], deviations: Sequence[float]) -> None:
        """Set x, y, heading and speed with their standard deviations; the bias is unknown."""
        self._state = np.array([*place, 0.0, 0.0])
        self._spread = np.diag([*deviations, self.bias_m, self.bias_m]) ** 2

    def _set_by_fix(self, place: Sequence[float], deviations: Sequence[float]) -> None:
        """Set the state as `_set`, by the position of a fix, whose error includes the bias."""
        self._set(place, deviations)
        for axis in (0, 1):
            self._spread[axis, axis] += self.bias_m**2
            self._spread[axis, 4 + axis] = self._spread[4 + axis, axis] = -(self.bias_m**2)

    def _get(self) -> NDArray[np.float64]:
        assert self._state is not None
        return self._state

    def _newest(self, readings: Readings, kind: str) -> NDArray[np.float64] | None:
        """Return the newest sample of a type of sensor, without lost samples; None: no sample."""
        samples = self._samples(readings, kind)
        if samples is None or samples.lost.all():
            return None
        return np.asarray(samples.values[~samples.lost][-1], dtype=np.float64)

    def _samples(self, readings: Readings, kind: str) -> SensorSamples | None:
        sensor = self._by_type.get(kind)
        return None if sensor is None else readings.get(sensor.name)

    def _deviation(self, kind: str, channel: int, least: float) -> float:
        """Return the noise in a sensor's settings, at least `least`."""
        noise = self._by_type[kind].settings["noise"]
        return max(least, float(noise[min(channel, len(noise) - 1)]))

    def _fix(self, readings: Readings) -> tuple[float, float] | None:
        found = self._newest(readings, "gnss")
        if found is None:
            return None
        x_m, y_m, _ = self._geodesy.to_map(found[None, :])[0]
        return float(x_m), float(y_m)

    def _begin(self, fix: tuple[float, float], readings: Readings) -> None:
        lanes = self._map.near(*fix, _LANE_SEARCH_M)
        roads = [place for place in lanes if not self._map.network.lanes["internal"][place.lane]]
        best = (roads or lanes or [OnLane(-1, 0.0, 0.0, 0.0)])[0]
        speed = self._newest(readings, "odometry")
        speed_mps = 0.0 if speed is None else float(speed[0])
        mount = self._by_type["gnss"].mount
        x_m, y_m = _centre(fix, mount, best.heading_rad)
        deviation = self._deviation("gnss", 0, _LEAST["gnss"])
        self._set_by_fix(
            (x_m, y_m, best.heading_rad, speed_mps),
            (deviation, deviation, _FIRST_HEADING_RAD, 2.0),
        )
        self._anchor = fix
        self._driven_m = self._turned_rad = 0.0

    def _predict(self, readings: Readings, mission: Mission, elapsed_s: float) -> None:
        """Predict the state by the model and the inertial sensors."""
        state = self._get()
        accel, self._yaw_rate = self._inertia(readings)
        x_m, y_m, heading, speed = state[:4].tolist()
        half = 0.5 * mission.length_m
        slip = math.asin(max(-0.9, min(0.9, self._yaw_rate * half / speed))) if speed > 1.0 else 0.0
        course = heading + slip + 0.5 * self._yaw_rate * elapsed_s
        driven = max(0.0, speed + 0.5 * accel * elapsed_s) * elapsed_s
        cos, sin = math.cos(course), math.sin(course)
        self._state = np.array(
            [
                x_m + driven * cos,
                y_m + driven * sin,
                heading + self._yaw_rate * elapsed_s,
                speed + accel * elapsed_s,
                *state[4:],
            ]
        )
        slope = np.eye(_SIZE)
        slope[0, 2], slope[1, 2] = -driven * sin, driven * cos
        slope[0, 3], slope[1, 3] = elapsed_s * cos, elapsed_s * sin
        drift = np.diag([*_DRIFT, self.bias_drift_m, self.bias_drift_m]) ** 2 * elapsed_s
        self._spread = slope @ self._spread @ slope.T + drift
        self._driven_m += driven
        self._turned_rad += abs(self._yaw_rate) * elapsed_s

    def _inertia(self, readings: Readings) -> tuple[float, float]:
        """Return acceleration along the body and yaw rate, averaged over the new samples."""
        samples = self._samples(readings, "imu")
        if samples is not None and not samples.lost.all():
            force_x, _, force_z, _, _, turn = samples.values[~samples.lost].mean(axis=0).tolist()
            pitch = math.acos(max(-1.0, min(1.0, force_z / GRAVITY_MPS2)))
            # A pitch below this is within the noise of the force along z.
            climbs = math.copysign(GRAVITY_MPS2 * math.sin(pitch), force_x) if pitch > 0.15 else 0.0
            return force_x - climbs, turn
        wheels = self._newest(readings, "odometry")
        return 0.0, self._yaw_rate if wheels is None else float(wheels[1])

    def _update_by_fix(self, fix: tuple[float, float]) -> None:
        state = self._get()
        x_m, y_m = _centre(fix, self._by_type["gnss"].mount, float(state[2]))
        for axis, seen in enumerate((x_m, y_m)):
            row = np.zeros(_SIZE)
            row[axis] = row[4 + axis] = 1.0
            deviation = self._deviation("gnss", axis, _LEAST["gnss"])
            self._update(row, seen - float(row @ self._get()), deviation, gate=math.inf)
        self._compare_course(fix)

    def _compare_course(self, fix: tuple[float, float]) -> None:
        if self._anchor is None or self._driven_m < _COURSE_M:
            return
        east, north = fix[0] - self._anchor[0], fix[1] - self._anchor[1]
        state = self._get()
        if self._turned_rad < _STRAIGHT_RAD:
            apart = wrap_angle(math.atan2(north, east) - float(state[2]))
            if abs(apart) > 0.5 * math.pi:
                turned = (*fix, wrap_angle(float(state[2]) + apart), float(state[3]))
                self._set_by_fix(turned, (1.0, 1.0, _FIRST_HEADING_RAD, 1.0))
        self._anchor = fix
        self._driven_m = self._turned_rad = 0.0

    def _update_by_lane(self, readings: Readings) -> None:
        seen = self._newest(readings, "lane_boundary")
        if seen is None:
            return
        x_m, y_m, heading = self._get()[:3].tolist()
        if math.sqrt(max(self._spread[0, 0], self._spread[1, 1])) > _LANE_SURE_M:
            return
        offset = 0.5 * float(seen[1] - seen[0])
        near = self._map.near(x_m, y_m, _LANE_MATCH_M)
        internal = self._map.network.lanes["internal"]
        candidates = [
            (abs(offset - place.d_m), place)
            for place in near
            if abs(wrap_angle(heading - float(seen[3]) - place.heading_rad)) < _FIRST_HEADING_RAD
        ]
        # Lanes overlap inside junctions, so the observed lane would be ambiguous.
        if not candidates or any(internal[place.lane] for place in near):
            return
        _, place = min(candidates, key=lambda found: found[0])
        row = np.array([-math.sin(place.heading_rad), math.cos(place.heading_rad), 0.0, 0.0])
        deviation = self._deviation("lane_boundary", 0, _LEAST["lane_d"])
        if self._update(row, offset - place.d_m, deviation):
            turn = wrap_angle(place.heading_rad + float(seen[3]) - float(self._get()[2]))
            deviation = self._deviation("lane_boundary", 3, _LEAST["lane_heading"])
            self._update(np.array([0.0, 0.0, 1.0, 0.0]), turn, deviation)

    def _update(
        self, row: NDArray[np.float64], surprise: float, deviation: float, gate: float = _GATE
    ) -> bool:
        """Update the state by one number; return whether it was accepted.

        `row`: derivatives of the number by the first numbers of the state. `surprise`: the number
        minus its expected value. `gate`: limit of its squared Mahalanobis distance.
        """
        row = np.concatenate([row, np.zeros(_SIZE - len(row))])
        spread = float(row @ self._spread @ row) + deviation**2
        if surprise**2 > gate * spread:
            return False
        gain = self._spread @ row / spread
        self._state = self._get() + gain * surprise
        self._spread = self._spread - np.outer(gain, row @ self._spread)
        return True


def _centre(fix: tuple[float, float], mount: StackMount, heading: float) -> tuple[float, float]:
    """Return the vehicle's centre for a place of its antenna."""
    cos, sin = math.cos(heading), math.sin(heading)
    return (fix[0] - mount.x_m * cos + mount.y_m * sin, fix[1] - mount.x_m * sin - mount.y_m * cos)
