"""Points of the way ahead."""

from __future__ import annotations

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """X (forward) and y (left) of each point in the ego frame."""
    route = config.route
    scale = f"{route.points * route.spacing_m:g} m"
    return [
        Feature(
            f"{axis}_{k}",
            f"{side} of the point {(k + 1) * route.spacing_m:g} m along the way, ego frame",
            scale,
        )
        for k in range(route.points)
        for axis, side in (("x", "forward place"), ("y", "place to the left"))
    ]


def reach_m(config: SensorsConfig) -> float:
    return 0.0
