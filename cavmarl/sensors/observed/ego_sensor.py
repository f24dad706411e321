"""The `ego` sensor: the vehicle itself, its lane, and what the plan asks of it."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor, features_of

_EGO = (
    ("speed", "speed along the heading", "40 m/s"),
    ("accel", "acceleration of the last tick", "10 m/s²"),
    ("steering", "front wheel angle, left positive", "pi/4 rad"),
    ("yaw_rate", "turning rate, left positive", "1 rad/s"),
    ("lateral_offset", "place beside the lane's middle, left positive", "4 m"),
    ("heading_error", "heading minus the lane's direction, left positive", "pi rad"),
    ("speed_limit", "limit of the lane", "40 m/s"),
    ("left_lane", "1 if there is a lane to the left", ""),
    ("right_lane", "1 if there is a lane to the right", ""),
    ("lane_change", "side that the plan asks to change to: 1 left, -1 right, 0 none", ""),
    ("room", "way that this lane can be followed before a change is needed", "200 m"),
    ("to_go", "way left to the goal", "1000 m"),
    ("target_speed", "target of the speed controller (discrete actions)", "40 m/s"),
)


_SIZE = (
    ("length", "length of the own body", "20 m"),
    ("width", "width of the own body", "4 m"),
    ("wheelbase", "way between its axles", "10 m"),
    ("most_steering", "most that its front wheels turn; 1: as the action says", "pi/4 rad"),
    ("most_accel", "most that it can accelerate; 1: as the action says", "10 m/s²"),
    ("most_decel", "most that it can brake; 1: as the action says", "10 m/s²"),
    ("most_speed", "most that it can drive", "40 m/s"),
)


def features(config: SensorsConfig) -> list[Feature]:
    """The vehicle itself, its lane, and what the plan asks of it."""
    if not config.ego.enabled:
        return []
    return features_of((*_EGO, *(_SIZE if config.ego.size else ())))


SENSOR = Sensor("ego", features)
