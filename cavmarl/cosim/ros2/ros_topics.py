"""`VehicleTopics` and `WorldTopics`: the messages that are published about a world, by topic."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.io import read_yaml
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.follower_client import FollowerView
from cavmarl.cosim.followers.follower_messages import SensorView
from cavmarl.cosim.followers.follower_snapshots import TRUTH
from cavmarl.cosim.ros2.ros_types import RosMessage, header_of, time_of
from cavmarl.cosim.ros2.sensor_messages import (
    SENSORS,
    Fields,
    TrueState,
    markers,
    mount_transforms,
    odometry,
    transform,
    true_state,
)

log = logging.getLogger(__name__)

Profile = Literal["plain", "autoware"]

CLOCK, TF, TF_STATIC = "/clock", "/tf", "/tf_static"
VEHICLES, SIGNALS = "/vehicles", "/signals"
_TF_KIND = "tf2_msgs/msg/TFMessage"
_DRIVE, _AUTONOMOUS = 2, 1  # GearReport, ControlModeReport

# Topic of each type of sensor in the profile `autoware`; {} is the name of the sensor.
_AUTOWARE_TOPICS = {
    "lidar": "/sensing/lidar/{}/pointcloud_before_sync",
    "radar": "/sensing/radar/{}/points",
    "imu": "/sensing/imu/{}/imu_raw",
    "gnss": "/sensing/gnss/nav_sat_fix",
    "odometry": "/sensing/vehicle_velocity_converter/{}/twist",
}


def kinds_of_world(truth: bool) -> dict[str, str]:
    """Return the type of each topic about the world; `truth`: whether true states are published."""
    kinds = {CLOCK: "rosgraph_msgs/msg/Clock", SIGNALS: "std_msgs/msg/UInt8MultiArray"}
    if truth:
        kinds |= {TF: _TF_KIND, VEHICLES: "visualization_msgs/msg/MarkerArray"}
    return kinds


class RosClock:
    """ROS time of a world. It increases across episodes, because ROS time must not go back.

    `dt_s`: length of a tick; `ticks_per_step`: ticks of a step.
    """

    def __init__(self, dt_s: float, ticks_per_step: int) -> None:
        self._dt_ns = round(1e9 * dt_s)
        self.step_ns = self._dt_ns * ticks_per_step
        self._episode = -1
        self._begin_ns = 0
        self.now_ns = 0

    def set(self, episode: int, tick: int) -> None:
        """Set the time to a tick of an episode."""
        if episode != self._episode:
            if self._episode >= 0:
                self._begin_ns = self.now_ns + self.step_ns
            self._episode = episode
        self.now_ns = self._begin_ns + tick * self._dt_ns

    def ns_of(self, stamp_s: float) -> int:
        """Return the time of a sample of the present episode."""
        return self._begin_ns + round(1e9 * stamp_s)


@dataclass(frozen=True)
class SensorNames:
    """Names of a sensor."""

    topic: str  # the topic, or the prefix of topics such as `…/image_raw`
    frame: str


class _Sensor(NamedTuple):
    view: SensorView
    names: SensorNames
    topics: dict[str, str]  # part → topic


def read_names(path: Path | None) -> dict[str, dict[str, str]]:
    """Return names by sensor from a file: `SENSOR: {frame: NAME, topic: NAME}`.

    Raises ConfigError: the file cannot be read or has another structure.
    """
    if path is None:
        return {}
    found = read_yaml(path)
    if not isinstance(found, Mapping) or not all(
        isinstance(names, Mapping)
        and names.keys() <= {"frame", "topic"}
        and all(isinstance(name, str) for name in names.values())
        for names in found.values()
    ):
        raise ConfigError(
            f"{path}: must contain sensors with names, as roof: {{frame: velodyne_top, topic: "
            "/sensing/lidar/top}; both names are optional"
        )
    return {str(sensor): dict(names) for sensor, names in found.items()}


class VehicleTopics:
    """The topics of one vehicle.

    Args:
        vehicle: id of its agent.
        sensors: its sensors.
        profile: `plain`: topics and frames begin with the id. `autoware`: the topics and frames of
            Autoware, for one vehicle.
        names: other names, by sensor; see `read_names`.
        truth: whether its true state is published.

    Attributes:
        base: name of the frame `base_link`.
        kinds: type of each topic.

    Raises:
        ConfigError: `names` has a sensor that the vehicle does not have, or two sensors have one
            topic.
    """

    def __init__(
        self,
        vehicle: str,
        sensors: Sequence[SensorView],
        profile: Profile,
        names: Mapping[str, Mapping[str, str]],
        truth: bool,
    ) -> None:
        known = [view.name for view in sensors]
        if unknown := [name for name in names if name not in known]:
            raise ConfigError(
                f"names of sensors: no sensor {unknown[0]!r}; choose among {', '.join(known)}"
            )
        self.vehicle = vehicle
        self.is_plain = profile == "plain"
        self.base = f"{vehicle}/base_link" if self.is_plain else "base_link"
        self._sensors = {}
        skipped = []
        for view in sensors:
            if view.settings.get("type") not in SENSORS:
                skipped.append(f"{view.name} ({view.settings.get('type')})")
                continue
            own = self._names(view, names.get(view.name, {}))
            parts = SENSORS[view.settings["type"]][1]
            topics = {part: f"{own.topic}/{part}".rstrip("/") for part, _ in parts}
            if len(parts) == 1:
                topics = {parts[0][0]: own.topic}
            self._sensors[view.name] = _Sensor(view, own, topics)
        if skipped:
            log.warning(
                "%s: %d sensors have no ROS message and are not published: %s",
                vehicle,
                len(skipped),
                ", ".join(skipped),
            )
        self.kinds: dict[str, str] = {}
        for name, sensor in self._sensors.items():
            kinds = dict(SENSORS[sensor.view.settings["type"]][1])
            for part, topic in sensor.topics.items():
                if topic in self.kinds:
                    raise ConfigError(
                        f"{name}: another sensor has the topic {topic}; give one of them another "
                        "topic in the file of names"
                    )
                self.kinds[topic] = kinds[part]
        self._truth = f"/{vehicle}/truth" if self.is_plain else "/localization/kinematic_state"
        if truth:
            self.kinds[self._truth] = "nav_msgs/msg/Odometry"
        if not self.is_plain:
            if truth:
                kind = "geometry_msgs/msg/AccelWithCovarianceStamped"
                self.kinds["/localization/acceleration"] = kind
            for topic, name in (
                ("velocity_status", "VelocityReport"),
                ("steering_status", "SteeringReport"),
                ("gear_status", "GearReport"),
                ("control_mode", "ControlModeReport"),
            ):
                self.kinds[f"/vehicle/status/{topic}"] = f"autoware_vehicle_msgs/msg/{name}"
        self._speed_mps = self._yaw_rate_radps = 0.0

    def _names(self, view: SensorView, given: Mapping[str, str]) -> SensorNames:
        kind = view.settings["type"]
        if self.is_plain:
            tail = "/points" if kind in ("lidar", "radar") else ""
            topic, frame = f"/{self.vehicle}/{view.name}{tail}", f"{self.vehicle}/{view.name}"
        else:
            form = _AUTOWARE_TOPICS.get(kind, "/sensing/camera/{}")
            topic, frame = form.format(view.name), view.name
        return SensorNames(given.get("topic", topic), given.get("frame", frame))

    def mounts(self, stamp_ns: int, wheelbase_m: float) -> list[Fields]:
        """Return the transforms of all sensors."""
        return [
            one
            for sensor in self._sensors.values()
            for one in mount_transforms(
                sensor.view.settings, stamp_ns, self.base, self._frame(sensor), wheelbase_m
            )
            if sensor.view.settings["type"] != "odometry"
        ]

    def _frame(self, sensor: _Sensor) -> str:
        is_base = sensor.view.settings["type"] == "odometry"
        return self.base if is_base else sensor.names.frame

    def speed_mps(self) -> float:
        """Return the last known speed at the rear axle."""
        return self._speed_mps

    def messages(
        self, view: FollowerView, clock: RosClock, wanted: frozenset[str], state: TrueState | None
    ) -> Iterator[RosMessage]:
        """Yield the messages of a snapshot whose topics are wanted."""
        for name, samples in view.sensors.get(self.vehicle, {}).items():
            sensor = self._sensors.get(name)
            if sensor is None:
                continue
            settings = sensor.view.settings
            if settings["type"] == "odometry" and not samples.lost[-1]:
                self._speed_mps, self._yaw_rate_radps = map(float, samples.values[-1][:2])
            if wanted.isdisjoint(sensor.topics.values()):
                continue
            make, frame = SENSORS[settings["type"]][0], self._frame(sensor)
            for value, stamp_s, lost in zip(
                samples.values, samples.stamps_s.tolist(), samples.lost.tolist(), strict=True
            ):
                if lost:
                    continue
                stamp_ns = clock.ns_of(stamp_s)
                for part, kind, fields in make(settings, value, stamp_ns, frame):
                    if sensor.topics[part] in wanted:
                        yield RosMessage(sensor.topics[part], kind, stamp_ns, fields)
        if state is not None:
            self._speed_mps, self._yaw_rate_radps = state.speed_mps, state.yaw_rate_radps
            fields = odometry(state, clock.now_ns, self.base)
            yield from self._wanted(self._truth, clock.now_ns, fields, wanted)

    def status(
        self, clock: RosClock, wanted: frozenset[str], steering_rad: float, state: TrueState | None
    ) -> Iterator[RosMessage]:
        """Yield the messages about the vehicle in the profile `autoware`.

        `steering_rad`: steering angle of the last control.
        """
        if self.is_plain:
            return
        now_ns, stamp = clock.now_ns, time_of(clock.now_ns)
        told: dict[str, Fields] = {
            "/vehicle/status/velocity_status": {
                "header": header_of(now_ns, self.base),
                "longitudinal_velocity": self._speed_mps,
                "heading_rate": self._yaw_rate_radps,
            },
            "/vehicle/status/steering_status": {
                "stamp": stamp,
                "steering_tire_angle": steering_rad if state is None else state.steering_rad,
            },
            "/vehicle/status/gear_status": {"stamp": stamp, "report": _DRIVE},
            "/vehicle/status/control_mode": {"stamp": stamp, "mode": _AUTONOMOUS},
        }
        if state is not None:
            told["/localization/acceleration"] = {
                "header": header_of(now_ns, self.base),
                "accel": {"accel": {"linear": {"x": state.accel_mps2}}},
            }
        for topic, fields in told.items():
            yield from self._wanted(topic, now_ns, fields, wanted)

    def _wanted(
        self, topic: str, stamp_ns: int, fields: Fields, wanted: frozenset[str]
    ) -> Iterator[RosMessage]:
        if topic in wanted:
            yield RosMessage(topic, self.kinds[topic], stamp_ns, fields)


class WorldTopics:
    """All topics of a world and of some of its vehicles.

    Args:
        vehicles: topics of each vehicle.
        clock: ROS time.
        truth: whether true states are published.

    Attributes:
        kinds: type of each topic.
        latched: topics whose last message is for late subscribers, too.
    """

    latched = (TF_STATIC,)

    def __init__(self, vehicles: Sequence[VehicleTopics], clock: RosClock, truth: bool) -> None:
        self.vehicles, self.clock = tuple(vehicles), clock
        self.kinds = {TF_STATIC: _TF_KIND, **kinds_of_world(truth)}
        for vehicle in vehicles:
            if taken := sorted(self.kinds.keys() & vehicle.kinds.keys()):
                raise ConfigError(
                    f"{taken[0]} of {vehicle.vehicle} is the topic of something else; use one "
                    "vehicle with the profile autoware, and other names of sensors"
                )
            self.kinds |= vehicle.kinds
        self._mounted: dict[str, float] = {}  # vehicle → wheelbase of its present transforms

    def clock_message(self) -> RosMessage:
        """Return the message of the present time."""
        now_ns = self.clock.now_ns
        return RosMessage(CLOCK, self.kinds[CLOCK], now_ns, {"clock": time_of(now_ns)})

    def has_news(self, view: FollowerView) -> bool:
        """Set the clock, and return whether mounts of a snapshot's vehicles have changed."""
        self.clock.set(view.snapshot.episode, view.snapshot.tick)
        return self._known(view) != self._mounted

    def messages(
        self, view: FollowerView, wanted: frozenset[str], steering_rad: Mapping[str, float]
    ) -> Iterator[RosMessage]:
        """Yield the wanted messages of a snapshot, in a fixed order; the clock comes last.

        `/tf_static` is always included when it has changed. `steering_rad`: steering angle of
        the last control of each vehicle.
        """
        snapshot, clock = view.snapshot, self.clock
        clock.set(snapshot.episode, snapshot.tick)
        rows = _rows_of(view)
        if changed := self._mounts(view):
            yield RosMessage(TF_STATIC, _TF_KIND, clock.now_ns, {"transforms": changed})
        moved = []
        for vehicle in self.vehicles:
            seen = snapshot.vehicles.get(vehicle.vehicle)
            if seen is None:
                continue
            own = _dicts(rows[rows[:, 0] == seen.vehicle_id])
            state = true_state(own[0], seen.wheelbase_m) if own else None
            if state is not None:
                moved.append(transform(clock.now_ns, "map", vehicle.base, state.place, state.turn))
            yield from vehicle.messages(view, clock, wanted, state)
            steering = steering_rad.get(vehicle.vehicle, 0.0)
            yield from vehicle.status(clock, wanted, steering, state)
        if moved and TF in wanted:
            yield RosMessage(TF, _TF_KIND, clock.now_ns, {"transforms": moved})
        if VEHICLES in wanted and len(rows):
            fields = markers(_dicts(rows), clock.now_ns, 2 * clock.step_ns)
            yield RosMessage(VEHICLES, self.kinds[VEHICLES], clock.now_ns, fields)
        signals = view.sensors.get("", {}).get("signals")
        if signals is not None and SIGNALS in wanted:
            fields = {"data": signals.values[-1]}
            yield RosMessage(SIGNALS, self.kinds[SIGNALS], clock.now_ns, fields)
        yield self.clock_message()

    def _known(self, view: FollowerView) -> dict[str, float]:
        """Return the wheelbases of all vehicles so far, by vehicle."""
        present = view.snapshot.vehicles
        return self._mounted | {name: seen.wheelbase_m for name, seen in present.items()}

    def _mounts(self, view: FollowerView) -> list[Fields]:
        """Return the transforms of all vehicles' sensors, if those of a vehicle have changed."""
        known = self._known(view)
        if known == self._mounted:
            return []
        self._mounted = known
        return [
            one
            for vehicle in self.vehicles
            if vehicle.vehicle in known
            for one in vehicle.mounts(self.clock.now_ns, known[vehicle.vehicle])
        ]


def _rows_of(view: FollowerView) -> NDArray[np.float64]:
    """Return the true states (n, columns of TRUTH) of all vehicles; empty without truth."""
    truth = view.sensors.get("", {}).get("truth")
    return np.zeros((0, len(TRUTH))) if truth is None else truth.values[-1]


def _dicts(rows: NDArray[np.float64]) -> list[dict[str, float]]:
    return [dict(zip(TRUTH, row, strict=True)) for row in rows.tolist()]
