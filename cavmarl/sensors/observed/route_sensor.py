"""The `route` sensor: points along the path ahead."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides


def features(config: SensorsConfig) -> list[Feature]:
    """List x (forward) and y (left) of points along the path ahead, in the ego frame."""
    route = config.route
    scale = f"{route.points * route.spacing_m:g} m"
    return [
        Feature(
            f"{axis}_{k}",
            f"{side} of the point {(k + 1) * route.spacing_m:g} m along the path, ego frame",
            scale,
        )
        for k in range(route.points)
        for axis, side in (("x", "longitudinal position"), ("y", "lateral position"))
    ]


def reads(config: SensorsConfig) -> list[Reading]:
    reach_m = config.route.points * config.route.spacing_m
    return [Reading("map", f"its path for {reach_m:g} m")]


SENSOR = Sensor("route", features, reads=reads, sides=Sides(("y",)))
