"""`OpticalFlowCamera`: the motion of the point that each pixel shows, since the last picture."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.carla.attached_imaging import CAMERA_RANGE_M, AttachedCamera
from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_geometry import CarlaPose, axes_of
from cavmarl.cosim.carla.sensor_settings import SensorContext

_SKY_M = 1e6  # depth of pixels without an object, which move only if the camera turns
_LARGEST = 2.0  # largest absolute flow, as in CARLA
_NEAR_M = 0.01  # points nearer to the camera, or behind it, count as at this distance ahead

Floats = NDArray[np.float64]


class _Bodies(NamedTuple):
    """The places of vehicles and walkers at the time of a picture, in CARLA's frame."""

    ids: NDArray[np.int64]  # (n,) ascending
    place: Floats  # (n, 3)
    yaw: Floats  # (n,) rad

    @classmethod
    def of(cls, rows: NDArray[np.void]) -> _Bodies:
        """Return the places of VEHICLE rows."""
        rows = rows[np.argsort(rows["id"])]
        place = np.stack([rows["x"], -rows["y"], rows["z"]], axis=1)
        return cls(rows["id"].copy(), place, -rows["heading"])

    def find(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Return which ids (n,) are present, and their rows."""
        rows = np.searchsorted(self.ids, ids)
        known = rows < len(self.ids)
        known[known] = self.ids[rows[known]] == ids[known]
        return known, rows[known]


class OpticalFlowCamera(AttachedCamera):
    """The motion of each pixel since the last picture, in halves of the picture's size.

    Two numbers per pixel: to the right in halves of the width, and upwards in halves of the height.
    The first picture has no motion.
    """

    kind = 8
    picture = "depth"
    _before: tuple[CarlaPose, _Bodies] | None = None

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        lens, surroundings = self.lens, context.surroundings
        carrier = context.hidden_carrier_of(actor)
        depth = surroundings.take_picture(lens, actor.pose, carrier).astype(np.float64)
        depth[depth >= CAMERA_RANGE_M] = _SKY_M
        now = _Bodies.of(surroundings.world.rows)
        flow = np.zeros((lens.height, lens.width, 2), "<f4")
        if self._before is not None:
            pose, bodies = self._before
            points = actor.pose.place + self._rays(depth) @ axes_of(actor.pose).T
            shown, ids = self.bodies(context)
            points[shown] = _moved_back(points[shown], ids, now, bodies)
            was = (points - pose.place) @ axes_of(pose)
            flow[...] = self._places(self._rays(depth)) - self._places(was)
        self._before = actor.pose, now
        return self.head + np.clip(flow, -_LARGEST, _LARGEST).tobytes()

    @property
    def _slopes(self) -> tuple[float, float]:
        """Tangents of half the field of view, to the side and upwards."""
        across = math.tan(0.5 * self.lens.fov_rad)
        return across, across * self.lens.height / self.lens.width

    def _rays(self, depth: Floats) -> Floats:
        """Return the points (H, W, 3) at some depths (H, W): ahead, to the right, upwards."""
        height, width = depth.shape
        across, up = self._slopes
        right = across * (2.0 * (np.arange(width) + 0.5) / width - 1.0)
        above = up * (1.0 - 2.0 * (np.arange(height) + 0.5) / height)
        return np.stack([depth, depth * right[None, :], depth * above[:, None]], axis=2)

    def _places(self, points: Floats) -> Floats:
        """Return where (H, W, 2) points are in the picture: from -1 to 1, to the right and up."""
        ahead = np.maximum(points[..., :1], _NEAR_M)
        found: Floats = points[..., 1:] / (ahead * np.array(self._slopes))
        return found


def _moved_back(points: Floats, ids: NDArray[np.int64], now: _Bodies, before: _Bodies) -> Floats:
    """Return where points (n, 3) of bodies were; bodies without a former place count as still."""
    found = points.copy()
    known, then = before.find(ids)
    _, here = now.find(ids[known])
    turn = before.yaw[then] - now.yaw[here]
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, z = (points[known] - now.place[here]).T
    found[known] = before.place[then] + np.stack([x * cos - y * sin, x * sin + y * cos, z], axis=1)
    return found
