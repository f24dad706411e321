"""`Stack`: localisation, perception, signals, planning and control, chosen by name and timed.

Control uses pure pursuit for the steering, and limits of the vehicle class for the acceleration.
Coulter: "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992: the
circle through the vehicle's centre, tangent to its motion, that meets a point of the path ahead has
the curvature 2 sin(alpha) / distance. A kinematic bicycle of length L (here the vehicle's length)
follows this curvature if its slip angle is asin(curvature · L / 2). The tangent of the steering
angle is twice the tangent of the slip angle.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import GnssConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.cosim.stack.camera_classes import LidarCamera
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.perception import LidarObjects
from cavmarl.cosim.stack.route_planning import LaneRoute
from cavmarl.cosim.stack.signal_reading import SpatSignals, ToldSignals
from cavmarl.cosim.stack.stack_types import (
    Control2D,
    ControlStage,
    EgoPose,
    Localisation,
    Mission,
    Obstacle,
    Perception,
    Planning,
    Readings,
    SignalReading,
    StackMount,
    StackSensor,
    Trajectory,
)
from cavmarl.sensors.mounted.geodesy import Geodesy, geodesy_of

P = ParamSpec("P")
R = TypeVar("R")


class Gains(NamedTuple):
    """The control parameters of a vehicle class."""

    lookahead_s: float  # lookahead of the steering, as time at the current speed
    least_lookahead_m: float  # minimum lookahead
    accel_mps2: float  # maximum acceleration
    brake_mps2: float  # maximum braking, positive
    steering_radps: float  # maximum rate of the front wheels


_CAR = Gains(0.5, 3.5, 2.5, 6.0, 1.2)
_HEAVY = Gains(0.7, 6.0, 1.2, 5.0, 0.6)

# By SUMO's class; other classes use the parameters of cars.
GAINS = {"passenger": _CAR, "truck": _HEAVY, "bus": _HEAVY}


class PurePursuit:
    """The control stage `pure_pursuit`."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._steering = 0.0

    def control(self, pose: EgoPose, trajectory: Trajectory, mission: Mission) -> Control2D:
        gains = GAINS.get(mission.vclass, _CAR)
        slip = math.atan(0.5 * math.tan(self._steering))
        ahead_m = max(gains.least_lookahead_m, gains.lookahead_s * pose.speed_mps)
        x_m, y_m = _point_at(trajectory, pose, ahead_m)
        east, north = x_m - pose.x_m, y_m - pose.y_m
        distance = max(math.hypot(east, north), 0.5)
        alpha = wrap_angle(math.atan2(north, east) - pose.heading_rad - slip)
        curvature = 2.0 * math.sin(alpha) / distance
        wanted_slip = math.asin(max(-0.6, min(0.6, 0.5 * mission.length_m * curvature)))
        wanted = math.atan(2.0 * math.tan(wanted_slip))
        turn = gains.steering_radps * self._tick_s
        self._steering += max(-turn, min(turn, wanted - self._steering))
        accel = max(-gains.brake_mps2, min(gains.accel_mps2, trajectory.accel_mps2))
        return Control2D(accel, self._steering)


def _point_at(trajectory: Trajectory, pose: EgoPose, ahead_m: float) -> tuple[float, float]:
    """Return the point of the route `ahead_m` beyond its point nearest to the vehicle."""
    points = trajectory.points
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    offset = np.array([pose.x_m, pose.y_m]) - points[:-1]
    safe = np.maximum(lengths, 1e-9)
    share = np.clip((offset * steps).sum(axis=1) / safe**2, 0.0, 1.0)
    off = np.hypot(*(offset - share[:, None] * steps).T)
    beside = int(np.argmin(off))
    s = along[beside] + share[beside] * lengths[beside] + ahead_m
    if s > along[-1]:  # extend the route in its last direction
        past = (s - along[-1]) / safe[-1]
        end = points[-1] + past * steps[-1]
        return float(end[0]), float(end[1])
    return (float(np.interp(s, along, points[:, 0])), float(np.interp(s, along, points[:, 1])))


