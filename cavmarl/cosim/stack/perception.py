"""Perception by lidar: echoes near roads are grouped into objects, which are tracked.

Neighbouring echoes belong to one object if their distance is at most `_GAP_M` plus the distance
between two rays there. Echoes off the lanes are ignored, as buildings or parked objects. An
object is a box along its lane. Its velocity comes from an alpha-beta filter
(Kalata: "The tracking index", IEEE Trans. AES 20, 1984) over the boxes of the last steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import wrap_angle
from cavmarl.cosim.stack.hd_map import HdMap, OnLane
from cavmarl.cosim.stack.stack_types import EgoPose, Obstacle, Readings, StackSensor
from cavmarl.sensors.mounted.lidar import azimuths, elevations, has_echo

_GAP_M = 0.8
_ROAD_M = 2.5  # maximum distance of an echo from the centre of a lane
_BESIDE_ROAD_M = 6.0  # the same for pedestrians, who may step onto the road
_MATCH_M = 3.0  # maximum distance between an object and its predicted position
_SAME_M = 0.5  # the same, if the object is to keep the kind of an earlier detection
_ALPHA, _BETA = 0.5, 0.2  # gains of the alpha-beta filter
_FORGET_S = 0.5  # an object that is not detected for this time is forgotten
_STILL_MPS = 0.6  # slower objects are reported as stopped
_FEW = 3  # detections before a velocity is used


@dataclass
class _Track:
    """An object that has been detected before."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    seen_s: float  # time of the last detection
    times: int  # number of detections
    kind: str


class LidarObjects:
    """The perception stage `lidar`.

    `sensors`: sensors of the vehicle; only lidars are used.
    """

    def __init__(self, sensors: Sequence[StackSensor], hd_map: HdMap) -> None:
        self._lidars = [sensor for sensor in sensors if sensor.type == "lidar"]
        self._map = hd_map
        self._tracks: list[_Track] = []
        self._last: list[Obstacle] = []

    def perceive(self, readings: Readings, pose: EgoPose, time_s: float) -> list[Obstacle]:
        """Return objects on the road; without a new scan, the objects of the last scan."""
        echoes = []
        for lidar in self._lidars:
            samples = readings.get(lidar.name)
            if samples is not None and not samples.lost.all():
                scan = np.asarray(samples.values[~samples.lost][-1], dtype=np.float64)
                echoes.extend(_groups(lidar, scan, pose))
        if echoes:
            self._read_others(readings, pose, echoes)
            boxes = [box for group in echoes if (box := self._box(group, pose)) is not None]
            self._last = [self._follow(box, time_s) for box in boxes]
            self._tracks = [track for track in self._tracks if time_s - track.seen_s < _FORGET_S]
        return self._last

    def _read_others(
        self, readings: Readings, pose: EgoPose, groups: Sequence[NDArray[np.float64]]
    ) -> None:
        """Read other sensors before groups of echoes (n, 2) are classified."""

    def _kind(self, group: NDArray[np.float64]) -> str:
        """Return the kind of an object with echoes (n, 2); a lidar alone does not know it."""
        return "unknown"

    def _box(self, group: NDArray[np.float64], pose: EgoPose) -> Obstacle | None:
        """Return the box around echoes (n, 2), along their lane; None: off the road."""
        x_m, y_m = group.mean(axis=0).tolist()
        kind = self._kind(group)
        beside_m = _BESIDE_ROAD_M if kind == "pedestrian" else _ROAD_M
        lanes = self._map.near(x_m, y_m, beside_m)
        if not lanes or kind == "building":
            return None
        heading = _along(lanes, pose)
        cos, sin = math.cos(heading), math.sin(heading)
        along, across = group @ (cos, sin), group @ (-sin, cos)
        middle_along = 0.5 * float(along.min() + along.max())
        middle_across = 0.5 * float(across.min() + across.max())
        return Obstacle(
            middle_along * cos - middle_across * sin,
            middle_along * sin + middle_across * cos,
            heading,
            float(np.ptp(along)),
            float(np.ptp(across)),
            0.0,
            0.0,
            kind,
        )

    def _follow(self, box: Obstacle, time_s: float) -> Obstacle:
        """Return the box with the velocity of the track that it matches."""
        best, nearest = None, _MATCH_M
        for track in self._tracks:
            elapsed = time_s - track.seen_s
            if elapsed <= 0.0 or _differ(track.kind, box.kind):
                continue
            off = math.hypot(
                box.x_m - track.x_m - track.vx_mps * elapsed,
                box.y_m - track.y_m - track.vy_mps * elapsed,
            )
            if off < nearest:
                best, nearest = track, off
        if best is None:
            self._tracks.append(_Track(box.x_m, box.y_m, 0.0, 0.0, time_s, 1, box.kind))
            return box
        elapsed = time_s - best.seen_s
        for axis, speed, seen in (("x_m", "vx_mps", box.x_m), ("y_m", "vy_mps", box.y_m)):
            expected = getattr(best, axis) + getattr(best, speed) * elapsed
            surprise = seen - expected
            # The difference of the first two detections is the best estimate of a velocity.
            beta = 1.0 if best.times == 1 else _BETA
            setattr(best, axis, expected + _ALPHA * surprise)
            setattr(best, speed, getattr(best, speed) + beta * surprise / elapsed)
        best.seen_s, best.times = time_s, best.times + 1
        if box.kind != "unknown":
            best.kind = box.kind
        elif nearest < _SAME_M:
            box = box._replace(kind=best.kind)
        speed_mps = math.hypot(best.vx_mps, best.vy_mps)
        if best.times < _FEW or speed_mps < _STILL_MPS:
            return box
        return box._replace(vx_mps=best.vx_mps, vy_mps=best.vy_mps)


