"""The neural networks of background vehicles, in the form that `drive_by_network` reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.traffic import ZOO, TrafficConfig
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.networks.background_driver import BackgroundDriver, background_drivers
from cavmarl.networks.kernels.inference import TILE_ROWS
from cavmarl.networks.trained_maps import is_other_side, untrained_kinds
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed import all_optional_arrays, frame_size, sensor_arrays
from cavmarl.sensors.observed.exchanged_sides import exchange_sides
from cavmarl.shards.kernels.learned_driving import LearnedDriver
from cavmarl.v2x.kernels.v2x_records import REPORT


def learned_drivers(
    config: EnvConfig,
    network: RoadNetwork,
    plans: NDArray[np.void],  # PLAN (goals, lanes)
    capacity: int,  # rows per world
) -> tuple[LearnedDriver, ...]:
    """Return the networks that `traffic.model` names, ordered as `TrafficConfig.models`.

    Raises:
        PolicyError: see `background_drivers`; or the number of features that a driver's sensors
            give is wrong for its network, or left and right cannot be exchanged in these features.
    """
    drivers = background_drivers(config.traffic)
    return tuple(_learned(drivers, network, plans, capacity)) if drivers else ()


def check_commands(drivers: Sequence[LearnedDriver], traffic: TrafficConfig) -> None:
    """Raise a PolicyError if a network gave a command that is not a number."""
    for driver in drivers:
        if (vehicle := driver.failed.item()) >= 0:
            driver.failed[0] = -1
            name = traffic.networks[driver.number - 1]
            raise PolicyError(
                f"traffic.model = '{ZOO}{name}': its network gives NaN as the command of vehicle "
                f"{vehicle}; commands must be numbers. Train the driver again, or name another one"
            )


def _learned(
    drivers: tuple[BackgroundDriver, ...],
    network: RoadNetwork,
    plans: NDArray[np.void],
    capacity: int,
) -> Iterator[LearnedDriver]:
    from cavmarl.networks.driver_network import load_driver_network  # imports pydantic

    for number, driver in enumerate(drivers, start=1):
        loaded = load_driver_network(driver.folder)
        sensors, action = loaded.config.sensors, loaded.config.action
        size = frame_size(sensors)
        if loaded.config.observation_size != size:
            raise PolicyError(
                f"{driver.name}: observes {loaded.config.observation_size} numbers, but its "
                f"sensors give {size} in this version; train it again, or name another driver in "
                "traffic.model"
            )
        exchanged, signs = _exchanged_sides(driver, network)
        yield LearnedDriver(
            number=number,
            sensors=sensor_arrays(sensors, network),
            optional=all_optional_arrays(sensors, network, plans, 0, capacity),
            layers=loaded.best_layers,
            weights=loaded.weights,
            accel_mps2=action.acceleration_mps2,
            steering_rad=action.steering_rad,
            exchanged=exchanged,
            signs=signs,
            no_reports=np.zeros(0, dtype=REPORT),
            failed=np.full(1, -1, dtype=np.int64),
            observations=np.zeros(TILE_ROWS * size, dtype=np.float32),
            frame=np.zeros(size, dtype=np.float32),
            actions=np.zeros(TILE_ROWS * loaded.config.num_outputs, dtype=np.float32),
            states=np.zeros(0, dtype=np.float32),
            buffers=loaded.new_buffers(),
            places=np.zeros(TILE_ROWS, dtype=np.int64),
        )


def _exchanged_sides(
    driver: BackgroundDriver, network: RoadNetwork
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return how to exchange left and right in an observation.

    The arrays are empty if the driver was trained on the map's side of the road.
    """
    if not is_other_side(untrained_kinds(network, driver.maps)):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.float32)
    try:
        places, signs = exchange_sides(driver.sensors)
    except ConfigError as error:
        raise PolicyError(
            f"traffic.model = '{ZOO}{driver.name}': cannot drive on this map: {error}; name a "
            "driver that was trained on this side of the road"
        ) from error
    return places.astype(np.int64), signs