# Noise of consumer-grade parts: a GNSS receiver without corrections, a MEMS inertial unit, wheel
# encoders, a camera that detects lane markings, and a lidar at the height of a bumper.
REFERENCE_RIG: dict[str, dict[str, Any]] = {
    "gnss": {"type": "gnss", "rate_hz": 10, "noise": [1.0, 1.0, 2.0], "z_m": 1.5},
    "imu": {"type": "imu", "rate_hz": 100, "noise": [0.05, 0.05, 0.05, 0.003, 0.003, 0.003]},
    "odometry": {"type": "odometry", "rate_hz": 20, "noise": [0.05, 0.01, 0.1]},
    "markings": {"type": "lane_boundary", "rate_hz": 20, "noise": [0.05, 0.05, 0.05, 0.01, 0.001]},
    "lidar": {
        "type": "lidar",
        "rate_hz": 10,
        "rays": 360,
        "range_m": 60.0,
        "noise": [0.02],
        "z_m": 0.6,
    },
}


# For `perception=lidar_camera`.
CAMERA_RIG = REFERENCE_RIG | {
    "eyes": {"type": "semantic_camera", "rate_hz": 10, "x_m": 0.6, "z_m": 1.4, "range_m": 60.0}
}
RIGS = {"reference": REFERENCE_RIG, "camera": CAMERA_RIG}


class Vehicle(NamedTuple):
    """The vehicle data that stages are made from."""

    hd_map: HdMap
    sensors: Sequence[StackSensor]  # mounted sensors
    geodesy: Geodesy | None  # the map's place on the earth; None: there is no GNSS
    tick_s: float
    cloud: Path | None = None  # a point-cloud map, in the frame of the map


class Blind:
    """A perception stage that detects nothing."""

    def perceive(self, readings: Readings, pose: EgoPose, time_s: float) -> list[Obstacle]:
        return []


def _geodesy(vehicle: Vehicle) -> Geodesy:
    if vehicle.geodesy is None:
        raise ConfigError(
            "localisation: there is no gnss among the sensors; mount one under `rig`, "
            "as {gnss: {type: gnss, rate_hz: 10}}"
        )
    return vehicle.geodesy


def _gnss_imu(vehicle: Vehicle) -> Localisation:
    geodesy = _geodesy(vehicle)
    return GnssInertial(vehicle.sensors, geodesy, vehicle.hd_map, vehicle.tick_s)


def _scan_matching(vehicle: Vehicle) -> Localisation:
    from cavmarl.cosim.stack.scan_matching import ScanMatching  # needs the extra `maps`

    geodesy = _geodesy(vehicle)
    return ScanMatching(vehicle.sensors, geodesy, vehicle.hd_map, vehicle.tick_s, vehicle.cloud)


# Stage → name → factory. Custom stages are added as further entries.
STAGES: dict[str, dict[str, Callable[[Vehicle], Any]]] = {
    "perception": {
        "lidar": lambda vehicle: LidarObjects(vehicle.sensors, vehicle.hd_map),
        "lidar_camera": lambda vehicle: LidarCamera(vehicle.sensors, vehicle.hd_map),
        "blind": lambda vehicle: Blind(),
    },
    "localisation": {"gnss_imu": _gnss_imu, "scan_matching": _scan_matching},
    "signals": {
        "told": lambda vehicle: ToldSignals(),
        "spat": lambda vehicle: SpatSignals(vehicle.hd_map),
    },
    "planning": {"lane_route": lambda vehicle: LaneRoute(vehicle.hd_map)},
    "control": {"pure_pursuit": lambda vehicle: PurePursuit(vehicle.tick_s)},
}


@dataclass(frozen=True)
class StackConfig:
    """The choice of the stages of a stack."""

    perception: str = "lidar"  # `lidar`, `lidar_camera`, or `blind`
    localisation: str = "gnss_imu"  # `gnss_imu`, or `scan_matching` against `cloud`
    signals: str = "told"  # `told`: given by the world; `spat`: sent by roadside units
    planning: str = "lane_route"  # `lane_route`
    control: str = "pure_pursuit"  # `pure_pursuit`
    cloud: Path | None = None  # a point-cloud map

    def __post_init__(self) -> None:
        for stage, known in STAGES.items():
            name = getattr(self, stage)
            if name not in known:
                raise ConfigError(f"{stage} = {name!r}: must be {' or '.join(known)}")


