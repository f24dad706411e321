"""`MountedSensor`: the base class of all mounted sensors."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.config.population import PopulationConfig
from cavmarl.config.rig import MountedConfig, SampledConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.math.neighbors import Grid
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, TripTables, Worlds
from cavmarl.roads.kernels.backdrop_pieces import Backdrop
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.rig_frames import Due, Noise
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import SENSOR_FRAME, check_place, mount_of

Bounds = tuple[NDArray[Any], NDArray[Any]]
C = TypeVar("C", bound=MountedConfig)


class SensedScene(NamedTuple):
    """The scene that the agents of one zone can sense in the current tick."""

    roads: RoadArrays  # the whole map
    lane_grid: LaneGrid
    plans: NDArray[np.void]
    travel: TripTables  # vehicle types
    worlds: Worlds  # the committed rows: the zone's own rows, then ghosts
    grid: Grid  # scratch: spatial index of one world, filled by the sensor that uses it
    before: NDArray[np.void]  # POSE (W, A) of all agents at the previous tick


class Platform(NamedTuple):
    """The vehicles that carry the sensors, and their worlds."""

    network: RoadNetwork
    bodies: NDArray[np.void]  # VTYPE (A,) of agents' vehicles
    population: PopulationConfig  # states which agents carry which sensors
    num_worlds: int
    num_agents: int
    sim_dt_s: float
    ticks_per_step: int
    capacity: int  # largest number of rows per world
    backdrop: Backdrop  # static scene for cameras and rays


class MountedSensor(ABC, Generic[C]):
    """One sensor of the rig, on the vehicles of all agents of W worlds.

    Attributes:
        name: name in the rig.
        config: settings of the sensor.
        mount: pose on the vehicle.
        frame: name of the frame of the sensor's directions.
        carriers: (A,) the agents whose vehicles carry it.
        lines: (W, A, 2) lines [first, last) of each agent's frame that `sense` writes: all, unless
            other processes write the rest.
    """

    dtype: ClassVar[DTypeLike]
    kernel: ClassVar[Callable[..., None]]  # called with the values of `arguments`
    stamps_itself: ClassVar[bool] = False  # has no rate: the kernel also writes stamps and counts

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        self.name = name
        self.config = config
        self.mount = mount_of(config)
        self.frame = SENSOR_FRAME.format(name=name)
        self.lines = np.zeros((platform.num_worlds, platform.num_agents, 2), dtype=np.int32)
        self.lines[..., 1] = self.num_lines(config)
        self.carriers = platform.population.carriers(name)
        check_place(name, config, platform.bodies[self.carriers])
        self._measure = specialized(type(self).kernel)

    @cached_property
    def noise(self) -> Noise:
        """Return `noise` and `bias` for kernels, one number per channel."""
        assert isinstance(self.config, SampledConfig)
        channels = len(self.config.units)
        noise, bias = np.array(self.config.noise), np.array(self.config.bias)
        return Noise(
            stream_of(self.name),
            np.broadcast_to(noise, channels).copy(),
            np.broadcast_to(bias, channels).copy(),
        )

    @staticmethod
    def bounds(config: C) -> Bounds:
        """Return the lower and upper bounds of a sample, with its shape; infinite if noisy."""
        return np.full(config.shape, -np.inf), np.full(config.shape, np.inf)

    @staticmethod
    def reach_m(config: C, largest_radius_m: float) -> float:
        """Return the largest distance at which the sensor can sense a vehicle, centre to centre."""
        return 0.0

    @staticmethod
    def num_lines(config: C) -> int:
        """Return the number of lines of a frame that can be written separately."""
        return 1

    @abstractmethod
    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        """Return the kernel's arguments for the samples that are due in one zone."""

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write the data of all due samples, for the agents that the scenes own.

        The data may depend only on the agent's row, the other rows within reach, and the tick, but
        not on the order of rows or on the zone.

        `scenes`: one per zone. `due`: number of samples, and their slots. `frames`: only `data` is
        written; the rig writes stamps, counts and losses.
        """
        for scene in scenes:
            self._measure(*self.arguments(scene, due, frames))


class ImagingSensor(MountedSensor[C]):
    """A sensor of the surroundings: bodies and the static scene."""

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)

    def view(self, scene: SensedScene, due: Due) -> tuple[Any, ...]:
        """Return the first arguments of the kernels of all imaging sensors."""
        return scene.worlds, scene.grid, self._backdrop, due


def stream_of(name: str) -> np.uint64:
    """Return the stream of a sensor's random numbers; it depends on the sensor's name only."""
    return np.uint64(int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest()))
