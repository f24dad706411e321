"""The `lidar` sensor: distances along rays around the vehicle."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, features_of


def features(config: SensorsConfig) -> list[Feature]:
    """List the distances of all rays and, with `speeds`, the relative speeds of the objects hit."""
    lidar = config.lidar
    step = 360.0 / max(lidar.rays, 1)
    meaning = "speed of the object hit relative to ego, along the ray; 0 if the ray hits nothing"
    return features_of(
        (
            f"distance_{k}",
            f"distance along the ray {k * step:g}° left of straight ahead; 1: no hit",
            f"{lidar.range_m:g} m",
        )
        for k in range(lidar.rays)
    ) + features_of((f"speed_{k}", meaning, "40 m/s") for k in range(lidar.rays * lidar.speeds))


def reach_m(config: SensorsConfig) -> float:
    return config.lidar.range_m * (config.lidar.rays > 0)


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.lidar
    what = f"{own.rays} rays of {own.range_m:g} m that end at vehicles, but not at buildings"
    return [Reading("ideal sensors", what + (", with speeds" if own.speeds else ""))]


def _ray_on_other_side(config: SensorsConfig, name: str) -> str:
    number, kind = name.rpartition("_")[::-2]
    return f"{kind}_{-int(number) % config.lidar.rays}"


SENSOR = Sensor(
    "lidar",
    features,
    reach_m,
    sees_bodies=True,
    reads=reads,
    sides=Sides(partner=_ray_on_other_side),
)
