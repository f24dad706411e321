"""Localisation against a point-cloud map: lidar scans matched with its walls, in the filter.

Between scans the filter of `localisation` goes on from GNSS, IMU and odometry. Each scan is laid
onto the map's upright surfaces by generalized ICP (small_gicp), from where the filter takes the
vehicle to be. What the pairs of points say of place and heading goes into the filter with the
information that their normals have: along a street without ends it says nothing, and GNSS stays.

Fixes have a bias of some metres, which the filter learns from the scans. As long as the place is
not known, and where scans no longer fit, a scan is tried at many places around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require
from cavmarl.cosim.stack.hd_map import HdMap, wrap
from cavmarl.cosim.stack.lidar_points import lidar_points
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.stack_types import EgoPose, Mission, Readings, StackSensor
from cavmarl.maps.fidelity.cloud_files import read_cloud
from cavmarl.maps.fidelity.cloud_registration import FEWEST_POINTS, Target, moved
from cavmarl.sensors.mounted.geodesy import Geodesy

Points = NDArray[np.float64]

_RANGE_M = 50.0  # of echoes that are used
_LOWEST_M, _HIGHEST_M = 0.3, 4.0  # above the road: no ground, nothing that only trees reach
_UPRIGHT = 0.5  # most of a normal's vertical part
_AROUND_M = 60.0  # of the map, for a scan
_EXTRUDED_M = (-0.2, 0.0, 0.2)  # a plane scan is taken for upright walls
_GATE = 16.0  # squared deviations from what the filter says, beyond which a match is another place
_GATE_M = 1.5  # farther pairs are other things
_PAIR_M = 0.4  # pairs that are nearer say where the vehicle is
_FEWEST_PAIRS, _LEAST_SHARE = 30, 0.5
_DEVIATION_M = 0.08  # of a pair, map and scan
_CORRELATED = 9.0  # so many pairs are worth one: neighbours err alike
_WEAKEST = 1e-3  # of the information along the best axis, below which an axis says nothing
# Along the best axis; scans err alike, and along others noise of normals looks like information.
_LEAST_M = 0.1
_BIAS_M, _BIAS_DRIFT_M = 3.0, 0.02  # of fixes; and how it changes in a second
_SURE_M = 0.5  # standard deviation of the place, below which a scan is tried there alone
_SIGMAS, _STEPS = 2.5, 6  # how far around it is tried otherwise, in how many steps to a side
_TRIED, _TRY_EVERY = 150, 5  # echoes of a scan; and which scans
_FIRST_TRIED = 3  # places that are then matched in full
_FAR_COST = 0.05  # of the share of echoes that fit, at the edge of what is tried
_LOST_SCANS = 20  # that fit nowhere, one after another: the place is not known
_ASIDE_M, _WORSE = 0.5, 3.0  # so far to the side a match is worse by so much, or it slides
_TURN_M = 10.0  # a radian, against metres


class ScanMatching(GnssInertial):
    """The stage.

    `sensors`: of the vehicle; a GNSS and a lidar at least. `cloud`: the map's file, in its frame.

    Raises:
        ConfigError: no lidar, no file, or a cloud without walls.
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
            raise ConfigError("localisation = scan_matching: there is no lidar among the sensors")
        if cloud is None:
            raise ConfigError(
                "localisation = scan_matching: needs a point-cloud map: give its file (--cloud), "
                "as `cavmarl map survey` writes it"
            )
        self._lidar = max(lidars, key=lambda sensor: int(sensor.settings["layers"]))
        self._walls = _Walls(cloud)
        self.matched = self.refused = 0  # scans
        self.lost = 0  # how often the place had to be found anew
        self._astray = 0  # scans that fit nowhere, the last ones
        self._next_try = 0  # scans until one is tried at many places

    def locate(self, readings: Readings, mission: Mission, time_s: float) -> EgoPose | None:
        pose = super().locate(readings, mission, time_s)
        samples = readings.get(self._lidar.name)
        if pose is None or samples is None or samples.lost.all():
            return pose
        scan = np.asarray(samples.values[~samples.lost][-1], dtype=np.float64)
        fits = self._match(lidar_points(self._lidar, scan, _RANGE_M))
        self.matched += fits
        self.refused += not fits
        self._astray = 0 if fits else self._astray + 1
        if self._astray >= _LOST_SCANS:
            self._forget()
        return self._pose()

    def _forget(self) -> None:
        """The place is off by as much as a fix may be."""
        state = self._get()
        place = (state[:2] + self.bias).tolist()
        self._set_by_fix((*place, float(state[2]), float(state[3])), (1.0, 1.0, 0.1, 1.0))
        self._astray = self._next_try = 0
        self.lost += 1

    def _match(self, echoes: Points) -> bool:
        """Take in what echoes (n, 3) of the vehicle's frame say; whether they fit the map."""
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
        self._take_match(target, best)
        return True

    def _apart(self, pose: Points) -> float:
        """Squared deviations by which a place and a heading (3,) are off what the filter says."""
        off = pose - self._get()[:3]
        off[2] = wrap(float(off[2]))
        spread = self._spread[:3, :3] + np.diag([_PAIR_M, _PAIR_M, _PAIR_M / _TURN_M]) ** 2
        return float(off @ np.linalg.solve(spread, off))

    def _starts(self, target: Target, echoes: Points, begin: Points) -> list[Points]:
        """Motions (4, 4) to match from: of where the vehicle may be, those that fit best."""
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

    def _take_match(self, target: Target, fit: _Fit) -> None:
        """Take in a place and a heading, as far as the normals of pairs tell them."""
        normals = _normals(target, fit)
        free = [
            axis for axis in np.linalg.eigh(normals.T @ normals)[1].T if _slides(target, fit, axis)
        ]
        for axis in free:  # stays where the filter has it
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
            if share < _WEAKEST * strength[-1] or share < 1.0:  # a metre
                continue
            off = seen - self._get()[:3]
            off[2] = wrap(float(off[2]))
            row = axis * (1.0, 1.0, _TURN_M)
            deviation = max(1.0 / math.sqrt(share), _LEAST_M * math.sqrt(strength[-1] / share))
            self._take(row, float(row @ off), deviation, gate=math.inf)


