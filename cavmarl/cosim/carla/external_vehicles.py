"""`ExternalVehicles`: the vehicles that clients spawn into a world.

They are external vehicles of the environment, so drivers, sensors and contacts see them, and they
are part of the world's state. They enter in the next step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cavmarl.core.errors import ActionError, CavmarlError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_geometry import CarlaPose
from cavmarl.cosim.carla.vehicle_controls import WHEELBASE_SHARE, Control, motion_of, same_turn
from cavmarl.env.parallel import CavEnv

_OCCUPIED = "Spawn failed because of collision at spawn position"  # CARLA's text
_VTYPE_OF_BASE = {"truck": "truck", "bus": "bus"}  # all others are cars


class ExternalBody(NamedTuple):
    """A vehicle to spawn."""

    type_id: str  # of its blueprint
    base_type: str  # CARLA's attribute: car, van, truck, bus, motorcycle, bicycle
    pose: CarlaPose
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: float = 0.0


class ExternalVehicles:
    """The vehicles of clients in the one world of an environment, by their slots.

    Attributes:
        controls: the last control of each vehicle that a client drives.
    """

    def __init__(self, env: CavEnv) -> None:
        self._env = env
        self._vtypes: dict[int, str] = {}
        self._lengths_m: dict[int, float] = {}
        self.controls: dict[int, Control] = {}
        self._posed: set[int] = set()  # in the next step, instead of driving

    def spawn(self, body: ExternalBody) -> tuple[int, tuple[float, float, float]]:
        """Let a vehicle enter in the next step, on the ground; return its slot and its size.

        A vehicle has at most the size of the largest type of the world.

        Raises CallRefused: the place is occupied or outside of the map, or there is no room.
        """
        simulation = self._env.simulation
        vtype = _VTYPE_OF_BASE.get(body.base_type, "car")
        length, width, height = (
            min(size, float(simulation.types[name].max()))
            for size, name in zip(body.size_m, ("length", "width", "height"), strict=True)
        )
        pose = body.pose
        try:
            slot = self._env.external.spawn(
                pose.x,
                -pose.y,
                -math.radians(pose.yaw),
                vtype=vtype,
                size_m=(length, width, height),
                speed=body.speed_mps,
            )
        except ActionError as error:
            if "occupied" in str(error):
                raise CallRefused(_OCCUPIED) from error
            raise CallRefused(f"{body.type_id}: {error}") from error
        except CavmarlError as error:
            raise CallRefused(f"{body.type_id}: {error}") from error
        self._vtypes[slot], self._lengths_m[slot] = vtype, length
        return slot, (length, width, height)

    def destroy(self, slot: int) -> None:
        """Remove a vehicle in the next step."""
        self._env.external.remove(slot)
        self._drop(slot)

    def place(self, slot: int, pose: CarlaPose) -> None:
        """Move a vehicle to a pose, which it reaches in the next step.

        Raises CallRefused: the pose is outside of the map.
        """
        try:
            self._env.external.pose(
                slot,
                pose.x,
                -pose.y,
                -math.radians(pose.yaw),
                z=pose.z,
                pitch=math.radians(pose.pitch),
            )
        except CavmarlError as error:
            raise CallRefused(str(error)) from error
        self._posed.add(slot)

    def control(self, slot: int, control: Control) -> None:
        """Drive a vehicle from the next tick on."""
        self.controls[slot] = control

    def ids(self) -> dict[int, int]:
        """Return the vehicle id of each slot in use; -1: the vehicle has not entered yet."""
        if not self._vtypes:
            return {}
        ids = self._env.external.ids()
        return {slot: int(ids[slot]) for slot in self._vtypes}

    def act(self) -> None:
        """Give the controls to the environment, for the next step."""
        simulation = self._env.simulation
        rows = simulation.vehicles(0)
        rows = rows[rows["driver"] == DRIVER_EXTERNAL]
        speed_of = dict(zip(rows["order"].tolist(), rows["speed"].tolist(), strict=True))
        for slot, control in self.controls.items():
            if slot in self._posed:
                continue
            vtype = simulation.type_rows[self._vtypes[slot]]
            axles_apart = float(simulation.types["wheelbase"][vtype]) / self._lengths_m[slot]
            acceleration, angle = motion_of(control, speed_of.get(slot, 0.0))
            self._env.external.drive(
                slot, acceleration, same_turn(angle, axles_apart / WHEELBASE_SHARE)
            )
        self._posed.clear()

    def forget(self) -> None:
        """Forget all vehicles, after the end of an episode."""
        for slot in list(self._vtypes):
            self._drop(slot)

    def _drop(self, slot: int) -> None:
        del self._vtypes[slot], self._lengths_m[slot]
        self.controls.pop(slot, None)
