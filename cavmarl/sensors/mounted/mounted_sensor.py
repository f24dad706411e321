"""`MountedSensor`: what every type of sensor is made of."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

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
    """What the agents of one zone can see, in the present tick."""

    roads: RoadArrays  # of the whole map
    lane_grid: LaneGrid
    plans: NDArray[np.void]
    travel: TripTables  # types of vehicles
    worlds: Worlds  # the committed rows: first the zone's own, then ghosts
    grid: Grid  # scratch: the spatial index of one world; callers that ask it fill it
    before: NDArray[np.void]  # POSE (W, A) of all agents in the tick before


class Platform(NamedTuple):
    """What sensors are mounted on."""

    network: RoadNetwork
    body: np.void  # VTYPE of agents' vehicles
    num_worlds: int
    num_agents: int
    sim_dt_s: float
    ticks_per_step: int
    capacity: int  # the most rows of a world
    backdrop: Backdrop  # what cameras and rays meet of the map


class MountedSensor(ABC, Generic[C]):
    """One sensor of the rig, on the vehicles of all agents of W worlds.

    Attributes:
        name: in the rig.
        config: its settings.
        mount: where on the vehicle.
        frame: name of the frame that its directions are in.
        lines: (W, A, 2) which lines [first, last) of each agent's frame `sense` writes: all,
            unless others write the rest.
    """

    dtype: ClassVar[DTypeLike]
    kernel: ClassVar[Callable[..., None]]  # takes what `arguments` lists
    stamps_itself: ClassVar[bool] = False  # it has no rate: it also writes stamps and counts

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        self.name = name
        self.config = config
        self.mount = mount_of(config)
        self.frame = SENSOR_FRAME.format(name=name)
        self.lines = np.zeros((platform.num_worlds, platform.num_agents, 2), dtype=np.int32)
        self.lines[..., 1] = self.num_lines(config)
        check_place(name, config, platform.body)
        self._measure = specialized(type(self).kernel)

    @cached_property
    def noise(self) -> Noise:
        """What kernels take of `noise` and `bias`, one number a channel."""
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
        """The least and the largest number of a sample, in its shape; none where noise is added."""
        return np.full(config.shape, -np.inf), np.full(config.shape, np.inf)

    @staticmethod
    def reach_m(config: C, largest_radius_m: float) -> float:
        """How far from the vehicle's centre the centre of another can be that it can tell."""
        return 0.0

    @staticmethod
    def num_lines(config: C) -> int:
        """Into how many lines a frame can be divided, each of which can be written by itself."""
        return 1

    @abstractmethod
    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        """What the kernel takes to write the data that are due, for the agents of a zone."""

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write the data of all samples that are due, for the agents that the scenes own.

        What is written may depend on the agent's row, the others' rows within reach and the tick,
        and on nothing else: not on how rows are ordered, nor on which zone asks.

        `scenes`: one a zone. `due`: how many samples, and to which slots. `frames`: `data` is
        written; stamps, counts and losses are the rig's business.
        """
        for scene in scenes:
            self._measure(*self.arguments(scene, due, frames))


class ImagingSensor(MountedSensor[C]):
    """A sensor that looks around: at bodies, and at what stands on the map."""

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)

    def view(self, scene: SensedScene, due: Due) -> tuple[Any, ...]:
        """The first arguments of all their kernels."""
        return scene.worlds, scene.grid, self._backdrop, due


def stream_of(name: str) -> np.uint64:
    """The stream of a sensor's random numbers: of its name, whatever else is mounted."""
    return np.uint64(int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest()))
