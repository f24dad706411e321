"""`ExternalVehicles`: the vehicles and walkers that clients spawn into a world."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_geometry import CarlaPose
from cavmarl.cosim.carla.vehicle_controls import Control


class ExternalBody(NamedTuple):
    """A vehicle or a walker to spawn."""

    type_id: str  # of its blueprint
    pose: CarlaPose
    size_m: tuple[float, float, float]  # length, width, height


class ExternalVehicles(Protocol):
    """Vehicles in a world that a client owns; their rows belong to the world's state.

    A vehicle is named by its id in the rows of the world.
    """

    def spawn(self, body: ExternalBody) -> int:
        """Add a body at once and return its id.

        Raises CallRefused: the place is occupied, or there is no room.
        """
        ...

    def destroy(self, vehicle: int) -> None: ...

    def place(self, vehicle: int, pose: CarlaPose) -> None:
        """Move a body as a puppet; its velocity follows from its places."""
        ...

    def control(self, vehicle: int, control: Control) -> None:
        """Drive a vehicle from the next tick on."""
        ...

    def owns(self, vehicle: int) -> bool:
        """Return whether a client has spawned this vehicle."""
        ...


class NoExternalVehicles:
    """The vehicles of a world without room for any."""

    def spawn(self, body: ExternalBody) -> int:
        raise CallRefused(f"{body.type_id}: no room: population.external is 0")

    def destroy(self, vehicle: int) -> None:
        raise CallRefused(f"vehicle {vehicle} was not spawned by a client")

    def place(self, vehicle: int, pose: CarlaPose) -> None:
        raise CallRefused(f"vehicle {vehicle} was not spawned by a client")

    def control(self, vehicle: int, control: Control) -> None:
        raise CallRefused(f"vehicle {vehicle} was not spawned by a client")

    def owns(self, vehicle: int) -> bool:
        return False
