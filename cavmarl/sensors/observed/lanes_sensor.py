"""The `lanes` sensor: gaps to vehicles on the lanes around, and the next crossing vehicle."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_lanes import HALF_M
from cavmarl.sensors.observed.feature import (
    Feature,
    Reading,
    Row,
    Sensor,
    Sides,
    features_of,
    hidden,
    left_for_right,
)

# Distances are scaled as in `kernels.observing_lanes`.
_NEARNESS = f"{HALF_M:g} m / ({HALF_M:g} m + distance)"


_GAPS = (
    ("ahead", "the vehicle ahead on the ego path"),
    ("left_ahead", "the vehicle ahead on the lane to the left"),
    ("left_behind", "the vehicle behind on the lane to the left"),
    ("right_ahead", "the vehicle ahead on the lane to the right"),
    ("right_behind", "the vehicle behind on the lane to the right"),
)


_CROSSING = (
    ("crossing", "1 if a vehicle with priority crosses the ego path at the next junction", ""),
    ("crossing_way", f"closeness of the crossing point to the ego vehicle: {_NEARNESS}", ""),
    ("crossing_other", f"closeness of the crossing point to that vehicle: {_NEARNESS}", ""),
    ("crossing_speed", "speed of that vehicle", "40 m/s"),
)


def features(config: SensorsConfig) -> list[Feature]:
    """List the gap and relative speed of five vehicles, then the first crossing vehicle."""
    if config.lanes.range_m == 0.0:
        return []
    rows: list[Row] = []
    for name, vehicle in _GAPS:
        rows += [
            (f"{name}_gap", f"closeness of {vehicle}, along the lanes: {_NEARNESS}; 0: none", ""),
            (f"{name}_speed", f"speed of {vehicle} minus the ego speed; 0: none", "40 m/s"),
        ]
    return features_of((*rows, *_CROSSING))


def reach_m(config: SensorsConfig) -> float:
    """Return the range, which limits both gaps along lanes and distances in the plane."""
    return config.lanes.range_m


def reads(config: SensorsConfig) -> list[Reading]:
    what = f"vehicles on the lanes around it within {config.lanes.range_m:g} m"
    return [
        Reading("ideal sensors", f"{what}; {hidden(through_walls=True)}"),
        Reading(
            "world's state", "the paths of vehicles on other lanes, and which of them cross its own"
        ),
    ]


SENSOR = Sensor("lanes", features, reach_m, reads=reads, sides=Sides(partner=left_for_right))
