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
from cavmarl.cosim.followers.follower_messages import SensorView, VehicleView
from cavmarl.cosim.followers.follower_snapshots import TRUTH
from cavmarl.cosim.ros2.autoware_topics import (
    DETECTED,
    OBJECT_RANGE_M,
    OBJECTS,
    AutowareTopics,
    Motion,
)
from cavmarl.cosim.ros2.ros_types import RosMessage, header_of, time_of
from cavmarl.cosim.ros2.sensor_messages import (
    SENSORS,
    Fields,
    TrueState,
    markers,
    mount_transforms,
    odometry,
    pose_at,
    transform,
    true_state,
)

log = logging.getLogger(__name__)

Profile = Literal["plain", "autoware"]

CLOCK, TF, TF_STATIC = "/clock", "/tf", "/tf_static"
VEHICLES, SIGNALS = "/vehicles", "/signals"
_TF_KIND = "tf2_msgs/msg/TFMessage"
_AUTOWARE_GOAL = "/planning/mission_planning/goal"

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
        """Return the time of a sample of the current episode."""
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
        truth: whether the true state is published.

    Attributes:
        base: name of the frame `base_link`.
        kinds: type of each topic.
        latched: topics whose last message late subscribers also get.
        motion: its motion as far as it is known without the true state.

    Raises:
        ConfigError: `names` has a sensor that the vehicle does not have, or two sensors have the
            same topic.
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
        self._odometers = frozenset(
            name
            for name, sensor in self._sensors.items()
            if sensor.view.settings["type"] == "odometry"
        )
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
        self._goal = f"/{vehicle}/goal" if self.is_plain else _AUTOWARE_GOAL
        self.kinds[self._goal] = "geometry_msgs/msg/PoseStamped"
        self._autoware = None if self.is_plain else AutowareTopics(truth)
        self.latched: tuple[str, ...] = (self._goal,)
        if self._autoware is not None:
            self.kinds |= self._autoware.kinds
            self.latched += self._autoware.latched
        self.motion = Motion()
        self._seen: tuple[NDArray[np.float64], float] | None = None  # true row, wheelbase
        self._state: TrueState | None = None

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

    @property
    def state(self) -> TrueState | None:
        """The true state in the last snapshot, if it is known."""
        if self._state is None and self._seen is not None:
            row, wheelbase_m = self._seen
            self._state = true_state(_dicts(row[np.newaxis])[0], wheelbase_m)
        return self._state

    def speed_mps(self) -> float:
        """Return the last known speed at the rear axle."""
        state = self.state
        return self.motion.speed_mps if state is None else state.speed_mps

    def notice(self, view: FollowerView, rows: NDArray[np.float64]) -> None:
        """Keep the motion of a snapshot; `rows`: true states of all vehicles, as `TRUTH`."""
        for name, samples in view.sensors.get(self.vehicle, {}).items():
            if name in self._odometers and not samples.lost[-1]:
                newest = map(float, samples.values[-1][:2])
                self.motion.speed_mps, self.motion.yaw_rate_radps = newest
        self._seen = self._state = None
        seen = view.snapshot.vehicles.get(self.vehicle)
        if seen is not None and len(rows):
            own = rows[rows[:, 0] == seen.vehicle_id]
            self._seen = (own[0], seen.wheelbase_m) if len(own) else None

    def begin(self, seen: VehicleView, now_ns: int) -> Iterator[RosMessage]:
        """Yield the latched messages of a vehicle that has entered the world."""
        at = pose_at((*seen.goal_m, 0.0), seen.goal_heading_rad)
        fields = {"header": header_of(now_ns, "map"), "pose": at}
        yield RosMessage(self._goal, self.kinds[self._goal], now_ns, fields)
        if self._autoware is not None:
            yield from self._autoware.begin(now_ns)

    def messages(
        self, view: FollowerView, clock: RosClock, wanted: frozenset[str]
    ) -> Iterator[RosMessage]:
        """Yield the messages of a snapshot whose topics are wanted."""
        for name, samples in view.sensors.get(self.vehicle, {}).items():
            sensor = self._sensors.get(name)
            if sensor is None or wanted.isdisjoint(sensor.topics.values()):
                continue
            settings = sensor.view.settings
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
        state = self.state
        if state is not None and self._truth in wanted:
            fields = odometry(state, clock.now_ns, self.base)
            yield RosMessage(self._truth, self.kinds[self._truth], clock.now_ns, fields)

    def surroundings(
        self,
        now_ns: int,
        wanted: frozenset[str],
        rows: NDArray[np.float64],
        codes: NDArray[np.uint8] | None,
    ) -> Iterator[RosMessage]:
        """Yield the messages of the profile `autoware` about the vehicle and its surroundings.

        `rows`: true states of all vehicles. `codes`: (links,) the SIGNAL_* codes of the map.
        """
        if self._autoware is None:
            return
        others: list[dict[str, float]] = []
        if self._seen is not None and not wanted.isdisjoint((OBJECTS, DETECTED)):
            own = self._seen[0]
            x, y = TRUTH.index("x"), TRUTH.index("y")
            distance_m = np.hypot(rows[:, x] - own[x], rows[:, y] - own[y])
            is_near = (distance_m <= OBJECT_RANGE_M) & (rows[:, 0] != own[0])
            others = _dicts(rows[is_near])
        state = self.state
        yield from self._autoware.messages(now_ns, wanted, self.motion, state, others, codes)


