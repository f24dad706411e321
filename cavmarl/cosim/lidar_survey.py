"""A point-cloud map from driving: lidar frames placed by the stack's GNSS, IMU and odometry.

The true poses are not used for the cloud, but only to report the error of the estimated poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.cosim.followers.follower_client import Samples, sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.height_track import HeightTrack
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.lidar_points import lidar_points
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.stack import REFERENCE_RIG, Vehicle, sensor_of, vehicle_of
from cavmarl.cosim.stack.stack_types import Mission, StackSensor
from cavmarl.env.vector import CavVectorEnv
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.maps.fidelity.cloud_filters import thin_out
from cavmarl.sensors.kernels.rig_frames import rotation

Points = NDArray[np.float64]

SURVEY_RIG: dict[str, dict[str, Any]] = {
    **{name: keys for name, keys in REFERENCE_RIG.items() if name != "lidar"},
    "roof": {
        "type": "lidar", "rate_hz": 5, "z_m": 1.6, "layers": 16, "rays": 360, "range_m": 60.0,
        "lower_deg": -20.0, "upper_deg": 12.0, "noise": [0.02],
    },
}  # fmt: skip

_SETTLED_S = 5.0  # frames of this time at the start are skipped: the filter finds its heading
_STANDS_MPS = 0.3  # frames of slower vehicles are skipped: they show nothing new
_FRAMES_HELD = 200  # frames collected before the cloud is thinned


@dataclass(frozen=True)
class Survey:
    """The cloud of a survey, and the errors of its poses."""

    cloud: Cloud  # in the frame of the map
    frames: int  # number of lidar frames in the cloud
    drives: int  # number of trips of vehicles
    off_m: Points  # (n,) horizontal error of each frame's pose
    off_height_m: Points  # (n,) signed error
    off_heading_rad: Points  # (n,) signed error


@dataclass
class _Drive:
    """The drive of one vehicle from its first fix to its end."""

    vehicle_id: int
    begun_s: float
    last_s: float
    stage: GnssInertial
    heights: HeightTrack
    frames: list[tuple[int, Points, tuple[float, ...], tuple[float, ...]]] = field(
        default_factory=list
    )
    steps: int = 0


class Surveyor:
    """Drives the vehicles of some worlds and collects their lidar echoes.

    `env`: worlds with `SURVEY_RIG` and one vehicle each. `range_m`: maximum range of used echoes.
    `voxel_m`: one point is kept in each cube with this side.

    Raises ConfigError: there is no lidar with several layers, or no GNSS.
    """

    def __init__(self, env: CavVectorEnv, range_m: float, voxel_m: float) -> None:
        self._env = env
        self._range_m, self._voxel_m = range_m, voxel_m
        welcome = welcome_to(env, env.possible_agents, 0)
        sensors = [sensor_of(view.name, view.settings) for view in welcome.sensors]
        lidars = [one for one in sensors if one.type == "lidar" and one.settings["layers"] > 1]
        if not lidars:
            raise ConfigError(
                "a survey needs a lidar with several layers; mount one under `rig`, as {roof: "
                "{type: lidar, rate_hz: 5, layers: 16, z_m: 1.6}}"
            )
        self._lidar: StackSensor = lidars[0]
        self._by_type = {sensor.type: sensor for sensor in sensors}
        self._step_s = welcome.dt_s * welcome.ticks_per_step
        self._vehicle: Vehicle = vehicle_of(HdMap(env.network), sensors, self._step_s)
        if self._vehicle.geodesy is None:
            raise ConfigError("a survey needs a gnss; mount one under `rig`")
        self._drives: list[_Drive | None] = [None] * len(env.worlds.arrays.mask)
        self._parts: list[Points] = []
        self._off: list[tuple[float, float, float]] = []
        self._frames = self._ended = self._read = 0

    def run(self, steps: int, told: Callable[[int], None] = lambda step: None) -> Survey:
        """Run all worlds for a number of steps; `told` is called after each step."""
        env = self._env
        for step in range(steps):
            for world in range(len(self._drives)):
                self._read_sensors(world)
            env.step(env.suggest_actions())
            told(step + 1)
        for world in range(len(self._drives)):
            self._end(world)
        off = np.array(self._off).reshape(-1, 3)
        cloud = self._thinned()
        counts = {"read": self._read, "voxel filter": self._read - len(cloud)}
        named = Cloud(f"survey of '{env.network.name}'", cloud, counts)
        return Survey(named, self._frames, self._ended, off[:, 0], off[:, 1], off[:, 2])

    def _read_sensors(self, world: int) -> None:
        """Add the sensor samples of one world's vehicle from the last step."""
        env = self._env
        tick = int(env.worlds.ticks()[world])
        seen = sight_of(*take_snapshot(env, [0], SnapshotTime(0, 0, tick, False), world))
        view = seen.snapshot.vehicles.get(env.possible_agents[0])
        time_s = seen.snapshot.time_s
        drive = self._drives[world]
        if drive is not None and (
            view is None or view.vehicle_id != drive.vehicle_id or time_s <= drive.last_s
        ):
            self._end(world)
            drive = None
        if view is None:
            return
        readings = seen.sensors[env.possible_agents[0]]
        if drive is None:
            drive = self._drives[world] = self._begin(view.vehicle_id, time_s)
        mission = Mission(0, view.vclass, view.length_m, view.width_m)
        pose = drive.stage.locate(readings, mission, time_s)
        self._take_height(drive, readings, time_s)
        scan = _newest(readings.get(self._lidar.name))
        settled = time_s - drive.begun_s >= _SETTLED_S
        if pose is None or scan is None or not settled or pose.speed_mps < _STANDS_MPS:
            return
        points = lidar_points(self._lidar, scan.astype(np.float64), self._range_m)
        rows = env.simulation.vehicles(world)
        row = rows[rows["id"] == view.vehicle_id][0]
        truth = tuple(float(row[name]) for name in ("x", "y", "z", "heading"))
        place = (pose.x_m, pose.y_m, pose.heading_rad)
        drive.frames.append((drive.steps - 1, points, place, truth))

    def _begin(self, vehicle_id: int, time_s: float) -> _Drive:
        vehicle = self._vehicle
        assert vehicle.geodesy is not None
        stage = GnssInertial(vehicle.sensors, vehicle.geodesy, vehicle.hd_map, vehicle.tick_s)
        noise = [self._by_type[kind].settings["noise"] for kind in ("gnss", "odometry")]
        heights = HeightTrack(max(0.05, float(noise[0][-1])), max(0.02, float(noise[1][0])))
        return _Drive(vehicle_id, time_s, time_s - self._step_s, stage, heights)

    def _take_height(self, drive: _Drive, readings: Any, time_s: float) -> None:
        assert self._vehicle.geodesy is not None
        force = readings.get(self._by_type["imu"].name) if "imu" in self._by_type else None
        along = 0.0
        if force is not None and not force.lost.all():
            along = float(force.values[~force.lost, 0].mean())
        speed = _newest(readings.get(self._by_type["odometry"].name))
        fix = _newest(readings.get(self._by_type["gnss"].name))
        height = None
        if fix is not None:
            mounted_m = float(self._by_type["gnss"].settings["z_m"])
            height = float(self._vehicle.geodesy.to_map(fix[None, :])[0, 2]) - mounted_m
        drive.heights.add(
            time_s - drive.last_s, along, None if speed is None else float(speed[0]), height
        )
        drive.last_s = time_s
        drive.steps += 1

    def _end(self, world: int) -> None:
        """Add the frames of a finished drive to the cloud."""
        drive, self._drives[world] = self._drives[world], None
        if drive is None or not drive.frames:
            return
        heights, pitches = drive.heights.smoothed()
        turn = np.zeros((3, 3))
        for step, points, (x, y, heading), truth in drive.frames:
            rotation(heading, float(pitches[step]), 0.0, turn)
            self._parts.append(points @ turn.T + np.array([x, y, heights[step]]))
            self._read += len(points)
            off_m = math.hypot(x - truth[0], y - truth[1])
            self._off.append(
                (off_m, float(heights[step]) - truth[2], wrap_angle(heading - truth[3]))
            )
        self._frames += len(drive.frames)
        self._ended += 1
        if len(self._parts) > _FRAMES_HELD:
            self._parts = [self._thinned()]

    def _thinned(self) -> Points:
        if not self._parts:
            return np.zeros((0, 3))
        return thin_out(Cloud("survey", np.concatenate(self._parts)), self._voxel_m).points


def _newest(samples: Samples | None) -> NDArray[Any] | None:
    if samples is None or samples.lost.all():
        return None
    newest: NDArray[Any] = samples.values[~samples.lost][-1]
    return newest
