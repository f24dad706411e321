"""The `neighbors` sensor: the nearest vehicles."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, hidden, numbered


def features(config: SensorsConfig) -> list[Feature]:
    """List seven features per vehicle, nearest vehicle first; missing vehicles are 0."""
    scale = f"{config.neighbors.range_m:g} m"
    rows = (
        ("present", "1 if there is a vehicle", ""),
        ("x", "longitudinal position, ego frame", scale),
        ("y", "lateral position, left positive, ego frame", scale),
        ("vx", "longitudinal velocity minus the ego speed, ego frame", "40 m/s"),
        ("vy", "lateral velocity, left positive, ego frame", "40 m/s"),
        ("cos", "cosine of its heading relative to the ego heading", ""),
        ("sin", "sine of its heading relative to the ego heading", ""),
    )
    return numbered(config.neighbors.count, "neighbour {}", rows)


def reach_m(config: SensorsConfig) -> float:
    return config.neighbors.range_m * (config.neighbors.count > 0)


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.neighbors
    what = f"the {own.count} nearest vehicles within {own.range_m:g} m"
    return [Reading("ideal sensors", f"{what}; {hidden(own.through_walls)}")]


SENSOR = Sensor("neighbors", features, reach_m, reads=reads, sides=Sides(("y", "vy", "sin")))
