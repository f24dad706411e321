"""`ShardBackend`: what a simulator has to do to run the vehicles of one zone.

A tick of a zone has two halves, between which zones tell each other where their vehicles are:

    apply_controls → advance → (owned vehicles are read, ghosts are renewed) → commit

`engine.kinematic_shard` does it with cavmarl's own vehicles, and `engine.backend_world` runs one
world over several backends, of one kind or of more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class VehicleControl(NamedTuple):
    """What a vehicle does until the next step."""

    acceleration_mps2: float  # negative brakes
    steering_rad: float  # of the front wheels, positive to the left


class ShardBackend(Protocol):
    """Runs the vehicles of one zone of one world.

    Vehicles are records `driving.vehicles.VEHICLE`; frames and units are those of that page. What
    cannot be done is a `CavmarlError` that names the vehicle, and changes nothing.

    Attributes:
        zone: its number.
        reach_m: how far over its border it asks for ghosts.
    """

    zone: int
    reach_m: float

    def reset(self, seed: int) -> None:
        """Go to tick 0, without vehicles."""
        ...

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        """Own the vehicles VEHICLE (n,) from the present tick on, in just this state."""
        ...

    def destroy(self, vehicles: Sequence[int]) -> None:
        """Forget owned vehicles, by their ids: they have arrived, or are another zone's."""
        ...

    def apply_controls(self, controls: Mapping[int, VehicleControl]) -> None:
        """What owned vehicles of agents do, by their ids, until they are told otherwise."""
        ...

    def advance(self) -> None:
        """Move the owned vehicles to the next tick, by what all vehicles were at this one."""
        ...

    def upsert_ghosts(self, vehicles: NDArray[np.void]) -> None:
        """Show other zones' vehicles VEHICLE (n,), new ones or known ones, as they are now."""
        ...

    def remove_ghosts(self, vehicles: Sequence[int]) -> None:
        """Show ghosts no more, by their ids."""
        ...

    def commit(self) -> int:
        """End the tick: contacts, signals, what sensors see; its number."""
        ...

    def read_vehicles(self) -> NDArray[np.void]:
        """VEHICLE (n,), a copy: owned vehicles as `advance`, `commit` or `spawn` has left them."""
        ...

    def read_sensors(self) -> dict[int, NDArray[np.float32]]:
        """What the owned vehicles of agents have sensed last, by their ids: (D,) each.

        Those that have not sensed yet, or not here, are left out.
        """
        ...

    def snapshot(self) -> bytes:
        """All that the next tick depends on; between two ticks."""
        ...

    def restore(self, data: bytes) -> None:
        """Go on from a snapshot of a backend of the same kind, zone and world."""
        ...
