"""The `route` sensor: points along the path ahead."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor


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


SENSOR = Sensor("route", features)
