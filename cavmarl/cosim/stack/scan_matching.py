"""Localisation by a point-cloud map: lidar scans matched with walls, combined with the filter.

Between scans, the filter of `localisation` uses GNSS, IMU and odometry. Each scan is aligned with
the map's upright surfaces by generalized ICP (small_gicp), starting from the filter's pose. The
result is a set of pairs: an echo and its nearest wall point. The pose updates the filter with the
information matrix of the wall normals of the pairs. Along an endless street
this information is zero, and only GNSS gives the position.

Fixes have a bias of some metres, which the filter learns from the scans. While the position is
uncertain, or if scans no longer fit, a scan is tried at many places around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.lidar_points import lidar_points
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.stack_types import EgoPose, Mission, Readings, StackSensor
from cavmarl.maps.fidelity.cloud_files import read_cloud
from cavmarl.maps.fidelity.cloud_registration import FEWEST_POINTS, Target, moved
from cavmarl.sensors.mounted.geodesy import Geodesy

Points = NDArray[np.float64]

_RANGE_M = 50.0  # maximum range of used echoes
_LOWEST_M, _HIGHEST_M = 0.3, 4.0  # heights above the road that exclude ground and treetops
_UPRIGHT = 0.5  # maximum vertical part of a wall's normal
_AROUND_M = 60.0  # extent of the map around a scan
_EXTRUDED_M = (-0.2, 0.0, 0.2)  # a single-layer scan is copied to these heights: walls are upright
_GATE = 16.0  # squared Mahalanobis distance from the filter's pose beyond which a match is rejected
_GATE_M = 1.5  # the echo of a pair farther apart belongs to an object that the map lacks
_PAIR_M = 0.4  # pairs nearer than this are used for the pose
_FEWEST_PAIRS, _LEAST_SHARE = 30, 0.5  # least number of used pairs, and share of all pairs
_DEVIATION_M = 0.08  # standard deviation of a pair, for map and scan
_CORRELATED = 9.0  # this many pairs count as one, since neighbouring errors are correlated
_WEAKEST = 1e-3  # share of the best axis's information below which an axis is ignored
# Minimum deviation along the best axis, and in proportion along weaker axes: errors of scans are
# correlated, and noise of normals looks like information along weaker axes.
_LEAST_M = 0.1
_BIAS_M, _BIAS_DRIFT_M = 3.0, 0.02  # deviation of the fixes' bias, and its drift per second
_SURE_M = 0.5  # standard deviation below which a scan is tried only at the estimated position
# If the deviation is larger, a scan is also tried within _SIGMAS deviations of the estimated
# position, in _STEPS steps to each side.
_SIGMAS, _STEPS = 2.5, 6
_TRIED, _TRY_EVERY = 150, 5  # echoes used per try, and scans between tries
_FIRST_TRIED = 3  # number of best places that are then matched fully
_FAR_COST = 0.05  # penalty at the edge of the tried area, as a share of fitting echoes
_LOST_SCANS = 20  # consecutive scans without a fit after which the position is unknown
# A fit determines the position along an axis only if shifts by _ASIDE_M to both sides lower its log
# likelihood by at least _WORSE.
_ASIDE_M, _WORSE = 0.5, 3.0
_TURN_M = 10.0  # an error of 1 rad in the heading counts like an error of this distance


class ScanMatching(GnssInertial):
    """The localisation stage `scan_matching`.

    `sensors`: sensors of the vehicle, with a GNSS and a lidar. `cloud`: file in the map's frame.

    Raises:
        ConfigError: there is no lidar or no file, or the cloud has no walls.
        MapError: the file cannot be read.
    """

    bias_m, bias_drift_m = _BIAS_M, _BIAS_DRIFT_M

    def __init__(
        self,
        sensors: Sequence[StackSensor],
        geodesy: Geodesy,
        hd_map: HdMap,
        tick_s: float,
        cloud: Path | None,
    ) -> None:
        super().__init__(sensors, geodesy, hd_map, tick_s)
        lidars = [sensor for sensor in sensors if sensor.type == "lidar"]
        if not lidars:
            raise ConfigError("localisation = scan_matching: needs a lidar; mount one under `rig`")
        if cloud is None:
            raise ConfigError(
                "localisation = scan_matching: needs a point-cloud map; give its file (--cloud), "
                "as `cavmarl map survey` writes it"
            )
        self._lidar = max(lidars, key=lambda sensor: int(sensor.settings["layers"]))
        self._walls = _Walls(cloud)
        self.matched = self.refused = 0  # numbers of scans
        self.lost = 0  # number of times that the position was lost
        self._num_unmatched = 0  # consecutive scans without a fit
        self._next_try = 0  # number of scans until a scan is tried at many places

    def locate(self, readings: Readings, mission: Mission, time_s: float) -> EgoPose | None:
        pose = super().locate(readings, mission, time_s)
        samples = readings.get(self._lidar.name)
        if pose is None or samples is None or samples.lost.all():
            return pose
        scan = np.asarray(samples.values[~samples.lost][-1], dtype=np.float64)
        fits = self._match(lidar_points(self._lidar, scan, _RANGE_M))
        self.matched += fits
        self.refused += not fits
        self._num_unmatched = 0 if fits else self._num_unmatched + 1
        if self._num_unmatched >= _LOST_SCANS:
            self._forget()
        return self._pose()

    def _forget(self) -> None:
        """Reset the position's uncertainty to the uncertainty of a fix."""
        state = self._get()
        place = (state[:2] + self.bias).tolist()
        self._set_by_fix((*place, float(state[2]), float(state[3])), (1.0, 1.0, 0.1, 1.0))
        self._num_unmatched = self._next_try = 0
        self.lost += 1

    def _match(self, echoes: Points) -> bool:
        """Update the pose by echoes (n, 3) of the vehicle's frame; return whether they fit."""
        upright = echoes[(echoes[:, 2] > _LOWEST_M) & (echoes[:, 2] < _HIGHEST_M)]
        if len(upright) and float(np.ptp(upright[:, 2])) < 1e-6:
            upright = np.concatenate([upright + np.array([0.0, 0.0, up]) for up in _EXTRUDED_M])
        x_m, y_m, heading = self._get()[:3].tolist()
        target = self._walls.around(x_m, y_m)
        if target is None or len(upright) < FEWEST_POINTS:
            return False
        begin = _motion(x_m, y_m, self._walls.ground_m(x_m, y_m), heading)
        fits = [_fit(target, upright, start) for start in self._starts(target, upright, begin)]
        best = max(fits, key=lambda fit: fit.likelihood - 0.5 * self._apart(fit.pose))
        if best.paired.sum() < max(_FEWEST_PAIRS, _LEAST_SHARE * (best.distance_m < _GATE_M).sum()):
            return False
        if self._apart(best.pose) > _GATE:
            return False
        self._update_by_match(target, best)
        return True

    def _apart(self, pose: Points) -> float:
        """Return the squared Mahalanobis distance of (x, y, heading) from the filter's pose."""
        off = pose - self._get()[:3]
        off[2] = wrap_angle(float(off[2]))
        spread = self._spread[:3, :3] + np.diag([_PAIR_M, _PAIR_M, _PAIR_M / _TURN_M]) ** 2
        return float(off @ np.linalg.solve(spread, off))

    def _starts(self, target: Target, echoes: Points, begin: Points) -> list[Points]:
        """Return start motions (4, 4) for matching: the possible motions with the best fit."""
        deviation_m = math.sqrt(float(np.linalg.eigvalsh(self._spread[:2, :2])[-1]))
        self._next_try -= 1
        if deviation_m < _SURE_M or self._next_try > 0:
            return [begin]
        self._next_try = _TRY_EVERY
        reach_m = _SIGMAS * deviation_m
        steps = np.linspace(-reach_m, reach_m, 2 * _STEPS + 1)
        around = np.array([(x, y, 0.0) for x in steps for y in steps if math.hypot(x, y) < reach_m])
        placed = moved(echoes[:: -(-len(echoes) // _TRIED)], begin)
        _, distance_m = target.nearest((around[:, None] + placed).reshape(-1, 3))
        near = np.exp(-0.5 * (distance_m.reshape(len(around), -1) / _PAIR_M) ** 2).mean(axis=1)
        score = near - _FAR_COST * np.square(np.hypot(around[:, 0], around[:, 1]) / reach_m)
        starts = [begin]
        for row in np.argsort(-score, kind="stable")[:_FIRST_TRIED].tolist():
            start = begin.copy()
            start[:3, 3] += around[row]
            starts.append(start)
        return starts

    def _update_by_match(self, target: Target, fit: _Fit) -> None:
        """Update position and heading, as far as the normals of pairs determine them."""
        normals = _normals(target, fit)
        free = [
            axis for axis in np.linalg.eigh(normals.T @ normals)[1].T if _slides(target, fit, axis)
        ]
        for axis in free:  # keep the filter's value along this axis
            fit = fit.shifted(target, axis * float(axis @ (self._get()[:2] - fit.pose[:2])))
        normals = _normals(target, fit)
        for axis in free:
            normals = normals - np.outer(normals @ axis, axis)
        seen = fit.pose
        arms_m = fit.placed[fit.paired, :2] - seen[:2]
        turn = (normals[:, 1] * arms_m[:, 0] - normals[:, 0] * arms_m[:, 1]) / _TURN_M
        slopes = np.column_stack([normals, turn])
        information = slopes.T @ slopes / (_CORRELATED * _DEVIATION_M**2)
        strength, axes = np.linalg.eigh(information)
        for share, axis in zip(strength.tolist(), axes.T, strict=True):
            if share < _WEAKEST * strength[-1] or share < 1.0:  # 1.0: a standard deviation of 1 m
                continue
            off = seen - self._get()[:3]
            off[2] = wrap_angle(float(off[2]))
            row = axis * (1.0, 1.0, _TURN_M)
            deviation = max(1.0 / math.sqrt(share), _LEAST_M * math.sqrt(strength[-1] / share))
            self._update(row, float(row @ off), deviation, gate=math.inf)


class _Walls:
    """The walls of a cloud, by place, and the height of its ground."""

    def __init__(self, path: Path) -> None:
        points = read_cloud(path).points
        whole = Target(points)
        upright = np.abs(np.asarray(whole.cloud.normals())[:, 2]) < _UPRIGHT
        self._points = points[upright]
        ground = points[~upright]
        if len(self._points) < FEWEST_POINTS:
            raise ConfigError(
                f"{path}: has no walls to match scans with ({len(self._points)} upright points); "
                "survey a map with buildings (map.buildings), or use localisation=gnss_imu"
            )
        gicp: Any = require("small_gicp", "maps")
        self._ground = ground if len(ground) else self._points
        flat = np.column_stack([self._ground[:, :2], np.zeros(len(self._ground))])
        self._tree = gicp.KdTree(flat)
        self._held: tuple[float, float, Target | None] | None = None

    def ground_m(self, x_m: float, y_m: float) -> float:
        """Return the height of the cloud's ground nearest to a place."""
        rows, _ = self._tree.batch_nearest_neighbor_search(np.array([[x_m, y_m, 0.0]]))
        return float(self._ground[int(np.asarray(rows)[0]), 2])

    def around(self, x_m: float, y_m: float) -> Target | None:
        """Return the walls around a place, cached while they suffice; None: there are too few."""
        held = self._held
        if held is None or math.hypot(held[0] - x_m, held[1] - y_m) > 0.25 * _AROUND_M:
            apart = np.abs(self._points[:, :2] - (x_m, y_m)).max(axis=1)
            near = self._points[apart < 1.25 * _AROUND_M]
            target = Target(near) if len(near) >= FEWEST_POINTS else None
            held = self._held = (x_m, y_m, target)
        return held[2]


def _motion(x_m: float, y_m: float, z_m: float, heading: float) -> Points:
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array(
        [[cos, -sin, 0.0, x_m], [sin, cos, 0.0, y_m], [0.0, 0.0, 1.0, z_m], [0.0, 0.0, 0.0, 1.0]]
    )


class _Fit(NamedTuple):
    """A scan aligned with walls."""

    motion: Points  # (4, 4) from the vehicle's frame to the map's
    placed: Points  # (n, 3) echoes on the map
    rows: NDArray[np.int64]  # nearest wall point of each echo
    distance_m: Points  # (n,) distance to the nearest wall point

    def shifted(self, target: Target, by_m: Points) -> _Fit:
        """Return the scan shifted by (2,) in the plane."""
        motion, placed = self.motion.copy(), self.placed.copy()
        motion[:2, 3] += by_m
        placed[:, :2] += by_m
        return _Fit(motion, placed, *target.nearest(placed))

    @property
    def pose(self) -> Points:
        """(3,) x, y and heading."""
        motion = self.motion
        heading = math.atan2(float(motion[1, 0]), float(motion[0, 0]))
        return np.array([motion[0, 3], motion[1, 3], heading])

    @property
    def likelihood(self) -> float:
        return _likelihood(self.distance_m)

    @property
    def paired(self) -> NDArray[np.bool_]:
        """Echoes that are used for the pose."""
        near: NDArray[np.bool_] = self.distance_m < _PAIR_M
        return near


def _likelihood(distance_m: Points) -> float:
    """Return the log likelihood, with a maximum distance for objects missing in the map."""
    near = np.minimum(distance_m, _PAIR_M) / (0.5 * _PAIR_M)
    return -0.5 * float(np.square(near).sum()) / _CORRELATED


def _slides(target: Target, fit: _Fit, axis: Points) -> bool:
    """Return whether a scan fits about as well when shifted along an axis (2,) of the plane.

    Normals alone are not sufficient: normals of a rough wall also point along the wall.
    """
    sides = [fit.shifted(target, way * axis).likelihood for way in (-_ASIDE_M, _ASIDE_M)]
    return fit.likelihood - max(sides) < _WORSE


def _normals(target: Target, fit: _Fit) -> Points:
    """Return the normals (n, 2) of the walls that used echoes lie on."""
    found: Points = np.asarray(target.cloud.normals())[fit.rows[fit.paired], :2]
    return found


def _fit(target: Target, points: Points, start: Points) -> _Fit:
    motion = _align(target, points, start)
    placed = moved(points, motion)
    return _Fit(motion, placed, *target.nearest(placed))


def _align(target: Target, points: Points, begin: Points) -> Points:
    """Return the motion (4, 4) that aligns the vehicle's points with walls, from a guess."""
    gicp: Any = require("small_gicp", "maps")
    shift = np.eye(4)
    shift[:3, 3] = -target.middle_m
    source = gicp.PointCloud(points)
    gicp.estimate_covariances(source, gicp.KdTree(source), 10)
    motion = shift @ begin
    for gate_m in (_GATE_M, _PAIR_M):
        found = gicp.align(
            target.cloud, source, target.tree, motion, max_correspondence_distance=gate_m
        )
        motion = np.asarray(found.T_target_source)
    shift[:3, 3] = target.middle_m
    aligned: Points = shift @ motion
    return aligned
