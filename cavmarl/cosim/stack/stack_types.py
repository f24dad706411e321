"""The data that the stages of a stack exchange.

Positions are x east and y north on the map in m; headings are counter-clockwise from east in rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class SensorSamples(Protocol):
    """The samples of one sensor since the last step."""

    @property
    def values(self) -> NDArray[Any]: ...  # (n, …) one sample per row, the newest last
    @property
    def stamps_s(self) -> NDArray[np.float64]: ...  # (n,) time of each sample
    @property
    def lost(self) -> NDArray[np.bool_]: ...  # (n,) which samples were lost


Readings = Mapping[str, SensorSamples]
"""New samples by the sensor's name."""


class StackMount(NamedTuple):
    """The place of a sensor on its vehicle, in the plane."""

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
    """The pose and the motion of the vehicle's centre."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float  # forward
    yaw_rate_radps: float = 0.0


class Obstacle(NamedTuple):
    """A detected object on the road."""

    x_m: float  # position of the centre
    y_m: float
    heading_rad: float  # direction of its longer axis, along the road
    length_m: float
    width_m: float
    vx_mps: float  # velocity in the map's frame; 0: unknown, or stopped
    vy_mps: float
    kind: str = "unknown"  # or `vehicle`, `cyclist`, `pedestrian`, if a camera detects it


class Mission(NamedTuple):
    """The destination and the body of the vehicle."""

    goal_edge: int  # EDGE row; the end of this edge is the destination
    vclass: str  # SUMO's vehicle class
    length_m: float
    width_m: float


class Control2D(NamedTuple):
    """Controls of a vehicle: acceleration, and the angle of the front wheels."""

    accel_mps2: float
    steering_rad: float


@dataclass(frozen=True)
class Trajectory:
    """The route to drive, and the acceleration along it."""

    points: NDArray[np.float64]  # (n, 2) the route from the vehicle's position; at least two points
    accel_mps2: float  # acceleration along the route now
    # reason of the acceleration: `free`, `gap`, `pedestrian`, `stop_line`, `yield` or `end`
    reason: str = "free"
    lanes: Sequence[int] = field(default_factory=tuple)  # LANE rows of the route


class Perception(Protocol):
    """Detects objects on the road by sensors."""

    def perceive(self, readings: Readings, pose: EgoPose, time_s: float) -> list[Obstacle]: ...


class Localisation(Protocol):
    """Estimates the vehicle's pose by sensors."""

    def locate(self, readings: Readings, mission: Mission, time_s: float) -> EgoPose | None:
        """Return the current pose; None: unknown."""
        ...

    def reset_pose(self, pose: EgoPose) -> None: ...


class SignalReading(Protocol):
    """Reads the state of signals from messages or from the world."""

    def read(self, readings: Readings, told: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
        """Return (num_links,) SIGNAL_* codes, 255: no signal; None: unknown."""
        ...


class Planning(Protocol):
    """Plans the route and the acceleration from pose, objects and signals."""

    def plan(
        self,
        pose: EgoPose,
        obstacles: Sequence[Obstacle],
        signals: NDArray[np.uint8] | None,
        mission: Mission,
    ) -> Trajectory:
        """Return the route from the current pose.

        `obstacles`: objects on the road. `signals`: (num_links,) SIGNAL_* codes, 255: no signal;
        None: unknown. `mission`: the destination.
        """
        ...


class ControlStage(Protocol):
    """Computes controls for a trajectory."""

    def control(self, pose: EgoPose, trajectory: Trajectory, mission: Mission) -> Control2D: ...
