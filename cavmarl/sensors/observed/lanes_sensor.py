"""The `lanes` sensor: vehicles by their place along the lanes around, and one that crosses."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_lanes import HALF_M
from cavmarl.sensors.observed.feature import Feature, Row, Sensor, features_of

# As `kernels.observing_lanes` scales ways.
_NEARNESS = f"{HALF_M:g} m / ({HALF_M:g} m + way)"


_GAPS = (
    ("ahead", "the vehicle ahead on the own way"),
    ("left_ahead", "the vehicle ahead on the lane to the left"),
    ("left_behind", "the vehicle behind on the lane to the left"),
    ("right_ahead", "the vehicle ahead on the lane to the right"),
    ("right_behind", "the vehicle behind on the lane to the right"),
)


_CROSSING = (
    ("crossing", "1 if a vehicle that goes first crosses the next junction's link", ""),
    ("crossing_way", f"how near the place is where both cross: {_NEARNESS}", ""),
    ("crossing_other", f"how near that vehicle is to it: {_NEARNESS}", ""),
    ("crossing_speed", "that vehicle's speed", "40 m/s"),
)


def features(config: SensorsConfig) -> list[Feature]:
    """Gap and relative speed of five vehicles, then the one that crosses the own way first."""
    if config.lanes.range_m == 0.0:
        return []
    rows: list[Row] = []
    for name, vehicle in _GAPS:
        rows += [
            (f"{name}_gap", f"how near {vehicle} is, along the lanes: {_NEARNESS}; 0: none", ""),
            (f"{name}_speed", f"speed of {vehicle} minus the own one; 0: none", "40 m/s"),
        ]
    return features_of((*rows, *_CROSSING))


def reach_m(config: SensorsConfig) -> float:
    """The range counts for gaps along lanes and for centres in the plane."""
    return config.lanes.range_m


SENSOR = Sensor("lanes", features, reach_m)
