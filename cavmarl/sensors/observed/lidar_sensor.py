"""The `lidar` sensor: distances along rays around the vehicle."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor, features_of


def features(config: SensorsConfig) -> list[Feature]:
    """Distances of all rays, then, with `speeds`, the relative speeds of what they met."""
    lidar = config.lidar
    step = 360.0 / max(lidar.rays, 1)
    told = "velocity of what the ray met minus the own one, along the ray; 0 where nothing is"
    return features_of(
        (
            f"distance_{k}",
            f"distance along the ray {k * step:g}° left of straight ahead; 1 where nothing is",
            f"{lidar.range_m:g} m",
        )
        for k in range(lidar.rays)
    ) + features_of((f"speed_{k}", told, "40 m/s") for k in range(lidar.rays * lidar.speeds))


def reach_m(config: SensorsConfig) -> float:
    return config.lidar.range_m * (config.lidar.rays > 0)


SENSOR = Sensor("lidar", features, reach_m, sees_bodies=True)
