"""Who drives ahead and behind on the lanes around, and who crosses."""

from __future__ import annotations

from cavmarl.config import SensorsConfig
from cavmarl.shard.sensors.feature import Feature

__all__ = ["features", "reach_m"]

_GAPS = (
    ("ahead", "the vehicle ahead on the own way"),
    ("left_ahead", "the vehicle ahead on the lane to the left"),
    ("left_behind", "the vehicle behind on the lane to the left"),
    ("right_ahead", "the vehicle ahead on the lane to the right"),
    ("right_behind", "the vehicle behind on the lane to the right"),
)


def features(config: SensorsConfig) -> list[Feature]:
    """Gap and relative speed of five vehicles, then the one that crosses the own way first."""
    if config.lanes.range_m == 0.0:
        return []
    scale = f"{config.lanes.range_m:g} m"
    found = []
    for name, who in _GAPS:
        found += [
            Feature(f"{name}_gap", f"bumper to bumper to {who}, along the lanes; 1: none", scale),
            Feature(f"{name}_speed", f"speed of {who} minus the own one; 0: none", "40 m/s"),
        ]
    return [
        *found,
        Feature("crossing", "1 if a vehicle that goes first crosses the next junction's link"),
        Feature("crossing_way", "own way to the place where both cross", scale),
        Feature("crossing_other", "that vehicle's way to it, negative inside", scale),
        Feature("crossing_speed", "that vehicle's speed", "40 m/s"),
    ]


def reach_m(config: SensorsConfig) -> float:
    """Its range, along lanes and so in the plane too."""
    return config.lanes.range_m
