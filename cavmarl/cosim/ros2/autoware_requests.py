"""`AutowareRequests`: what nodes of Autoware request of a vehicle besides its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from cavmarl.cosim.ros2.ros_types import RosTypes
from cavmarl.cosim.ros2.sensor_messages import TrueState

# A pose of `/initialpose` is accepted up to these differences from the true pose.
POSE_TOLERANCE_M, POSE_TOLERANCE_RAD = 3.0, 0.5

# Codes of autoware_vehicle_msgs
DRIVE, AUTONOMOUS, DISABLE = 2, 1, 1
_INDICATORS, _HAZARD, _GEAR = (
    f"/control/command/{name}_cmd" for name in ("turn_indicators", "hazard_lights", "gear")
)
_INITIAL_POSE = "/initialpose"
_MOST = {_INDICATORS: 3, _HAZARD: 2}  # ENABLE_RIGHT, ENABLE


@dataclass
class RequestCounts:
    """Requests of one topic."""

    accepted: int = 0
    refused: int = 0  # requests that the vehicle cannot fulfil
    invalid: int = 0  # bytes that are not a message, and unknown values


class AutowareRequests:
    """What nodes of Autoware request of a vehicle besides its motion.

    The world sets the vehicle's position: a pose of `/initialpose` is accepted if it agrees with
    the true pose, and moves nothing. The only gear is DRIVE. Lights are reported as commanded.

    `types`: message types. `truth`: whether the true pose is known; otherwise there is no topic
    `/initialpose`.
    """

    def __init__(self, types: RosTypes, truth: bool) -> None:
        self.topics = {
            _INDICATORS: "autoware_vehicle_msgs/msg/TurnIndicatorsCommand",
            _HAZARD: "autoware_vehicle_msgs/msg/HazardLightsCommand",
            _GEAR: "autoware_vehicle_msgs/msg/GearCommand",
        }
        if truth:
            self.topics[_INITIAL_POSE] = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self.counts = {topic: RequestCounts() for topic in self.topics}
        self._types = types
        self._lights = dict.fromkeys(_MOST, DISABLE)

    @property
    def turn_indicators(self) -> int:
        """The last commanded state, as in TurnIndicatorsReport."""
        return self._lights[_INDICATORS]

    @property
    def hazard_lights(self) -> int:
        """The last commanded state, as in HazardLightsReport."""
        return self._lights[_HAZARD]

    def take(self, topic: str, data: bytes, state: TrueState | None) -> str:
        """Read a message in CDR, and return why it is refused; empty: it is accepted.

        `state`: the true state of the vehicle, if it is known.
        """
        counts = self.counts[topic]
        try:
            message = self._types.decode(self.topics[topic], data)
        except ValueError:
            counts.invalid += 1
            return ""
        if topic == _INITIAL_POSE:
            refusal = _differs(message, state)
        elif topic == _GEAR:
            given = int(message.command)
            refusal = "" if given in (0, DRIVE) else f"{topic}: gear {given}: only DRIVE (2) exists"
        else:
            given, refusal = int(message.command), ""
            if given > _MOST[topic]:
                counts.invalid += 1
                return ""
            if given:  # 0 is NO_COMMAND
                self._lights[topic] = given
        counts.refused += bool(refusal)
        counts.accepted += not refusal
        return refusal


def _differs(message: Any, state: TrueState | None) -> str:
    """Return how a pose differs from the true one; empty: it agrees."""
    pose = message.pose.pose
    if message.header.frame_id != "map":
        return f"{_INITIAL_POSE}: the frame must be map"
    if state is None:
        return f"{_INITIAL_POSE}: the vehicle is not in the world"
    place = np.array([pose.position.x, pose.position.y])
    distance_m = float(np.hypot(*(place - state.place[:2])))
    true, given = state.turn, pose.orientation
    dot = sum(true[axis] * getattr(given, axis) for axis in "xyzw")
    norm = math.sqrt(sum(getattr(given, axis) ** 2 for axis in "xyzw"))
    angle = 2.0 * math.acos(min(abs(dot) / norm, 1.0)) if norm > 0.0 else math.inf
    if distance_m <= POSE_TOLERANCE_M and angle <= POSE_TOLERANCE_RAD:
        return ""
    return (
        f"{_INITIAL_POSE}: {distance_m:.1f} m and {angle:.2f} rad from the true pose; the world "
        f"owns the place of the vehicle, give a pose up to {POSE_TOLERANCE_M:g} m and "
        f"{POSE_TOLERANCE_RAD:g} rad from it"
    )
