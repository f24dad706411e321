"""`ZoneSimulator`: the interface of another simulator that moves the vehicles of one zone.

The rows of such a zone are ordinary rows of a shard. cavmarl's drivers write their decisions to
them, and its signals, contacts, sensors and messages read them. In each tick, the simulator
receives the state that each vehicle should reach, and reports the state that it has reached.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import MountedConfig
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork

MOTION = np.dtype(
    [
        ("id", np.int64),
        ("x", np.float64),
        ("y", np.float64),
        ("heading", np.float64),  # rad, counter-clockwise from east
        ("speed", np.float64),  # m/s along the heading
    ],
    align=True,
)
"""The state of a vehicle that a simulator reports, in the frame of `driving.vehicles`."""


class ZoneSetup(NamedTuple):
    """The zone that a simulator runs."""

    world: int  # number of the world
    zone: int
    # min_x, min_y, max_x, max_y of the zone in m; zones at the rim of the map extend to infinity
    rect: tuple[float, float, float, float]
    network: RoadNetwork
    dt_s: float  # length of a tick
    wheelbases: NDArray[np.float64]  # wheelbase in m of each `VEHICLE["vtype"]`
    place: str  # the text after `NAME://` in `zones.simulators`, without options; may be empty
    options: Mapping[str, str]  # the options after `?`
    rig: Mapping[str, MountedConfig]  # the sensors that are mounted on agents' vehicles, by name


class ZoneSimulator(Protocol):
    """Another simulator that moves the vehicles of one zone of one world.

    A call may raise any exception if the simulator cannot go on. The world then ends with a
    `ZoneSimulatorError`, or cavmarl takes the zone back. Vehicles are records
    `driving.vehicles.VEHICLE`.
    """

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        """Make room for vehicles VEHICLE (n,) that may enter the zone now.

        Returns:
            Vehicle → reason, for each vehicle that cannot enter now.
        """
        ...

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        """Take over vehicles VEHICLE (n,) that `prepare` has accepted."""
        ...

    def drop(self, vehicles: Sequence[int]) -> None:
        """Remove vehicles, given by id, that have left the world or the zone."""
        ...

    def show(self, ghosts: NDArray[np.void], signals: Sequence[str]) -> None:
        """Show what surrounds the vehicles in the next tick.

        Args:
            ghosts: VEHICLE (n,), all vehicles of other zones near this zone. They have no physics.
            signals: the state of each signal, one of SUMO's letters per link index, in the order of
                `network.signal_ids`.
        """
        ...

    def advance(self, wanted: NDArray[np.void], aims: NDArray[np.float64]) -> None:
        """Begin a tick, and possibly return before it ends.

        Args:
            wanted: VEHICLE (n,), the owned vehicles as they would be after the tick if cavmarl
                moved them, with the commanded `throttle` and `steering`.
            aims: (n, 2), a point in m ahead on the route of each vehicle, for simulators that
                steer; NaN for agents, which command their `steering` themselves.
        """
        ...

    def read(self) -> NDArray[np.void]:
        """Wait for the end of the tick. Return the owned vehicles, MOTION (n,) in any order."""
        ...

    def close(self) -> None:
        """Remove all vehicles of the zone from the simulator, and end its processes."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """A `ZoneSimulator` that also takes the samples of some mounted sensors.

    Attributes:
        frame_types: types of sensors, such as `rgb_camera`, whose samples come from the simulator.
    """

    frame_types: frozenset[str]

    def sense(self, sensor: str, vehicles: Sequence[int]) -> Mapping[int, NDArray[Any]]:
        """Return the samples of the current tick.

        Args:
            sensor: name of the sensor in the rig.
            vehicles: owned vehicles of agents, by id.

        Returns:
            Vehicle → sample, with the shape and the unit of the sensor's type. Vehicles without a
            sample are left out: cavmarl's own sample is used for them.
        """
        ...


MakeSimulator = Callable[[ZoneSetup], ZoneSimulator]


def number_option(options: Mapping[str, str], name: str, default: float, most: float) -> float:
    """Return a numeric option. Raises ConfigError unless it is above 0 and at most `most`."""
    try:
        value = float(options.get(name, default))
    except ValueError:
        value = 0.0
    if not 0.0 < value <= most:  # false for NaN
        raise ConfigError(
            f"zones.simulators: {name} = {options[name]!r}: must be a number above 0 and at most "
            f"{most:g}"
        )
    return value
