"""The sensors: what each adds to an observation, and how far it looks.

One file a sensor; a new one is a file here, a function in `kernels/observing.py` that writes its
numbers, and its line in `SENSORS`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config import SensorsConfig
from cavmarl.kernels.arrays import Sensors
from cavmarl.roads.network import RoadNetwork
from cavmarl.shard.sensors import (
    ego,
    kinematics,
    lidar,
    lidar_observation,
    neighbors,
    occupancy_grid,
    roadgraph,
    route,
    signal,
)
from cavmarl.shard.sensors.feature import Feature, Sensor
from cavmarl.shard.sensors.highway import goal_places

__all__ = ["SENSORS", "Feature", "Sensor", "frame_size", "layout", "reach_m", "sensor_arrays"]

# In the order of their features in a frame.
SENSORS: tuple[Sensor, ...] = (
    Sensor("ego", ego.features, ego.reach_m),
    Sensor("route", route.features, route.reach_m),
    Sensor("neighbors", neighbors.features, neighbors.reach_m),
    Sensor("signal", signal.features, signal.reach_m),
    Sensor("lidar", lidar.features, lidar.reach_m),
    Sensor("kinematics", kinematics.features, kinematics.reach_m, kinematics.shape),
    Sensor(
        "occupancy_grid",
        occupancy_grid.features,
        occupancy_grid.reach_m,
        occupancy_grid.shape,
        occupancy_grid.dtype,
    ),
    Sensor(
        "lidar_observation",
        lidar_observation.features,
        lidar_observation.reach_m,
        lidar_observation.shape,
    ),
    Sensor("roadgraph", roadgraph.features, roadgraph.reach_m, roadgraph.shape),
)


def layout(config: SensorsConfig) -> dict[str, slice]:
    """Where each sensor's features lie in a frame; sensors that are off are left out."""
    places: dict[str, slice] = {}
    start = 0
    for sensor in SENSORS:
        size = len(sensor.features(config))
        if size:
            places[sensor.name] = slice(start, start + size)
        start += size
    return places


def frame_size(config: SensorsConfig) -> int:
    """Numbers in one frame; a flat observation holds `config.stack` of them."""
    return sum(place.stop - place.start for place in layout(config).values())


def reach_m(config: SensorsConfig) -> float:
    """How far the sensors of an agent look, in m."""
    return max(sensor.reach_m(config) for sensor in SENSORS)


def sensor_arrays(config: SensorsConfig, network: RoadNetwork, plans: NDArray[np.void]) -> Sensors:
    """The settings, the tables and the room that the sensing kernels take.

    Args:
        config: the sensors.
        network: the roads.
        plans: PLAN (G, L).
    """
    places = layout(config)
    unused = slice(0, 0)
    starts = {sensor.name: places.get(sensor.name, unused).start for sensor in SENSORS}
    shows_goals = bool(config.kinematics.vehicles_count or config.occupancy_grid.features)
    goals = goal_places(network, plans if shows_goals else plans[:0])
    return Sensors(
        stack=config.stack,
        ego="ego" in places,
        route_at=starts["route"],
        route_points=config.route.points,
        route_spacing_m=config.route.spacing_m,
        neighbors_at=starts["neighbors"],
        neighbors=config.neighbors.count,
        neighbors_range_m=config.neighbors.range_m,
        signal="signal" in places,
        signal_at=starts["signal"],
        signal_range_m=config.signal.range_m,
        lidar_at=starts["lidar"],
        lidar_rays=config.lidar.rays,
        lidar_range_m=config.lidar.range_m,
        lidar_speeds=config.lidar.speeds,
        rays=lidar.directions(config),
        echoes=lidar.room(config),
        kinematics=kinematics.settings(config, starts["kinematics"], network, goals),
        occupancy=occupancy_grid.settings(config, starts["occupancy_grid"], network, goals),
        lidar_cells=lidar_observation.settings(config, starts["lidar_observation"]),
        roadgraph=roadgraph.settings(config, starts["roadgraph"], network),
        **neighbors.room(config),
    )
