"""`Surroundings`: the view of a world for sensors that are attached while it runs.

The kernels of mounted sensors write samples of agents. For a sensor of a client, they get a copy of
the rows in which only the carrier of the sensor is an agent. A sensor without a carrier has a row
of its own, on the ground below the sensor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.math.neighbors import make_grid
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.cosim.carla.carla_geometry import CarlaPose, carla_pose, mount_in_vehicle, relative
from cavmarl.cosim.carla.hosted_world import HostedWorld
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.sensors.kernels.camera_picture import colours, make_camera, make_picture
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.polygon_fill import PixelRows
from cavmarl.sensors.kernels.ray_caster import HIT, make_fan
from cavmarl.sensors.kernels.rig_frames import Due, Noise
from cavmarl.sensors.kernels.rig_pictures import take_pictures
from cavmarl.sensors.kernels.rig_rays import measure_lidar
from cavmarl.sensors.mounted.backdrop import make_backdrop

_CELL_M = 32.0
_NO_ID = -2  # id of the row of a sensor without a carrier; -1 means no hit


class RayHits(NamedTuple):
    """The first hits of rays, in A columns and E channels."""

    hits: NDArray[np.void]  # HIT (A, E)
    rays: NDArray[np.float64]  # (A, E, 3) directions in the frame of the carrier
    mount: NDArray[np.float64]  # (3, 4) of the sensor on its carrier
    carrier: CarlaPose  # pose of the carrier


class Surroundings:
    """The view of one world.

    Attributes:
        panorama: the surroundings of the last observer; hits refer to its bodies and walls.
    """

    def __init__(self, world: HostedWorld) -> None:
        network = world.map.network
        capacity = world.simulation.capacity + 1
        self.world = world
        self._backdrop = make_backdrop(network, world.simulation.types)
        self.panorama = make_panorama(self._backdrop, capacity)
        self._grid = make_grid(network.extent_m, _CELL_M, capacity)
        self._rows = np.zeros((1, capacity), VEHICLE)
        one = np.ones(1, np.int64)
        self._due = Due(one, 0 * one, 0 * one, np.ones(1, dtype=np.bool_))
        self._measure: Any = specialized(measure_lidar)
        self._blank = blank_vehicle()

    def cast(
        self,
        pose: CarlaPose,
        carrier: int,
        azimuths_rad: tuple[float, float, int],
        elevations_rad: NDArray[np.float64],
        range_m: float,
    ) -> RayHits:
        """Cast rays.

        Args:
            pose: of the sensor.
            carrier: id of the vehicle that carries it and is not seen, or -1.
            azimuths_rad: first azimuth, step and number of columns, counter-clockwise.
            elevations_rad: (E,) of the channels.
            range_m: range of the sensor.
        """
        worlds, there = self._observe(pose, carrier)
        mount = mount_in_vehicle(relative(there, pose))
        fan = make_fan(mount, azimuths_rad, elevations_rad, range_m)
        columns, channels = fan.ground_m.shape
        hits = np.zeros((columns, channels), HIT)
        data = np.zeros((1, 1, 1, channels, columns), np.float32)
        noise = Noise(np.uint64(0), np.zeros(1), np.zeros(1))
        self._measure(
            worlds, self._grid, self._backdrop, self._due, _all_lines(columns), noise, fan,
            self.panorama, hits, data,
        )  # fmt: skip
        return RayHits(hits, fan.rays, mount, there)

    def take_picture(self, lens: Lens, pose: CarlaPose, carrier: int) -> NDArray[Any]:
        """Return colours (H, W, 3) or classes (H, W) as uint8, or depths (H, W) as float32 in m.

        Depths of pixels without an object are the range of the camera.
        """
        worlds, there = self._observe(pose, carrier)
        mount = mount_in_vehicle(relative(there, pose))
        camera = make_camera(mount, lens.width, lens.fov_rad, lens.range_m)
        picture = lens.picture_of(self)
        noise = Noise(np.uint64(0), np.zeros(lens.channels), np.zeros(lens.channels))
        data = np.zeros((1, 1, 1, *lens.shape), np.uint16 if lens.kind == "depth" else np.uint8)
        lens.take(
            worlds, self._grid, self._backdrop, self._due, _all_lines(lens.height), noise, camera,
            self.panorama, picture, *lens.own, data,
        )  # fmt: skip
        return lens.scratch if lens.kind == "depth" else data[0, 0, 0]

    def _observe(self, pose: CarlaPose, carrier: int) -> tuple[Worlds, CarlaPose]:
        """Return the worlds with one agent, the carrier, and the pose of the carrier."""
        present = self.world.rows
        num = len(present)
        rows = self._rows[0]
        rows[:num] = present
        rows["driver"][:num] = DRIVER_BACKGROUND
        rows["agent"][:num] = -1
        found = np.flatnonzero(present["id"] == carrier)
        row = int(found[0]) if len(found) else num
        if row == num:
            num += 1
            rows[row] = self._blank[0]
            rows[row]["id"] = _NO_ID
            rows[row]["x"], rows[row]["y"] = pose.x, -pose.y
            rows[row]["z"] = self._ground_m(pose.x, -pose.y)
        rows[row]["driver"], rows[row]["agent"] = DRIVER_AGENT, 0
        own = rows[row]
        x, y, z, heading, pitch = (float(own[name]) for name in ("x", "y", "z", "heading", "pitch"))
        count = np.array([num], np.int64)
        whole = self.world.simulation.worlds
        worlds = whole._replace(
            rows=self._rows, next_rows=self._rows, num_owned=count, num_rows=count
        )
        return worlds, carla_pose(x, y, z, heading, pitch)

    def _ground_m(self, x: float, y: float) -> float:
        """Return the height of the road nearest to a place."""
        points = self.world.map.network.points
        apart = (points["x"] - x) ** 2 + (points["y"] - y) ** 2
        return float(points["z"][apart.argmin()])


class Lens:
    """The optics and the memory of a camera. `kind`: depth, classes or colours."""

    def __init__(self, kind: str, width: int, height: int, fov_rad: float, range_m: float) -> None:
        self.kind, self.width, self.height = kind, width, height
        self.fov_rad, self.range_m = fov_rad, range_m
        self.shape = (height, width, 3) if kind == "colours" else (height, width)
        self.channels = 3 if kind == "colours" else 1
        self.scratch = np.zeros((height, width), np.float32)
        self.own: tuple[Any, ...] = {
            "depth": (self.scratch, self.scratch.view(np.uint32), None, None),
            "classes": (None, None, None, True),
            "colours": (None, None, colours(), None),
        }[kind]
        self.take: Any = specialized(take_pictures)
        self._picture: PixelRows | None = None
        self._made_for: Surroundings | None = None

    def picture_of(self, surroundings: Surroundings) -> PixelRows:
        """Return memory for a whole picture of some surroundings."""
        if self._picture is None or self._made_for is not surroundings:
            whole = (self.height, self.width)
            self._picture = make_picture(self.width, self.height, surroundings.panorama)._replace(
                closeness=np.zeros(whole), face=np.zeros(whole, np.int32)
            )
            self._made_for = surroundings
        return self._picture


def _all_lines(count: int) -> NDArray[np.int32]:
    return np.array([[[0, count]]], np.int32)
