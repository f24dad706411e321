"""The sensors: what each adds to an observation, and how far it looks.

One file a sensor; a new one is a file here, a function in `kernels/observing.py` that writes its
numbers, and its line in `SENSORS`.
"""

from __future__ import annotations

from cavmarl.config import SensorsConfig
from cavmarl.kernels.arrays import Sensors
from cavmarl.shard.sensors import ego, lanes, lidar, neighbors, route, signal
from cavmarl.shard.sensors.feature import Feature, Sensor

__all__ = ["SENSORS", "Feature", "Sensor", "layout", "reach_m", "sensor_arrays"]

# In the order of their features in a flat observation.
SENSORS: tuple[Sensor, ...] = (
    Sensor("ego", ego.features, ego.reach_m),
    Sensor("route", route.features, route.reach_m),
    Sensor("neighbors", neighbors.features, neighbors.reach_m),
    Sensor("signal", signal.features, signal.reach_m),
    Sensor("lanes", lanes.features, lanes.reach_m),
    Sensor("lidar", lidar.features, lidar.reach_m),
)


def layout(config: SensorsConfig) -> dict[str, slice]:
    """Where each sensor's features lie in a flat observation; sensors that are off are left out."""
    places: dict[str, slice] = {}
    start = 0
    for sensor in SENSORS:
        size = len(sensor.features(config))
        if size:
            places[sensor.name] = slice(start, start + size)
        start += size
    return places


def reach_m(config: SensorsConfig) -> float:
    """How far the sensors of an agent look, in m."""
    return max(sensor.reach_m(config) for sensor in SENSORS)


def sensor_arrays(config: SensorsConfig) -> Sensors:
    """The settings and the room that the sensing kernels take."""
    places = layout(config)
    unused = slice(0, 0)
    return Sensors(
        route_at=places.get("route", unused).start,
        route_points=config.route.points,
        route_spacing_m=config.route.spacing_m,
        neighbors_at=places.get("neighbors", unused).start,
        neighbors=config.neighbors.count,
        neighbors_range_m=config.neighbors.range_m,
        signal_at=places["signal"].start,
        signal_range_m=config.signal.range_m,
        signal_timing=config.signal.timing,
        lanes_at=places.get("lanes", unused).start,
        lanes_range_m=config.lanes.range_m,
        lidar_at=places.get("lidar", unused).start,
        lidar_rays=config.lidar.rays,
        lidar_range_m=config.lidar.range_m,
        lidar_speeds=config.lidar.speeds,
        rays=lidar.directions(config),
        echoes=lidar.room(config),
        **neighbors.room(config),
    )
