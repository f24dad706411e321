"""The sensors that agents observe: what each adds to an observation, and how far it looks.

A new one of the package has its features here, a kernel that writes its numbers, which
`kernels/sense` or, if most environments leave it off, `kernels/observe_optional` calls, and its
place in `SENSORS`. Those from outside are registered, see `sensors.registry`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.extensions import REGISTERED_SENSORS
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.math.walls import Walls, make_walls
from cavmarl.core.records.arrays import Sensors
from cavmarl.rewards.kernels.terms import TTC_REACH_M
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.lidar_2d import ECHO, ray_directions
from cavmarl.sensors.kernels.sensor_arrays import OptionalSensors
from cavmarl.sensors.observed import ego_features as seen
from cavmarl.sensors.observed import highway_kinematics as kinematics
from cavmarl.sensors.observed import lidar_observation, occupancy_grid, way_features
from cavmarl.sensors.observed.feature import Sensor
from cavmarl.sensors.observed.highway import goal_places

# Those of the package, in the order of their features in a frame.
SENSORS: tuple[Sensor, ...] = (
    Sensor("ego", seen.ego),
    Sensor("route", seen.route),
    Sensor("neighbors", seen.neighbors, lambda c: c.neighbors.range_m * (c.neighbors.count > 0)),
    Sensor("signal", seen.signal),
    # Its range is that of gaps along lanes and of centres in the plane.
    Sensor("lanes", seen.lanes, lambda c: c.lanes.range_m),
    Sensor("lidar", seen.lidar, lambda c: c.lidar.range_m * (c.lidar.rays > 0), sees_bodies=True),
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
    Sensor("messages", seen.messages),  # they come from the bus, which knows no zones
    Sensor("way", way_features.way),
    Sensor(
        "conflicts",
        way_features.conflicts,
        lambda c: c.conflicts.range_m * (c.conflicts.count > 0),
        way_features.conflicts_shape,
    ),
    # The last of the package: see `carried_from`.
    Sensor("history", way_features.history, shape=way_features.history_shape),
)

# The nearest vehicles of which walls may hide some.
MAX_NEIGHBORS_TRIED = 256

# Those that `observe_optional` writes.
FURTHER = frozenset(
    (
        "kinematics", "occupancy_grid", "lidar_observation",
        "way", "conflicts", "history",
    )
)  # fmt: skip


def sensors_of(config: SensorsConfig) -> tuple[Sensor, ...]:
    """The sensors that a world can have: those of the package, on or off, then the registered."""
    return (*SENSORS, *(REGISTERED_SENSORS[name] for name in config.registered))


def feature_names(config: SensorsConfig) -> list[tuple[str, str]]:
    """Sensor and feature of each number of a frame of an observation."""
    return [
        (sensor.name, feature.name)
        for sensor in sensors_of(config)
        for feature in sensor.features(config)
    ]


def layout(config: SensorsConfig) -> dict[str, slice]:
    """Where each sensor's features lie in a frame; sensors that are off are left out."""
    places: dict[str, slice] = {}
    start = 0
    for sensor in sensors_of(config):
        size = len(sensor.features(config))
        if size:
            places[sensor.name] = slice(start, start + size)
        start += size
    return places


def frame_size(config: SensorsConfig) -> int:
    """Numbers in one frame; a flat observation holds `config.stack` of them."""
    return sum(place.stop - place.start for place in layout(config).values())


def carried_from(config: SensorsConfig) -> int:
    """From where on an observation holds what the next one takes from it; its size: nothing.

    What comes before is the oldest frame, or what is observed anew in every step.
    """
    if config.stack > 1:
        return frame_size(config)
    places = layout(config)
    return places["history"].start if "history" in places else frame_size(config)


def largest_radius_m(types: NDArray[np.void]) -> float:
    """Half the diagonal of the largest body, in m: no part of one is further from its centre.

    Args:
        types: VTYPE (num_types,), `Travel.types`: those of agents and of all others.
    """
    return 0.5 * float(hypot_all(types["length"], types["width"]).max())


def sensing_reach_m(config: SensorsConfig, largest_radius_m: float) -> float:
    """How far from an agent's centre the centre of a vehicle can be that it can tell, in m.

    A vehicle that is further away changes no number of an observation and no term of the package.
    Sensors that ask for centres reach as far as they look, `lanes` too: it takes none that is
    further away in the plane. Rays end at bodies, whose centres are up to half a diagonal behind.
    Of the terms, time to collision alone looks at others; it is always on.
    """
    sensors = sensors_of(config)
    reaches = (sensor.reach_of_centres_m(config, largest_radius_m) for sensor in sensors)
    return max(TTC_REACH_M, *reaches)


def _starts(config: SensorsConfig) -> dict[str, int]:
    """Where each sensor begins in a frame; 0 for those that are off."""
    places = layout(config)
    return {
        sensor.name: places[sensor.name].start if sensor.name in places else 0 for sensor in SENSORS
    }


def _walls(network: RoadNetwork, through_walls: bool) -> Walls:
    """The walls that hide others; none where these are seen through walls."""
    walls = network.walls[:0] if through_walls else network.walls
    return make_walls(np.stack([walls[name] for name in ("ax", "ay", "bx", "by")], axis=1))


def sensor_arrays(config: SensorsConfig, network: RoadNetwork) -> Sensors:
    """The settings and the scratch memory that `sense` takes."""
    walls = _walls(network, config.neighbors.through_walls)
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
    """What `observe_optional` takes; None if all of its sensors are off.

    `most_told`: vehicles that an inbox keeps. `capacity`: rows of a world.
    """
    if FURTHER.isdisjoint(layout(config)):
        return None
    starts = _starts(config)
    goals = goal_places(network, plans)
    return OptionalSensors(
        kinematics=kinematics.settings(config, starts["kinematics"], network, goals),
        occupancy=occupancy_grid.settings(config, starts["occupancy_grid"], network, goals),
        lidar_cells=lidar_observation.settings(config, starts["lidar_observation"]),
        way=way_features.way_settings(config, starts["way"]),
        conflicts=way_features.conflicts_settings(
            config,
            starts["conflicts"],
            _walls(network, config.conflicts.through_walls),
            most_told,
            capacity,
        ),
        history=way_features.history_settings(config, starts["history"]),
    )
