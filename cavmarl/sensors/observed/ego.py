"""The vehicle itself, its lane, and what the plan asks of it."""

from __future__ import annotations

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """The features in order; the scales are those of `sensors/kernels/observing.py`."""
    if not config.ego.enabled:
        return []
    return [
        Feature("speed", "speed along the heading", "40 m/s"),
        Feature("accel", "acceleration of the last tick", "10 m/s²"),
        Feature("steering", "front wheel angle, left positive", "pi/4 rad"),
        Feature("yaw_rate", "turning rate, left positive", "1 rad/s"),
        Feature("lateral_offset", "place beside the lane's middle, left positive", "4 m"),
        Feature("heading_error", "heading minus the lane's direction, left positive", "pi rad"),
        Feature("speed_limit", "limit of the lane", "40 m/s"),
        Feature("left_lane", "1 if there is a lane to the left"),
        Feature("right_lane", "1 if there is a lane to the right"),
        Feature("lane_change", "side that the plan asks to change to: 1 left, -1 right, 0 none"),
        Feature("room", "way that this lane can be followed before a change is needed", "200 m"),
        Feature("to_go", "way left to the goal", "1000 m"),
        Feature("target_speed", "target of the speed controller (discrete actions)", "40 m/s"),
    ]


def reach_m(config: SensorsConfig) -> float:
    return 0.0