@dataclass
class StageTimes:
    """Durations of stages, by the wall clock."""

    steps: int = 0  # number of steps of the stack
    # sum over all steps, by stage
    wall_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    # maximum of one step, by stage
    worst_wall_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    def add(self, stage: str, seconds: float) -> None:
        self.wall_s[stage] += seconds
        self.worst_wall_s[stage] = max(self.worst_wall_s[stage], seconds)


class Stack:
    """Drives one vehicle.

    `vehicle`: the vehicle. `config`: the choice of stages.

    Attributes:
        times: durations of the stages.
        pose: estimated pose of the vehicle; None: unknown.
        obstacles: detected objects on the road.
        reason: reason for the acceleration; see `Trajectory`.
    """

    def __init__(self, vehicle: Vehicle, config: StackConfig | None = None) -> None:
        chosen = StackConfig() if config is None else config
        made = {name: known[getattr(chosen, name)](vehicle) for name, known in STAGES.items()}
        self._perception: Perception = made["perception"]
        self._localisation: Localisation = made["localisation"]
        self._signals: SignalReading = made["signals"]
        self._planning: Planning = made["planning"]
        self._control: ControlStage = made["control"]
        self.times = StageTimes()
        self.pose: EgoPose | None = None
        self.obstacles: list[Obstacle] = []
        self.reason = ""

    def reset_pose(self, pose: EgoPose) -> None:
        """Set the pose of the vehicle in the localisation; optional."""
        self._localisation.reset_pose(pose)

    def drive(
        self, readings: Readings, signals: NDArray[np.uint8] | None, mission: Mission, time_s: float
    ) -> Control2D:
        """Run all stages once; without a pose the vehicle brakes.

        `readings`: new samples of the sensors. `signals`: signals as given by the world; see
        `SignalReading`. `time_s`: simulated time.
        """
        self.times.steps += 1
        pose = self.pose = self._timed(
            "localisation", self._localisation.locate, readings, mission, time_s
        )
        if pose is None:
            self.reason = "no pose"
            return Control2D(-1.0, 0.0)
        self.obstacles = self._timed(
            "perception", self._perception.perceive, readings, pose, time_s
        )
        shown = self._timed("signals", self._signals.read, readings, signals)
        trajectory = self._timed(
            "planning", self._planning.plan, pose, self.obstacles, shown, mission
        )
        self.reason = trajectory.reason
        driven: Control2D = self._timed("control", self._control.control, pose, trajectory, mission)
        return driven

    def _timed(self, stage: str, run: Callable[P, R], *given: P.args, **named: P.kwargs) -> R:
        began = time.perf_counter()
        found = run(*given, **named)
        self.times.add(stage, time.perf_counter() - began)
        return found


def sensor_of(name: str, settings: Mapping[str, Any]) -> StackSensor:
    """Return a sensor for its keys in `env.yaml`."""
    mount = StackMount(settings["x_m"], settings["y_m"], math.radians(settings["yaw_deg"]))
    return StackSensor(name, settings["type"], mount, settings)


def vehicle_of(
    hd_map: HdMap, sensors: Sequence[StackSensor], tick_s: float, cloud: Path | None = None
) -> Vehicle:
    """Return the vehicle data for stages.

    `sensors`: mounted sensors. `cloud`: a point-cloud map.

    Raises MissingExtraError: the map is projected, and pyproj is not installed; MapError: its
    projection is unknown.
    """
    gnss = [sensor for sensor in sensors if sensor.type == "gnss"]
    geodesy = None
    if gnss:
        names = ("rate_hz", "origin_lat_deg", "origin_lon_deg", "origin_height_m")
        config = GnssConfig(**{name: gnss[0].settings[name] for name in names})
        geodesy = geodesy_of(hd_map.network, config)
    return Vehicle(hd_map, sensors, geodesy, tick_s, cloud)
