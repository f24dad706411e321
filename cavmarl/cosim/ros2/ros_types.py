"""`RosTypes`: message types of a ROS 2 distribution, and the types of Autoware that cavmarl uses.

Types and their encoding come from `rosbags`. The definitions below are the fields of packages that
`rosbags` does not have: `ackermann_msgs` and Autoware's (autoware_msgs 1.13 and
autoware_adapi_msgs, 2026).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.core.errors import ConfigError, require

DISTROS = ("humble", "jazzy", "kilted")

_STAMP = "builtin_interfaces/Time stamp\n"
_TIMES = "builtin_interfaces/Time stamp\nbuiltin_interfaces/Time control_time\n"
_DEFINITIONS = {
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
        "float32 acceleration\nfloat32 jerk"
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive"
    ),
    "autoware_vehicle_msgs/msg/VelocityReport": (
        "std_msgs/Header header\nfloat32 longitudinal_velocity\nfloat32 lateral_velocity\n"
        "float32 heading_rate"
    ),
    "autoware_vehicle_msgs/msg/SteeringReport": (
        "builtin_interfaces/Time stamp\nfloat32 steering_tire_angle"
    ),
    "autoware_vehicle_msgs/msg/GearReport": "builtin_interfaces/Time stamp\nuint8 report",
    "autoware_vehicle_msgs/msg/ControlModeReport": "builtin_interfaces/Time stamp\nuint8 mode",
    **{
        f"autoware_vehicle_msgs/msg/{name}": f"{_STAMP}uint8 {field}"
        for name, field in (
            ("GearCommand", "command"),
            ("TurnIndicatorsCommand", "command"),
            ("TurnIndicatorsReport", "report"),
            ("HazardLightsCommand", "command"),
            ("HazardLightsReport", "report"),
        )
    },
    "autoware_adapi_v1_msgs/msg/LocalizationInitializationState": f"{_STAMP}uint16 state",
    "autoware_perception_msgs/msg/TrafficLightElement": (
        "uint8 color\nuint8 shape\nuint8 status\nfloat32 confidence"
    ),
    "autoware_perception_msgs/msg/PredictedTrafficLightState": (
        "builtin_interfaces/Time predicted_stamp\n"
        "autoware_perception_msgs/TrafficLightElement[] simultaneous_elements\n"
        "float32 reliability\nstring information_source"
    ),
    "autoware_perception_msgs/msg/TrafficLightGroup": (
        "int64 traffic_light_group_id\n"
        "autoware_perception_msgs/TrafficLightElement[] elements\n"
        "autoware_perception_msgs/PredictedTrafficLightState[] predictions"
    ),
    "autoware_perception_msgs/msg/TrafficLightGroupArray": (
        f"{_STAMP}autoware_perception_msgs/TrafficLightGroup[] traffic_light_groups"
    ),
    "autoware_perception_msgs/msg/ObjectClassification": "uint8 label\nfloat32 probability",
    "autoware_perception_msgs/msg/Shape": (
        "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions"
    ),
    "autoware_perception_msgs/msg/DetectedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nbool has_position_covariance\n"
        "uint8 orientation_availability\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\nbool has_twist\n"
        "bool has_twist_covariance"
    ),
    "autoware_perception_msgs/msg/DetectedObject": (
        "float32 existence_probability\n"
        "autoware_perception_msgs/ObjectClassification[] classification\n"
        "autoware_perception_msgs/DetectedObjectKinematics kinematics\n"
        "autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/msg/DetectedObjects": (
        "std_msgs/Header header\nautoware_perception_msgs/DetectedObject[] objects"
    ),
    "autoware_perception_msgs/msg/PredictedPath": (
        "geometry_msgs/Pose[] path\nbuiltin_interfaces/Duration time_step\nfloat32 confidence"
    ),
    "autoware_perception_msgs/msg/PredictedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance initial_pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance initial_twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance\n"
        "autoware_perception_msgs/PredictedPath[] predicted_paths"
    ),
    "autoware_perception_msgs/msg/PredictedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "autoware_perception_msgs/ObjectClassification[] classification\n"
        "autoware_perception_msgs/PredictedObjectKinematics kinematics\n"
        "autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/msg/PredictedObjects": (
        "std_msgs/Header header\nautoware_perception_msgs/PredictedObject[] objects"
    ),
    "autoware_control_msgs/msg/Lateral": (
        f"{_TIMES}float32 steering_tire_angle\nfloat32 steering_tire_rotation_rate\n"
        "bool is_defined_steering_tire_rotation_rate"
    ),
    "autoware_control_msgs/msg/Longitudinal": (
        f"{_TIMES}float32 velocity\nfloat32 acceleration\nfloat32 jerk\n"
        "bool is_defined_acceleration\nbool is_defined_jerk"
    ),
    "autoware_control_msgs/msg/Control": (
        f"{_TIMES}autoware_control_msgs/Lateral lateral\n"
        "autoware_control_msgs/Longitudinal longitudinal"
    ),
}

_ARRAYS = {"bool": "?", "byte": "u1", "octet": "u1", "char": "u1"}


class RosMessage(NamedTuple):
    """A message on a topic."""

    topic: str
    kind: str  # for example `sensor_msgs/msg/Imu`
    stamp_ns: int  # simulated time
    fields: dict[str, Any]  # values by field; nested messages are dicts


class RosTypes:
    """The message types of a distribution.

    Args:
        distro: one of `DISTROS`.

    Attributes:
        distro: the distribution.
        store: the type store of `rosbags`.

    Raises:
        ConfigError: the distribution is not supported.
        MissingExtraError: the extra `ros2` is not installed.
    """

    def __init__(self, distro: str = "jazzy") -> None:
        if distro not in DISTROS:
            raise ConfigError(f"distro = {distro!r}: must be one of {', '.join(DISTROS)}")
        typesys = require("rosbags.typesys", "ros2")
        self._nodes: Any = require("rosbags.interfaces", "ros2").Nodetype
        self.distro = distro
        self.store: Any = typesys.get_typestore(typesys.Stores[f"ROS2_{distro.upper()}"])
        own: dict[str, Any] = {}
        for kind, text in _DEFINITIONS.items():
            own.update(typesys.get_types_from_msg(text, kind))
        self.store.register(own)

    def fields_of(self, kind: str) -> list[tuple[str, Any]]:
        """Return name and description of each field of a type, in their order."""
        found: list[tuple[str, Any]] = self.store.fielddefs[kind][1]
        return found

    def type_hash(self, kind: str) -> str:
        """Return the hash of a type by REP 2011, as ROS shows it."""
        found: str = self.store.hash_rihs01(kind)
        return found

    def encode(self, kind: str, fields: dict[str, Any]) -> bytes:
        """Return a message in CDR, little-endian. Fields that are not given are 0 or empty.

        Raises ValueError: the type has no such field.
        """
        return bytes(self.store.serialize_cdr(self._message(kind, fields), kind))

    def decode(self, kind: str, data: bytes) -> Any:
        """Return the message in CDR bytes as an object of `rosbags`.

        Raises ValueError: the bytes are not a message of this type.
        """
        try:
            return self.store.deserialize_cdr(data, kind)
        except Exception as error:  # invalid bytes raise errors of any class
            raise ValueError(f"{len(data)} bytes are not a {kind}: {error}") from error

    def _message(self, kind: str, fields: dict[str, Any]) -> Any:
        nodes = dict(self.fields_of(kind))
        if unknown := fields.keys() - nodes:
            raise ValueError(f"{kind} has no field {min(unknown)!r}")
        values = {
            name: self._value(node, fields[name]) if name in fields else self._zero(node)
            for name, node in nodes.items()
        }
        return self.store.types[kind](**values)

    def _zero(self, node: Any) -> Any:
        """Return the default value of a field."""
        what, detail = node
        if what == self._nodes.BASE:
            return {"string": "", "bool": False}.get(detail[0], 0)
        if what == self._nodes.NAME:
            return self._message(detail, {})
        inner, count = detail[0], detail[1] if what == self._nodes.ARRAY else 0
        return self._value(node, [self._zero(inner)] * count)

    def _value(self, node: Any, value: Any) -> Any:
        what, detail = node
        if what == self._nodes.BASE:
            return value
        if what == self._nodes.NAME:
            return self._message(detail, value)
        inner, name = detail[0], detail[0][1]
        if inner[0] == self._nodes.BASE and name[0] != "string":
            return _array(value, _ARRAYS.get(name[0], name[0]))
        return [self._value(inner, one) for one in value]


def _array(value: Any, dtype: DTypeLike) -> NDArray[Any]:
    if isinstance(value, bytes):
        return np.frombuffer(value, dtype)
    return np.ascontiguousarray(value, dtype).reshape(-1)


def time_of(stamp_ns: int) -> dict[str, int]:
    """Return the fields of a `builtin_interfaces/msg/Time`."""
    return {"sec": stamp_ns // 1_000_000_000, "nanosec": stamp_ns % 1_000_000_000}


def ns_of(time: Any) -> int:
    """Return the ns of a `builtin_interfaces/msg/Time`."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def header_of(stamp_ns: int, frame: str) -> dict[str, Any]:
    """Return the fields of a `std_msgs/msg/Header`."""
    return {"stamp": time_of(stamp_ns), "frame_id": frame}
