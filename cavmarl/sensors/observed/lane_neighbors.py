"""Who drives ahead and behind on the lanes around, and who crosses."""

from __future__ import annotations

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.kernels.observing_lanes import HALF_M
from cavmarl.sensors.observed.feature import Feature

# As `kernels.observing_lanes` scales ways.
_NEARNESS = f"{HALF_M:g} m / ({HALF_M:g} m + way)"
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
    found = []
    for name, who in _GAPS:
        found += [
            Feature(f"{name}_gap", f"how near {who} is, along the lanes: {_NEARNESS}; 0: none"),
            Feature(f"{name}_speed", f"speed of {who} minus the own one; 0: none", "40 m/s"),
        ]
    return [
        *found,
        Feature("crossing", "1 if a vehicle that goes first crosses the next junction's link"),
        Feature("crossing_way", f"how near the place is where both cross: {_NEARNESS}"),
        Feature("crossing_other", f"how near that vehicle is to it: {_NEARNESS}"),
        Feature("crossing_speed", "that vehicle's speed", "40 m/s"),
    ]


def reach_m(config: SensorsConfig) -> float:
    """Its range, of gaps along lanes and of centres in the plane."""
    return config.lanes.range_m
