"""`AutowareTopics`: Autoware's topics about a vehicle and its surroundings, besides sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.ros2.autoware_messages import (
    detected_objects,
    light_groups,
    predicted_objects,
)
from cavmarl.cosim.ros2.autoware_requests import AUTONOMOUS, DISABLE, DRIVE
from cavmarl.cosim.ros2.ros_types import RosMessage, header_of, time_of
from cavmarl.cosim.ros2.sensor_messages import Fields, TrueState, vector

LIGHTS = "/perception/traffic_light_recognition/traffic_signals"
OBJECTS = "/perception/object_recognition/objects"
DETECTED = "/perception/object_recognition/detection/objects"
LOCALISED = "/localization/initialization_state"
OBJECT_RANGE_M = 100.0  # objects are published up to this distance
_ACCELERATION = "/localization/acceleration"
_POSE = "/sensing/gnss/pose_with_covariance"
_STATUS = "/vehicle/status/{}"
_REPORTS = {  # topics of /vehicle/status
    "velocity_status": "VelocityReport",
    "steering_status": "SteeringReport",
    "gear_status": "GearReport",
    "control_mode": "ControlModeReport",
    "turn_indicators_status": "TurnIndicatorsReport",
    "hazard_lights_status": "HazardLightsReport",
}
_INITIALIZED = 3  # LocalizationInitializationState


class Motion:
    """The motion of a vehicle as far as it is known without the true state.

    Attributes:
        speed_mps: measured speed at the rear axle.
        yaw_rate_radps: measured yaw rate.
        steering_rad: last commanded steering angle.
        turn_indicators: state in TurnIndicatorsReport.
        hazard_lights: state in HazardLightsReport.
    """

    def __init__(self) -> None:
        self.speed_mps = self.yaw_rate_radps = self.steering_rad = 0.0
        self.turn_indicators = self.hazard_lights = DISABLE


class AutowareTopics:
    """The topics about a vehicle in the profile `autoware`.

    `truth`: whether true states are published.

    Attributes:
        kinds: type of each topic.
        latched: topics whose last message late subscribers also get.
    """

    def __init__(self, truth: bool) -> None:
        self.kinds = {
            _STATUS.format(topic): f"autoware_vehicle_msgs/msg/{name}"
            for topic, name in _REPORTS.items()
        }
        self.kinds[LIGHTS] = "autoware_perception_msgs/msg/TrafficLightGroupArray"
        self.latched: tuple[str, ...] = ()
        if truth:
            self.kinds |= {
                _ACCELERATION: "geometry_msgs/msg/AccelWithCovarianceStamped",
                _POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
                OBJECTS: "autoware_perception_msgs/msg/PredictedObjects",
                DETECTED: "autoware_perception_msgs/msg/DetectedObjects",
                LOCALISED: "autoware_adapi_v1_msgs/msg/LocalizationInitializationState",
            }
            self.latched = (LOCALISED,)

    def begin(self, now_ns: int) -> Iterator[RosMessage]:
        """Yield the latched messages of a vehicle that has entered the world."""
        if LOCALISED in self.kinds:
            fields: Fields = {"stamp": time_of(now_ns), "state": _INITIALIZED}
            yield RosMessage(LOCALISED, self.kinds[LOCALISED], now_ns, fields)

    def messages(
        self,
        now_ns: int,
        wanted: frozenset[str],
        motion: Motion,
        state: TrueState | None,
        others: Sequence[Mapping[str, float]],
        codes: NDArray[np.uint8] | None,
    ) -> Iterator[RosMessage]:
        """Yield the wanted messages of a tick.

        Args:
            now_ns: ROS time.
            wanted: topics.
            motion: of the vehicle.
            state: its true state, if it is known.
            others: true states of the vehicles around, with the columns of `TRUTH`.
            codes: (links,) the SIGNAL_* codes of the map.
        """
        stamp = time_of(now_ns)
        makers: dict[str, Callable[[], Fields]] = {
            _STATUS.format("velocity_status"): lambda: {
                "header": header_of(now_ns, "base_link"),
                "longitudinal_velocity": motion.speed_mps if state is None else state.speed_mps,
                "heading_rate": motion.yaw_rate_radps if state is None else state.yaw_rate_radps,
            },
            _STATUS.format("steering_status"): lambda: {
                "stamp": stamp,
                "steering_tire_angle": motion.steering_rad if state is None else state.steering_rad,
            },
            _STATUS.format("gear_status"): lambda: {"stamp": stamp, "report": DRIVE},
            _STATUS.format("control_mode"): lambda: {"stamp": stamp, "mode": AUTONOMOUS},
            _STATUS.format("turn_indicators_status"): lambda: {
                "stamp": stamp,
                "report": motion.turn_indicators,
            },
            _STATUS.format("hazard_lights_status"): lambda: {
                "stamp": stamp,
                "report": motion.hazard_lights,
            },
        }
        if state is not None:
            makers |= {
                _ACCELERATION: lambda: {
                    "header": header_of(now_ns, "base_link"),
                    "accel": {"accel": {"linear": {"x": state.accel_mps2}}},
                },
                _POSE: lambda: {
                    "header": header_of(now_ns, "map"),
                    "pose": {"pose": {"position": vector(state.place), "orientation": state.turn}},
                },
                DETECTED: lambda: detected_objects(others, now_ns),
                OBJECTS: lambda: predicted_objects(others, now_ns),
            }
        if codes is not None:
            makers[LIGHTS] = lambda: light_groups(codes, now_ns)
        for topic, make in makers.items():
            if topic in wanted:
                yield RosMessage(topic, self.kinds[topic], now_ns, make())
