"""`ShardBackend`: the interface of a simulator that runs the vehicles of one zone.

A tick of a zone has two halves. Between them, zones exchange the positions of their vehicles:

    apply_controls → advance → (owned vehicles are read, ghosts are renewed) → commit

`engine.kinematic_shard` is a backend with cavmarl's own vehicles. `engine.backend_world` runs one
world over several backends of one or several kinds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class VehicleControl(NamedTuple):
    """The controls of a vehicle until the next step."""

    acceleration_mps2: float  # negative brakes
    steering_rad: float  # of the front wheels, positive to the left


class ShardBackend(Protocol):
    """A simulator that runs the vehicles of one zone of one world.

    Vehicles are records `driving.vehicles.VEHICLE`, with the coordinate frames and units of that
    module. A call that cannot be carried out raises a `CavmarlError` that names the vehicle, and
    changes nothing.

    Attributes:
        zone: the number of the zone.
        reach_m: the distance beyond its border in which it needs ghosts.
    """

    zone: int
    reach_m: float

    def reset(self, seed: int) -> None:
        """Return to tick 0, without vehicles."""
        ...

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        """Add owned vehicles VEHICLE (n,), in exactly this state."""
        ...

    def destroy(self, vehicles: Sequence[int]) -> None:
        """Remove owned vehicles, by id, that have arrived or changed their zone."""
        ...

    def apply_controls(self, controls: Mapping[int, VehicleControl]) -> None:
        """Set the controls of agents' owned vehicles, by vehicle id, until the next call."""
        ...

    def advance(self) -> None:
        """Move the owned vehicles to the next tick, from the present state of all vehicles."""
        ...

    def upsert_ghosts(self, vehicles: NDArray[np.void]) -> None:
        """Add or update ghosts: the present rows VEHICLE (n,) of other zones' vehicles."""
        ...

    def remove_ghosts(self, vehicles: Sequence[int]) -> None:
        """Remove ghosts, by id."""
        ...

    def commit(self) -> int:
        """End the tick with contacts, signals and sensors. Return the number of the new tick."""
        ...

    def read_vehicles(self) -> NDArray[np.void]:
        """Return a copy of the owned vehicles, VEHICLE (n,), after the latest call."""
        ...

    def read_sensors(self) -> dict[int, NDArray[np.float32]]:
        """Return the latest observation (D,) of each owned vehicle of an agent, by vehicle id.

        Vehicles that have not sensed in this zone yet are absent.
        """
        ...

    def snapshot(self) -> bytes:
        """Return the state that the next tick depends on. Call between two ticks."""
        ...

    def restore(self, data: bytes) -> None:
        """Resume from a snapshot of a backend of the same kind, zone and world."""
        ...
