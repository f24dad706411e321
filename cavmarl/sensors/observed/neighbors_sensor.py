"""The `neighbors` sensor: the nearest vehicles."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor, numbered


def features(config: SensorsConfig) -> list[Feature]:
    """Seven numbers of each of the nearest vehicles, nearest first; all 0 where there are fewer."""
    scale = f"{config.neighbors.range_m:g} m"
    rows = (
        ("present", "1 if there is one", ""),
        ("x", "forward place, ego frame", scale),
        ("y", "place to the left, ego frame", scale),
        ("vx", "forward velocity minus the own one, ego frame", "40 m/s"),
        ("vy", "velocity to the left minus the own one, ego frame", "40 m/s"),
        ("cos", "cosine of its heading minus the own one", ""),
        ("sin", "sine of its heading minus the own one", ""),
    )
    return numbered(config.neighbors.count, "neighbour {}", rows)


def reach_m(config: SensorsConfig) -> float:
    return config.neighbors.range_m * (config.neighbors.count > 0)


SENSOR = Sensor("neighbors", features, reach_m)
