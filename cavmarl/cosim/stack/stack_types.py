"""The data that the stages of a stack exchange.

Places are those of the map: x east, y north, in m; headings counter-clockwise from east, in rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class SensorSamples(Protocol):
    """What one sensor has since the last step."""

    @property
    def values(self) -> NDArray[Any]: ...  # (n, …) one sample a row, the newest last
    @property
    def stamps_s(self) -> NDArray[np.float64]: ...  # (n,) when each was taken
    @property
    def lost(self) -> NDArray[np.bool_]: ...  # (n,) which were lost


Readings = Mapping[str, SensorSamples]
"""By the sensor's name; those that are due."""


class StackMount(NamedTuple):
    """Where a sensor is on its vehicle, in the plane."""

    x_m: float
    y_m: float
    yaw_rad: float


class StackSensor(NamedTuple):
    """One sensor of the vehicle."""

    name: str
    type: str
    mount: StackMount
    settings: Mapping[str, Any]  # its keys in `env.yaml`


class EgoPose(NamedTuple):
    """Where the vehicle's centre is, and how it moves."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float  # forward
    yaw_rate_radps: float = 0.0


class Obstacle(NamedTuple):
    """Something on the road, as far as it is seen."""

    x_m: float  # its middle
    y_m: float
    heading_rad: float  # of its longer axis, along the road
    length_m: float
    width_m: float
    vx_mps: float
    vy_mps: float
    kind: str = "unknown"  # or `vehicle`, `cyclist`, `pedestrian`, where a camera tells


class Mission(NamedTuple):
    """What the vehicle is to do, and what it is."""

    goal_edge: int  # EDGE row; the vehicle is to go to the end of that edge
    vclass: str  # SUMO's
    length_m: float
    width_m: float


class Control2D(NamedTuple):
    """What the vehicle does: acceleration, and the angle of the front wheels."""

    accel_mps2: float
    steering_rad: float


@dataclass(frozen=True)
class Trajectory:
    """Where to drive, and how fast."""

    points: NDArray[np.float64]  # (n, 2) the way ahead, from beside the vehicle on; at least two
    accel_mps2: float  # along it, now
    # what that is for: `free`, `gap`, `pedestrian`, `stop_line`, `yield` or `end`
    reason: str = "free"
    lanes: Sequence[int] = field(default_factory=tuple)


class Perception(Protocol):
    """Sensors → what is on the road."""

    def perceive(self, readings: Readings, pose: EgoPose, time_s: float) -> list[Obstacle]: ...


class Localisation(Protocol):
    """Sensors → where the vehicle is."""

    def locate(self, readings: Readings, mission: Mission, time_s: float) -> EgoPose | None:
        """Where it is now; None: not known yet."""
        ...

    def reset_pose(self, pose: EgoPose) -> None: ...


class SignalReading(Protocol):
    """Messages, or what the world says → what signals show."""

    def read(self, readings: Readings, told: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
        """(num_links,) SIGNAL_* codes, 255: none; None: unknown."""
        ...


class Planning(Protocol):
    """Where the vehicle is, what is on the road and what signals show → where to drive."""

    def plan(
        self,
        pose: EgoPose,
        obstacles: Sequence[Obstacle],
        signals: NDArray[np.uint8] | None,
        mission: Mission,
    ) -> Trajectory:
        """The way from here on.

        `obstacles`: what is on the road. `signals`: (num_links,) SIGNAL_* codes, 255: none; None:
        unknown. `mission`: where it is to go.
        """
        ...


class ControlStage(Protocol):
    """Where to drive → what the vehicle does."""

    def control(self, pose: EgoPose, trajectory: Trajectory, mission: Mission) -> Control2D: ...
