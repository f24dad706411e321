"""Samples of mounted sensors, and the state of vehicles, as ROS messages.

Frames are right-handed with x forward, y to the left and z up (REP 103), as in cavmarl. `base_link`
is the middle of the rear axle on the ground; cavmarl's origin of a vehicle is below the centre of
its body. ROS's rotation about y is positive nose down; cavmarl's pitch is positive uphill.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.ros2.ros_types import header_of
from cavmarl.cosim.stack.lidar_points import sensor_points
from cavmarl.sensors.kernels.rig_frames import rotation

Fields = dict[str, Any]
Settings = Mapping[str, Any]

# Layout of Autoware's points (PointXYZIRC); cavmarl's lidars measure no intensity.
POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "u1"),
        ("return_type", "u1"),
        ("channel", "<u2"),
    ]
)
TARGET = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("radial_speed", "<f4")])
_DATATYPES = {"u1": 2, "u2": 4, "f4": 7}  # codes of `sensor_msgs/msg/PointField`
_OPTICAL = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}  # z forward, x right, y down


class Made(NamedTuple):
    """A message of a sensor: the end of its topic, its type, and its fields."""

    part: str
    kind: str
    fields: Fields


Make = Callable[[Settings, NDArray[Any], int, str], list[Made]]
"""Makes the messages of a sample from settings, sample, stamp in ns and frame."""


def quaternion_of(turn: NDArray[np.float64]) -> Fields:
    """Return the `geometry_msgs/msg/Quaternion` of a rotation matrix (3, 3)."""
    # The largest of the four components is computed first; the other components follow by division.
    squares = np.array(
        [
            1.0 + turn[0, 0] - turn[1, 1] - turn[2, 2],
            1.0 - turn[0, 0] + turn[1, 1] - turn[2, 2],
            1.0 - turn[0, 0] - turn[1, 1] + turn[2, 2],
            1.0 + turn[0, 0] + turn[1, 1] + turn[2, 2],
        ]
    )
    largest = int(squares.argmax())
    sums = turn + turn.T
    spin = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    found = np.empty(4)
    if largest == 3:
        found[:3] = spin
    else:
        found[:3], found[3] = sums[largest], spin[largest]
    found[largest] = squares[largest]
    found /= 2.0 * math.sqrt(squares[largest])
    if found[3] < 0.0:
        found = -found
    return dict(zip("xyzw", found.tolist(), strict=True))


def turn_of(heading: float, pitch: float, roll: float = 0.0) -> NDArray[np.float64]:
    """Return the rotation matrix of angles in rad, with cavmarl's signs."""
    turn = np.zeros((3, 3))
    rotation(heading, pitch, roll, turn)
    return turn


def vector(values: Any) -> Fields:
    """Return the `geometry_msgs/msg/Vector3` or `Point` of three numbers."""
    x, y, z = map(float, values)
    return {"x": x, "y": y, "z": z}


def pose_at(place: Any, heading: float) -> Fields:
    """Return the `geometry_msgs/msg/Pose` at a place (3,) in m, with a heading in rad."""
    turn = {"z": math.sin(0.5 * heading), "w": math.cos(0.5 * heading)}
    return {"position": vector(place), "orientation": turn}


