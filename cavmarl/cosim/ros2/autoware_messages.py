"""Traffic lights and other vehicles as Autoware's messages.

Autoware names a traffic light by the id of its regulatory element in the vector map; the ids of
`cavmarl map export --autoware` are `FIRST_LIGHT` plus the row of the link.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import (
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_OFF,
    SIGNAL_OFF_BLINKING,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.cosim.ros2.ros_types import header_of, time_of
from cavmarl.cosim.ros2.sensor_messages import Fields, quaternion_of, turn_of, vector
from cavmarl.maps.exports.lanelet import FIRST_LIGHT
from cavmarl.roads.network import VEHICLE_CLASSES

# Paths of objects: length and step.
PATH_S, PATH_STEP_S = 5.0, 0.5

# Codes of TrafficLightElement
RED, AMBER, GREEN = 1, 2, 3
CIRCLE, SOLID_OFF, SOLID_ON, FLASHING, UNKNOWN = 5, 13, 14, 15, 16
_LIT = {
    SIGNAL_RED: (RED,),
    # The driver may turn after a stop; no element exists for this state.
    SIGNAL_STOP_THEN_GO: (RED,),
    SIGNAL_RED_YELLOW: (RED, AMBER),
    SIGNAL_YELLOW_MINOR: (AMBER,),
    SIGNAL_YELLOW_MAJOR: (AMBER,),
    SIGNAL_GREEN_MINOR: (GREEN,),
    SIGNAL_GREEN_MAJOR: (GREEN,),
}
_SHOWN = {
    **{code: [(color, CIRCLE, SOLID_ON) for color in lit] for code, lit in _LIT.items()},
    SIGNAL_OFF_BLINKING: [(AMBER, CIRCLE, FLASHING)],
    SIGNAL_OFF: [(UNKNOWN, CIRCLE, SOLID_OFF)],
}
_ELEMENTS: dict[int, list[Fields]] = {
    code: [
        {"color": color, "shape": shape, "status": status, "confidence": 1.0}
        for color, shape, status in shown
    ]
    for code, shown in _SHOWN.items()
}

_LABELS = {"truck": 2, "bus": 3, "tram": 3, "motorcycle": 5, "bicycle": 6}  # other types: 1 (car)
_HAS_DIRECTION = 2  # DetectedObjectKinematics: front and rear are known


def light_groups(codes: NDArray[np.uint8], stamp_ns: int) -> Fields:
    """Return an `autoware_perception_msgs/msg/TrafficLightGroupArray`.

    `codes`: (links,) the SIGNAL_* code of each link of the map.
    """
    groups = [
        {"traffic_light_group_id": FIRST_LIGHT + link, "elements": _ELEMENTS[code]}
        for link, code in enumerate(codes.tolist())
        if code != SIGNAL_NONE
    ]
    return {"stamp": time_of(stamp_ns), "traffic_light_groups": groups}


def detected_objects(rows: Sequence[Mapping[str, float]], stamp_ns: int) -> Fields:
    """Return the `autoware_perception_msgs/msg/DetectedObjects` of vehicles."""
    objects = [
        {
            "existence_probability": 1.0,
            "classification": _classification(row),
            "kinematics": {
                "pose_with_covariance": {"pose": _box_pose(row)},
                "orientation_availability": _HAS_DIRECTION,
                "twist_with_covariance": {"twist": _twist(row)},
                "has_twist": True,
            },
            "shape": _shape(row),
        }
        for row in rows
    ]
    return {"header": header_of(stamp_ns, "map"), "objects": objects}


def predicted_objects(rows: Sequence[Mapping[str, float]], stamp_ns: int) -> Fields:
    """Return the `autoware_perception_msgs/msg/PredictedObjects` of vehicles.

    Each has one path, on which it keeps its speed and the angle of its wheels.
    """
    step = {"sec": int(PATH_STEP_S), "nanosec": round(1e9 * (PATH_STEP_S % 1.0))}
    objects = [
        {
            "object_id": {"uuid": int(row["id"]).to_bytes(16, "little")},
            "existence_probability": 1.0,
            "classification": _classification(row),
            "kinematics": {
                "initial_pose_with_covariance": {"pose": _box_pose(row)},
                "initial_twist_with_covariance": {"twist": _twist(row)},
                "initial_acceleration_with_covariance": {"accel": {"linear": {"x": row["accel"]}}},
                "predicted_paths": [{"path": _path(row), "time_step": step, "confidence": 1.0}],
            },
            "shape": _shape(row),
        }
        for row in rows
    ]
    return {"header": header_of(stamp_ns, "map"), "objects": objects}


def _classification(row: Mapping[str, float]) -> list[Fields]:
    label = _LABELS.get(VEHICLE_CLASSES[int(row["vclass"])], 1)
    return [{"label": label, "probability": 1.0}]


def _shape(row: Mapping[str, float]) -> Fields:
    return {"dimensions": vector((row["length"], row["width"], row["height"]))}  # a bounding box


def _box_pose(row: Mapping[str, float]) -> Fields:
    """Return the pose of the middle of a vehicle's body."""
    turn = turn_of(row["heading"], row["pitch"])
    centre = np.array([row["x"], row["y"], row["z"]]) + turn[:, 2] * (0.5 * row["height"])
    return {"position": vector(centre), "orientation": quaternion_of(turn)}


def _turning(row: Mapping[str, float]) -> tuple[float, float]:
    """Return the slip angle and the yaw rate of the centre of a kinematic bicycle.

    The true states do not contain the wheelbase; half of it is taken to be 0.3 lengths.
    """
    slip = math.atan(0.5 * math.tan(row["steering"]))
    return slip, row["speed"] * math.sin(slip) / max(0.3 * row["length"], 0.1)


def _twist(row: Mapping[str, float]) -> Fields:
    slip, yaw_rate = _turning(row)
    linear = {"x": row["speed"] * math.cos(slip), "y": row["speed"] * math.sin(slip)}
    return {"linear": linear, "angular": {"z": yaw_rate}}


def _path(row: Mapping[str, float]) -> list[Fields]:
    slip, yaw_rate = _turning(row)
    count = round(PATH_S / PATH_STEP_S) + 1
    times_s = PATH_STEP_S * np.arange(count)
    headings = row["heading"] + yaw_rate * times_s
    # Each piece of an arc has the direction at the middle of the piece.
    courses = headings[:-1] + 0.5 * PATH_STEP_S * yaw_rate + slip
    pieces = row["speed"] * PATH_STEP_S * np.stack([np.cos(courses), np.sin(courses)])
    x, y = np.hstack([np.zeros((2, 1)), np.cumsum(pieces, axis=1)])
    x, y = x + row["x"], y + row["y"]
    z = row["z"] + 0.5 * row["height"] + row["speed"] * times_s * math.sin(row["pitch"])
    return [
        {
            "position": {"x": at[0], "y": at[1], "z": at[2]},
            "orientation": {"z": math.sin(0.5 * at[3]), "w": math.cos(0.5 * at[3])},
        }
        for at in zip(x.tolist(), y.tolist(), z.tolist(), headings.tolist(), strict=True)
    ]