class _Walls:
    """The upright part of a cloud, by place, and how high its ground lies."""

    def __init__(self, path: Path) -> None:
        points = read_cloud(path).points
        whole = Target(points)
        upright = np.abs(np.asarray(whole.cloud.normals())[:, 2]) < _UPRIGHT
        self._points = points[upright]
        ground = points[~upright]
        if len(self._points) < FEWEST_POINTS:
            raise ConfigError(
                f"{path}: has no walls to match scans with ({len(self._points)} upright points): "
                "survey a map with buildings (map.buildings), or use localisation=gnss_imu"
            )
        gicp: Any = require("small_gicp", "maps")
        self._ground = ground if len(ground) else self._points
        flat = np.column_stack([self._ground[:, :2], np.zeros(len(self._ground))])
        self._tree = gicp.KdTree(flat)
        self._held: tuple[float, float, Target | None] | None = None

    def ground_m(self, x_m: float, y_m: float) -> float:
        """The height of the ground of the cloud that is nearest to a place."""
        rows, _ = self._tree.batch_nearest_neighbor_search(np.array([[x_m, y_m, 0.0]]))
        return float(self._ground[int(np.asarray(rows)[0]), 2])

    def around(self, x_m: float, y_m: float) -> Target | None:
        """The walls around a place; None: there are too few. It is kept while one is near."""
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
    """A scan that was laid onto walls."""

    motion: Points  # (4, 4) from the vehicle's frame to the map's
    placed: Points  # (n, 3) the echoes on the map
    rows: NDArray[np.int64]  # the wall point that is nearest to each
    distance_m: Points  # (n,) how far away that is

    def shifted(self, target: Target, by_m: Points) -> _Fit:
        """Laid elsewhere in the plane, by (2,)."""
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
        """Echoes that say where the vehicle is."""
        near: NDArray[np.bool_] = self.distance_m < _PAIR_M
        return near


def _likelihood(distance_m: Points) -> float:
    """Its logarithm, with a worst distance for what the map does not have."""
    near = np.minimum(distance_m, _PAIR_M) / (0.5 * _PAIR_M)
    return -0.5 * float(np.square(near).sum()) / _CORRELATED


def _slides(target: Target, fit: _Fit, axis: Points) -> bool:
    """Whether a scan fits about as well to one side along an axis (2,) of the plane.

    Normals alone do not say so: those of a rough wall point along it, too.
    """
    sides = [fit.shifted(target, way * axis).likelihood for way in (-_ASIDE_M, _ASIDE_M)]
    return fit.likelihood - max(sides) < _WORSE


def _normals(target: Target, fit: _Fit) -> Points:
    """(n, 2) of the walls that echoes lie on."""
    found: Points = np.asarray(target.cloud.normals())[fit.rows[fit.paired], :2]
    return found


def _fit(target: Target, points: Points, start: Points) -> _Fit:
    motion = _laid(target, points, start)
    placed = moved(points, motion)
    return _Fit(motion, placed, *target.nearest(placed))


def _laid(target: Target, points: Points, begin: Points) -> Points:
    """The motion (4, 4) that lays points of the vehicle's frame onto walls, from a guess on."""
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
    laid: Points = shift @ motion
    return laid