def transform(stamp_ns: int, parent: str, child: str, place: Any, turn: Fields) -> Fields:
    """Return a `geometry_msgs/msg/TransformStamped`; `turn` is a quaternion."""
    return {
        "header": header_of(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": vector(place), "rotation": turn},
    }


def mount_transforms(
    settings: Settings, stamp_ns: int, base: str, frame: str, wheelbase_m: float
) -> list[Fields]:
    """Return the transform of a sensor, and the transform of a camera's optical frame."""
    angles = (math.radians(settings[key]) for key in ("yaw_deg", "pitch_deg", "roll_deg"))
    place = settings["x_m"] + 0.5 * wheelbase_m, settings["y_m"], settings["z_m"]
    found = [transform(stamp_ns, base, frame, place, quaternion_of(turn_of(*angles)))]
    if settings["type"].endswith("camera"):
        found.append(transform(stamp_ns, frame, optical(frame), (0.0, 0.0, 0.0), _OPTICAL))
    return found


def optical(frame: str) -> str:
    """Return the name of a camera's optical frame."""
    return f"{frame}_optical_link"


def covariance(noise: Any, first: int, count: int = 3) -> list[float]:
    """Return a diagonal matrix, row by row, from standard deviations of channels."""
    deviations = [float(one) for one in noise]
    chosen = deviations * count if len(deviations) == 1 else deviations[first : first + count]
    return np.diag(np.square(chosen)).ravel().tolist()


def cloud(points: NDArray[np.void], stamp_ns: int, frame: str) -> Fields:
    """Return a `sensor_msgs/msg/PointCloud2` of records."""
    step = points.dtype.itemsize
    fields = []
    for name in points.dtype.names or ():
        kind, offset = points.dtype.fields[name][:2]  # type: ignore[index]
        datatype = _DATATYPES[kind.str[1:]]
        fields.append({"name": name, "offset": offset, "datatype": datatype, "count": 1})
    return {
        "header": header_of(stamp_ns, frame),
        "height": 1,
        "width": len(points),
        "fields": fields,
        "point_step": step,
        "row_step": step * len(points),
        "data": points.view(np.uint8) if len(points) else np.zeros(0, np.uint8),
        "is_dense": True,
    }


def _lidar(settings: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    echoes, layers = sensor_points(settings, sample.astype(np.float64))
    points = np.zeros(len(echoes), dtype=POINT)
    for axis, name in enumerate("xyz"):
        points[name] = echoes[:, axis]
    points["channel"] = layers
    return [Made("points", "sensor_msgs/msg/PointCloud2", cloud(points, stamp_ns, frame))]


def _radar(_: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    found = sample[sample[:, 0] > 0.0]  # unused rows are zeros
    points = np.zeros(len(found), dtype=TARGET)
    points["x"] = found[:, 0] * np.cos(found[:, 1])
    points["y"] = found[:, 0] * np.sin(found[:, 1])
    points["radial_speed"] = found[:, 2]
    return [Made("points", "sensor_msgs/msg/PointCloud2", cloud(points, stamp_ns, frame))]


_ENCODINGS = {"rgb_camera": "rgb8", "depth_camera": "32FC1", "semantic_camera": "mono8"}


def _camera(settings: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    height, width = sample.shape[:2]
    if settings["type"] == "depth_camera":
        sample = sample.astype("<f4")
    data = np.ascontiguousarray(sample)
    header = header_of(stamp_ns, optical(frame))
    image = {
        "header": header,
        "height": height,
        "width": width,
        "encoding": _ENCODINGS[settings["type"]],
        "step": data.nbytes // height,
        "data": data.view(np.uint8),
    }
    focal = width / (2.0 * math.tan(math.radians(settings["fov_deg"]) / 2.0))
    x, y = width / 2.0, height / 2.0
    info = {
        "header": header,
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    return [
        Made("image_raw", "sensor_msgs/msg/Image", image),
        Made("camera_info", "sensor_msgs/msg/CameraInfo", info),
    ]


def _imu(settings: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    fields = {
        "header": header_of(stamp_ns, frame),
        "orientation": {"w": 1.0},
        "orientation_covariance": [-1.0] + [0.0] * 8,  # -1: not measured
        "angular_velocity": vector(sample[3:]),
        "angular_velocity_covariance": covariance(settings["noise"], 3),
        "linear_acceleration": vector(sample[:3]),
        "linear_acceleration_covariance": covariance(settings["noise"], 0),
    }
    return [Made("", "sensor_msgs/msg/Imu", fields)]


def _gnss(settings: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    latitude, longitude, altitude = map(float, sample)
    fields = {
        "header": header_of(stamp_ns, frame),
        "status": {"status": 0, "service": 1},  # a fix by GPS
        "latitude": latitude,
        "longitude": longitude,
        "altitude": altitude,
        "position_covariance": covariance(settings["noise"], 0),
        "position_covariance_type": 2,  # the diagonal is known
    }
    return [Made("", "sensor_msgs/msg/NavSatFix", fields)]


def _odometry(_: Settings, sample: NDArray[Any], stamp_ns: int, frame: str) -> list[Made]:
    twist = {"linear": {"x": float(sample[0])}, "angular": {"z": float(sample[1])}}
    fields = {"header": header_of(stamp_ns, frame), "twist": twist}
    return [Made("", "geometry_msgs/msg/TwistStamped", fields)]


# By sensor type: the function that makes messages, and the suffix and type of each topic.
SENSORS: dict[str, tuple[Make, tuple[tuple[str, str], ...]]] = {
    "lidar": (_lidar, (("points", "sensor_msgs/msg/PointCloud2"),)),
    "radar": (_radar, (("points", "sensor_msgs/msg/PointCloud2"),)),
    **dict.fromkeys(
        _ENCODINGS,
        (
            _camera,
            (
                ("image_raw", "sensor_msgs/msg/Image"),
                ("camera_info", "sensor_msgs/msg/CameraInfo"),
            ),
        ),
    ),
    "imu": (_imu, (("", "sensor_msgs/msg/Imu"),)),
    "gnss": (_gnss, (("", "sensor_msgs/msg/NavSatFix"),)),
    "odometry": (_odometry, (("", "geometry_msgs/msg/TwistStamped"),)),
}


class TrueState(NamedTuple):
    """The true state of a vehicle at `base_link`."""

    place: NDArray[np.float64]  # (3,) m
    turn: Fields  # quaternion
    speed_mps: float  # along the heading; the rear axle does not slip
    yaw_rate_radps: float
    steering_rad: float
    accel_mps2: float


def true_state(row: Mapping[str, float], wheelbase_m: float) -> TrueState:
    """Return the state at the rear axle of a vehicle; `row` has the columns of `TRUTH`.

    The velocity of the centre has the slip angle atan(tan(steering) / 2) of the kinematic bicycle.
    """
    turn = turn_of(row["heading"], row["pitch"])
    centre = np.array([row["x"], row["y"], row["z"]])
    slip = math.atan(0.5 * math.tan(row["steering"]))
    return TrueState(
        centre - turn @ np.array([0.5 * wheelbase_m, 0.0, 0.0]),
        quaternion_of(turn),
        row["speed"] * math.cos(slip),
        row["speed"] * math.sin(slip) / (0.5 * wheelbase_m),
        row["steering"],
        row["accel"],
    )


def odometry(state: TrueState, stamp_ns: int, base: str) -> Fields:
    """Return the `nav_msgs/msg/Odometry` of a state."""
    pose = {"position": vector(state.place), "orientation": state.turn}
    twist = {"linear": {"x": state.speed_mps}, "angular": {"z": state.yaw_rate_radps}}
    return {
        "header": header_of(stamp_ns, "map"),
        "child_frame_id": base,
        "pose": {"pose": pose},
        "twist": {"twist": twist},
    }


def markers(rows: Sequence[Mapping[str, float]], stamp_ns: int, life_ns: int) -> Fields:
    """Return a `visualization_msgs/msg/MarkerArray` of boxes; `rows` have columns of `TRUTH`."""
    found = []
    for row in rows:
        turn = turn_of(row["heading"], row["pitch"])
        centre = np.array([row["x"], row["y"], row["z"]]) + turn[:, 2] * (0.5 * row["height"])
        is_agent = row["agent"] >= 0
        found.append(
            {
                "header": header_of(stamp_ns, "map"),
                "ns": "vehicles",
                "id": int(row["id"]) & 0x7FFFFFFF,
                "type": 1,  # CUBE
                "pose": {"position": vector(centre), "orientation": quaternion_of(turn)},
                "scale": vector((row["length"], row["width"], row["height"])),
                "color": {"r": 0.9 * is_agent, "g": 0.5, "b": 0.9 * (not is_agent), "a": 0.9},
                "lifetime": {"sec": life_ns // 10**9, "nanosec": life_ns % 10**9},
            }
        )
    return {"markers": found}
