"""The `ego` sensor: the agent's own vehicle, its lane, and the lane change that its plan needs."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import (
    Feature,
    Reading,
    Sensor,
    Sides,
    features_of,
    left_for_right,
)

_EGO = (
    ("speed", "speed along the heading", "40 m/s"),
    ("accel", "acceleration of the last tick", "10 m/s²"),
    ("steering", "front wheel angle, left positive", "pi/4 rad"),
    ("yaw_rate", "turning rate, left positive", "1 rad/s"),
    ("lateral_offset", "lateral offset from the lane's centre, left positive", "4 m"),
    ("heading_error", "heading relative to the lane's direction, left positive", "pi rad"),
    ("speed_limit", "speed limit of the lane", "40 m/s"),
    ("left_lane", "1 if there is a lane to the left", ""),
    ("right_lane", "1 if there is a lane to the right", ""),
    ("lane_change", "lane change that the route needs: 1 left, -1 right, 0 none", ""),
    ("room", "distance on this lane before a lane change is needed", "200 m"),
    ("to_go", "remaining distance to the goal", "1000 m"),
    ("target_speed", "target speed of the speed controller (discrete actions)", "40 m/s"),
)


_SIZE = (
    ("length", "length of the ego vehicle", "20 m"),
    ("width", "width of the ego vehicle", "4 m"),
    ("wheelbase", "wheelbase", "10 m"),
    ("most_steering", "largest front wheel angle; 1: limited by the action only", "pi/4 rad"),
    ("most_accel", "largest acceleration; 1: limited by the action only", "10 m/s²"),
    ("most_decel", "largest deceleration; 1: limited by the action only", "10 m/s²"),
    ("most_speed", "largest speed", "40 m/s"),
)


def features(config: SensorsConfig) -> list[Feature]:
    """List the features of the vehicle, its lane, and the lane change that its plan needs."""
    if not config.ego.enabled:
        return []
    return features_of((*_EGO, *(_SIZE if config.ego.size else ())))


def reads(config: SensorsConfig) -> list[Reading]:
    return [
        Reading("own vehicle", "its motion and controls, and its position on the lane"),
        Reading("map", "the lanes beside it, their speed limit, and the lane change of its route"),
    ]


_NEGATED = ("steering", "yaw_rate", "lateral_offset", "heading_error", "lane_change")

SENSOR = Sensor("ego", features, reads=reads, sides=Sides(_NEGATED, left_for_right))