class WorldTopics:
    """All topics of a world and of some of its vehicles.

    Args:
        vehicles: topics of each vehicle.
        clock: ROS time.
        truth: whether true states are published.

    Attributes:
        kinds: type of each topic.
        latched: topics whose last message late subscribers also get.
    """

    def __init__(self, vehicles: Sequence[VehicleTopics], clock: RosClock, truth: bool) -> None:
        self.vehicles, self.clock = tuple(vehicles), clock
        self.kinds = {TF_STATIC: _TF_KIND, **kinds_of_world(truth)}
        self.latched = (TF_STATIC, *(topic for each in vehicles for topic in each.latched))
        for vehicle in vehicles:
            if taken := sorted(self.kinds.keys() & vehicle.kinds.keys()):
                raise ConfigError(
                    f"{taken[0]} of {vehicle.vehicle} is used by another message; give the sensors "
                    "other names or, with the profile autoware, use a single vehicle"
                )
            self.kinds |= vehicle.kinds
        self._mounted: dict[str, float] = {}  # vehicle → wheelbase of its current transforms
        self._begun: dict[str, tuple[int, VehicleView]] = {}  # vehicle → episode, its description
        self._rows = np.zeros((0, len(TRUTH)))

    def clock_message(self) -> RosMessage:
        """Return the message of the current time."""
        now_ns = self.clock.now_ns
        return RosMessage(CLOCK, self.kinds[CLOCK], now_ns, {"clock": time_of(now_ns)})

    def notice(self, view: FollowerView) -> None:
        """Set the clock to a snapshot, and keep the motion of the vehicles."""
        self.clock.set(view.snapshot.episode, view.snapshot.tick)
        truth = view.sensors.get("", {}).get("truth")
        self._rows = np.zeros((0, len(TRUTH))) if truth is None else truth.values[-1]
        for vehicle in self.vehicles:
            vehicle.notice(view, self._rows)

    def has_news(self, view: FollowerView) -> bool:
        """Return whether latched messages about a snapshot's vehicles have changed."""
        return self._present(view) != self._begun

    def messages(self, view: FollowerView, wanted: frozenset[str]) -> Iterator[RosMessage]:
        """Yield the wanted messages of a snapshot, in a fixed order; the clock comes last.

        Call `notice` with the snapshot first.

        Latched messages are included when they have changed, whether they are wanted or not.
        """
        now_ns, rows = self.clock.now_ns, self._rows
        yield from self._latched_messages(view)
        signals = view.sensors.get("", {}).get("signals")
        codes = None if signals is None else signals.values[-1]
        moved = []
        for vehicle in self.vehicles:
            if vehicle.vehicle not in view.snapshot.vehicles:
                continue
            yield from vehicle.messages(view, self.clock, wanted)
            yield from vehicle.surroundings(now_ns, wanted, rows, codes)
            state = vehicle.state if TF in wanted else None
            if state is not None:
                moved.append(transform(now_ns, "map", vehicle.base, state.place, state.turn))
        if moved:
            yield RosMessage(TF, _TF_KIND, now_ns, {"transforms": moved})
        if VEHICLES in wanted and len(rows):
            fields = markers(_dicts(rows), now_ns, 2 * self.clock.step_ns)
            yield RosMessage(VEHICLES, self.kinds[VEHICLES], now_ns, fields)
        if codes is not None and SIGNALS in wanted:
            yield RosMessage(SIGNALS, self.kinds[SIGNALS], now_ns, {"data": codes})
        yield self.clock_message()

    def _latched_messages(self, view: FollowerView) -> Iterator[RosMessage]:
        if changed := self._mounts(view):
            yield RosMessage(TF_STATIC, _TF_KIND, self.clock.now_ns, {"transforms": changed})
        present, before = self._present(view), self._begun
        self._begun = present
        for vehicle in self.vehicles:
            if present.get(vehicle.vehicle) != before.get(vehicle.vehicle):
                yield from vehicle.begin(present[vehicle.vehicle][1], self.clock.now_ns)

    def _present(self, view: FollowerView) -> dict[str, tuple[int, VehicleView]]:
        """Return episode and description of all vehicles so far."""
        episode = view.snapshot.episode
        found = {name: (episode, seen) for name, seen in view.snapshot.vehicles.items()}
        return self._begun | found

    def _mounts(self, view: FollowerView) -> list[Fields]:
        """Return the transforms of all vehicles' sensors, if any transform has changed."""
        present = view.snapshot.vehicles.items()
        known = self._mounted | {name: seen.wheelbase_m for name, seen in present}
        if known == self._mounted:
            return []
        self._mounted = known
        return [
            one
            for vehicle in self.vehicles
            if vehicle.vehicle in known
            for one in vehicle.mounts(self.clock.now_ns, known[vehicle.vehicle])
        ]


def _dicts(rows: NDArray[np.float64]) -> list[dict[str, float]]:
    return [dict(zip(TRUTH, row, strict=True)) for row in rows.tolist()]
