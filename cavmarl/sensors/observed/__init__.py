"""The sensors that agents observe: one file per sensor, and `SENSORS`, the only list of them.

Each file defines the sensor's part of an observation, its reach and, for an optional sensor, the
settings of its kernel. CONTRIBUTING.md shows how to add a sensor; `sensors.registry` registers
sensors of other packages.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.extensions import REGISTERED_SENSORS
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.records.arrays import Sensors
from cavmarl.rewards.kernels.terms import TERMS_REACH_M
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.lidar_2d import ECHO, ray_directions
from cavmarl.sensors.kernels.observe_optional import OptionalSensors
from cavmarl.sensors.observed import (
    conflicts_sensor,
    ego_sensor,
    history_sensor,
    kinematics_sensor,
    lanes_sensor,
    lidar_observation_sensor,
    lidar_sensor,
    messages_sensor,
    neighbors_sensor,
    occupancy_grid_sensor,
    route_sensor,
    signal_sensor,
    way_sensor,
)
from cavmarl.sensors.observed.feature import Sensor
from cavmarl.sensors.observed.highway import goal_places
from cavmarl.sensors.observed.sensor_setup import SensorSetup, walls_of

# The sensors of the package, in the order of their features in a frame.
SENSORS: tuple[Sensor, ...] = (
    ego_sensor.SENSOR,
    route_sensor.SENSOR,
    neighbors_sensor.SENSOR,
    signal_sensor.SENSOR,
    lanes_sensor.SENSOR,
    lidar_sensor.SENSOR,
    kinematics_sensor.SENSOR,
    occupancy_grid_sensor.SENSOR,
    lidar_observation_sensor.SENSOR,
    messages_sensor.SENSOR,
    way_sensor.SENSOR,
    conflicts_sensor.SENSOR,
    history_sensor.SENSOR,  # must be last: see `carried_from`
)

# Walls are checked only for this number of nearest vehicles.
MAX_NEIGHBORS_TRIED = 256


def sensors_of(config: SensorsConfig) -> tuple[Sensor, ...]:
    """Return all sensors of the package, on or off, then the registered sensors in use."""
    return (*SENSORS, *(REGISTERED_SENSORS[name] for name in config.registered))


def feature_names(config: SensorsConfig) -> list[tuple[str, str]]:
    """Return the sensor and the feature of each number in an observation frame."""
    return [
        (sensor.name, feature.name)
        for sensor in sensors_of(config)
        for feature in sensor.features(config)
    ]


def layout(config: SensorsConfig) -> dict[str, slice]:
    """Return the slice of each sensor's features in a frame, without the sensors that are off."""
    places: dict[str, slice] = {}
    start = 0
    for sensor in sensors_of(config):
        size = len(sensor.features(config))
        if size:
            places[sensor.name] = slice(start, start + size)
        start += size
    return places


def frame_size(config: SensorsConfig) -> int:
    """Return the number of values in a frame; a flat observation holds `config.stack` frames."""
    return sum(place.stop - place.start for place in layout(config).values())


def carried_from(config: SensorsConfig) -> int:
    """Return the index from which an observation repeats values of earlier observations.

    The values before this index are observed anew in each step, or belong to the oldest frame,
    which the next observation drops. If no value is repeated, the result is the observation's size.
    """
    if config.stack > 1:
        return frame_size(config)
    places = layout(config)
    return places["history"].start if "history" in places else frame_size(config)


def largest_radius_m(types: NDArray[np.void]) -> float:
    """Return half the diagonal of the largest body, in m: no corner is farther from its centre.

    Args:
        types: VTYPE (num_types,), `TripTables.types`: the types of agents and of all other
            vehicles.
    """
    return 0.5 * float(hypot_all(types["length"], types["width"]).max())


def sensing_reach_m(config: SensorsConfig, largest_radius_m: float) -> float:
    """Return the largest distance at which an agent can sense a vehicle, centre to centre, in m.

    A vehicle further away changes no number of an observation and no reward term of the package.
    Sensors that measure to vehicle centres reach as far as their range; `lanes` also ignores
    vehicles further away in the plane. Rays end at bodies, whose centres can be half a diagonal
    behind the hit. Reward terms are always computed and reach `TERMS_REACH_M`.
    """
    sensors = sensors_of(config)
    reaches = (sensor.reach_of_centres_m(config, largest_radius_m) for sensor in sensors)
    return max(TERMS_REACH_M, *reaches)


def _starts(config: SensorsConfig) -> dict[str, int]:
    """Return the index in a frame at which each sensor begins; 0 for sensors that are off."""
    places = layout(config)
    return {
        sensor.name: places[sensor.name].start if sensor.name in places else 0 for sensor in SENSORS
    }


def sensor_arrays(config: SensorsConfig, network: RoadNetwork) -> Sensors:
    """Return the settings and the scratch memory of the kernel `sense`."""
    walls = walls_of(network, config.neighbors.through_walls)
    near = MAX_NEIGHBORS_TRIED if len(walls.segments) else config.neighbors.count
    places = layout(config)
    starts = _starts(config)
    history = places.get("history", slice(0, 0))
    return Sensors(
        stack=config.stack,
        ego="ego" in places,
        ego_size=config.ego.size,
        route_at=starts["route"],
        route_points=config.route.points,
        route_spacing_m=config.route.spacing_m,
        neighbors_at=starts["neighbors"],
        neighbors=config.neighbors.count,
        neighbors_range_m=config.neighbors.range_m,
        signal="signal" in places,
        signal_at=starts["signal"],
        signal_range_m=config.signal.range_m,
        signal_timing=config.signal.timing,
        signal_stop_signs=config.signal.stop_signs == "own",
        lanes_at=starts["lanes"],
        lanes_range_m=config.lanes.range_m,
        lidar_at=starts["lidar"],
        lidar_rays=config.lidar.rays,
        lidar_range_m=config.lidar.range_m,
        lidar_speeds=config.lidar.speeds,
        rays=ray_directions(config.lidar.rays),
        echoes=np.zeros(config.lidar.rays, dtype=ECHO),
        walls=walls,
        near_body=np.zeros(near, dtype=np.int32),
        near_squared=np.zeros(near, dtype=np.float64),
        history_at=history.start,
        history=history.stop - history.start,
    )


def optional_arrays(
    config: SensorsConfig,
    network: RoadNetwork,
    plans: NDArray[np.void],
    most_told: int,
    capacity: int,
) -> OptionalSensors | None:
    """Return the settings of the kernel `observe_optional`; None if all optional sensors are off.

    `most_told`: number of vehicles that an inbox keeps. `capacity`: rows per world.
    """
    places = layout(config)
    if not any(sensor.name in places for sensor in SENSORS if sensor.settings is not None):
        return None
    return all_optional_arrays(config, network, plans, most_told, capacity)


def all_optional_arrays(
    config: SensorsConfig,
    network: RoadNetwork,
    plans: NDArray[np.void],
    most_told: int,
    capacity: int,
) -> OptionalSensors:
    """Return the settings of the optional sensors, on or off; arguments: see `optional_arrays`."""
    optional = [sensor for sensor in SENSORS if sensor.settings is not None]
    starts = _starts(config)
    goals = goal_places(network, plans)
    settings: dict[str, Any] = {
        sensor.name: sensor.settings(
            SensorSetup(config, starts[sensor.name], network, goals, most_told, capacity)
        )
        for sensor in optional
        if sensor.settings is not None
    }
    return OptionalSensors(**settings)