def _differ(one: str, other: str) -> bool:
    """Return whether both kinds are known and differ."""
    return one != other and "unknown" not in (one, other)


def _along(lanes: Sequence[OnLane], pose: EgoPose) -> float:
    """Return the direction of the nearest lane, reversed if the vehicle's heading is opposite."""
    nearest = lanes[0].heading_rad
    apart = abs(wrap_angle(nearest - pose.heading_rad))
    return nearest if apart < 0.5 * math.pi else wrap_angle(nearest + math.pi)


def _groups(
    lidar: StackSensor, scan: NDArray[np.float64], pose: EgoPose
) -> list[NDArray[np.float64]]:
    """Return groups of echoes on the map, (n, 2) each.

    `scan`: (layers, rays) distances in m.
    """
    settings = lidar.settings
    layers = scan.shape[0]
    level = 0
    if layers > 1:
        rising = elevations(settings["lower_deg"], settings["upper_deg"], layers)
        level = int(np.argmin(np.abs(rising).round(9)))  # the lower of equal layers
    all_around = settings["fov_deg"] == 360.0
    first, step, rays = azimuths(settings["fov_deg"], scan.shape[1])
    turns = first + step * np.arange(rays) + lidar.mount.yaw_rad
    ranges = scan[level]
    x_m = lidar.mount.x_m + ranges * np.cos(turns)
    y_m = lidar.mount.y_m + ranges * np.sin(turns)
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    points = np.stack([pose.x_m + x_m * cos - y_m * sin, pose.y_m + x_m * sin + y_m * cos], axis=1)
    (hits,) = np.nonzero(has_echo(ranges, settings["range_m"]))
    if not hits.size:
        return []
    apart = np.hypot(*(points[hits[1:]] - points[hits[:-1]]).T)
    allowed = _GAP_M + np.maximum(ranges[hits[1:]], ranges[hits[:-1]]) * step
    groups = np.split(hits, np.flatnonzero(apart > allowed) + 1)
    if all_around and len(groups) > 1:
        first, last = groups[0][0], groups[-1][-1]
        if np.hypot(*(points[first] - points[last])) <= _GAP_M + ranges[first] * step:
            groups[0] = np.concatenate([groups.pop(), groups[0]])
    return [points[group] for group in groups]
