"""`ExternalVehicles`: the vehicles, walkers and static props that clients spawn into a world.

They are external vehicles of the environment, so drivers, sensors and contacts see them, and they
are part of the world's state. They enter in the next step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ActionError, CavmarlError, OccupiedPlaceError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_blueprints import WALKER
from cavmarl.cosim.carla.carla_geometry import CarlaPose, Vector
from cavmarl.cosim.carla.vehicle_controls import (
    WHEELBASE_SHARE,
    CarlaControl,
    Control,
    backward_motion_of,
    drives_backward,
    motion_of,
    same_turn,
)
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.env.parallel import CavEnv

MASS_KG = 1845.0  # mass that clients read in the physics of each vehicle
_OCCUPIED = "Spawn failed because of collision at spawn position"  # CARLA's text
_VTYPE_OF_BASE = {"truck": "truck", "bus": "bus", WALKER: WALKER}  # all other types are cars
_FASTEST_MPS = MAX_SPEED_MPS - 0.5  # a faster move to a pose is a jump
_FASTEST_BACKWARD_MPS = 10.0


class ExternalBody(NamedTuple):
    """A vehicle, walker or static prop to spawn."""

    type_id: str  # id of the blueprint
    base_type: str  # see `Blueprint.base_type`; a prop is a stopped vehicle
    pose: CarlaPose
    size_m: tuple[float, float, float]  # length, width, height
    speed_mps: float = 0.0


@dataclass
class _Spawned:
    """A vehicle or walker of a client. Vectors are in the client's frame.

    Attributes:
        lift_m: height of the origin of CARLA's actor above the ground.
        velocity, spin: velocity in m/s and turn rate in rad/s, for the next step only.
        constant: velocity in the vehicle's frame for every step.
        walk: direction and speed of a walker.
    """

    vtype: str
    length_m: float
    lift_m: float
    velocity: Vector | None = None
    spin: float | None = None
    constant: Vector | None = None
    walk: tuple[Vector, float] | None = None


class ExternalVehicles:
    """The vehicles and walkers of clients in the one world of an environment, by their slots.

    Attributes:
        controls: the last control of each vehicle that a client drives.
    """

    def __init__(self, env: CavEnv) -> None:
        self._env = env
        self._spawned: dict[int, _Spawned] = {}
        self.controls: dict[int, Control] = {}
        self._posed: set[int] = set()  # slots that get a pose in the next step
        self._bicycle_step = specialized(bicycle_step)

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
        except OccupiedPlaceError as error:
            raise CallRefused(_OCCUPIED) from error
        except CavmarlError as error:
            raise CallRefused(f"{body.type_id}: {error}") from error
        lift_m = 0.5 * height if vtype == WALKER else 0.0
        self._spawned[slot] = _Spawned(vtype, length, lift_m)
        return slot, (length, width, height)

    def destroy(self, slot: int) -> None:
        """Remove a vehicle in the next step."""
        self._env.external.remove(slot)
        self._drop(slot)

    def place(self, slot: int, pose: CarlaPose) -> None:
        """Move a vehicle to a pose, which it reaches in the next step.

        Raises CallRefused: the pose is outside of the map.
        """
        is_walker = self._spawned[slot].vtype == WALKER
        try:
            self._env.external.pose(
                slot,
                pose.x,
                -pose.y,
                -math.radians(pose.yaw),
                z=pose.z - self._spawned[slot].lift_m,
                pitch=0.0 if is_walker else math.radians(pose.pitch),
            )
        except CavmarlError as error:
            raise CallRefused(str(error)) from error
        self._posed.add(slot)

    def control(self, slot: int, control: Control) -> None:
        """Drive a vehicle from the next tick on."""
        self.controls[slot] = control

    def walk(self, slot: int, direction: Vector, speed_mps: float) -> None:
        """Let a walker walk from the next tick on."""
        self._spawned[slot].walk = direction, speed_mps

    def set_velocity(self, slot: int, velocity: Vector) -> None:
        """Give a vehicle a velocity in the next step; then it rolls, or follows its control."""
        self._spawned[slot].velocity = velocity

    def push(self, slot: int, change: Vector) -> None:
        """Change the velocity of a vehicle in the next step."""
        one = self._spawned[slot]
        before = one.velocity or self._velocity_of(slot)
        one.velocity = before[0] + change[0], before[1] + change[1], 0.0

    def set_spin(self, slot: int, spin_radps: float) -> None:
        """Turn a vehicle in the next step, clockwise seen from above."""
        self._spawned[slot].spin = spin_radps

    def set_constant(self, slot: int, velocity: Vector | None) -> None:
        """Keep a velocity in the vehicle's frame until the next call; None: stop keeping it."""
        self._spawned[slot].constant = velocity

    def ids(self) -> dict[int, int]:
        """Return the vehicle id of each slot in use; -1: the vehicle has not entered yet."""
        if not self._spawned:
            return {}
        ids = self._env.external.ids()
        return {slot: int(ids[slot]) for slot in self._spawned}

    def act(self) -> None:
        """Give the controls to the environment, for the next step."""
        rows = self._rows()
        for slot, one in self._spawned.items():
            row = rows.get(slot)
            if slot in self._posed:
                continue
            control = self.controls.get(slot)
            if row is not None and (one.constant or one.velocity or one.spin is not None):
                self._slide(slot, one, row, control)
            elif row is not None and one.walk is not None:
                self._step(slot, row, *one.walk)
            elif control is not None:
                self._drive(slot, one, row, control)
        self._posed.clear()

    def forget(self) -> None:
        """Forget all vehicles, after the end of an episode."""
        for slot in list(self._spawned):
            self._drop(slot)

    def _drop(self, slot: int) -> None:
        del self._spawned[slot]
        self.controls.pop(slot, None)

    def _rows(self) -> dict[int, np.void]:
        """Return the VEHICLE rows by slot."""
        if not self._spawned:
            return {}
        rows = self._env.simulation.vehicles(0)
        return {int(row["order"]): row for row in rows[rows["driver"] == DRIVER_EXTERNAL]}

    def _velocity_of(self, slot: int) -> Vector:
        row = self._rows().get(slot)
        if row is None:
            return 0.0, 0.0, 0.0
        speed, heading = float(row["speed"]), float(row["heading"])
        return speed * math.cos(heading), -speed * math.sin(heading), 0.0

    def _drive(self, slot: int, one: _Spawned, row: np.void | None, control: Control) -> None:
        speed = 0.0 if row is None else float(row["speed"])
        wheelbase_m = self._wheelbase_m(one)
        axles_apart = wheelbase_m / one.length_m
        if row is None or not drives_backward(control, speed):
            acceleration, angle = motion_of(control, speed)
            angle = same_turn(angle, axles_apart / WHEELBASE_SHARE)
            self._env.external.drive(slot, acceleration, angle)
            return
        # The environment drives vehicles forward only.
        acceleration, angle = backward_motion_of(control, speed)
        angle = same_turn(angle, axles_apart / WHEELBASE_SHARE)
        step_s = self._env.step_s
        x, y, heading, after, _ = self._bicycle_step(
            row["x"], row["y"], row["heading"], speed, acceleration, angle, wheelbase_m, step_s
        )
        self._pose(slot, x, y, heading, min(max(after, -_FASTEST_BACKWARD_MPS), 0.0))

    def _slide(self, slot: int, one: _Spawned, row: np.void, control: Control | None) -> None:
        """Move a vehicle by a velocity that a client has set."""
        step_s, heading = self._env.step_s, float(row["heading"])
        cos, sin = math.cos(heading), math.sin(heading)
        turn = 0.0
        if one.constant is not None:
            ahead, aside = one.constant[0], -one.constant[1]
            if control is not None:
                _, angle = motion_of(control, ahead)
                angle = same_turn(angle, self._wheelbase_m(one) / one.length_m / WHEELBASE_SHARE)
                still = (0.0, 0.0, 0.0, ahead, 0.0, angle, self._wheelbase_m(one), step_s)
                turn = float(self._bicycle_step(*still)[4]) * step_s
        else:
            east, north = (one.velocity or self._velocity_of(slot))[:2]
            ahead, aside = east * cos - north * sin, -east * sin - north * cos
            if control is None and one.vtype != WALKER:
                self.controls[slot] = CarlaControl()  # the vehicle keeps rolling
        if one.spin is not None:
            turn = -one.spin * step_s
        one.velocity = one.spin = None
        speed = math.hypot(ahead, aside)
        if speed > _FASTEST_MPS:
            ahead, aside = ahead * _FASTEST_MPS / speed, aside * _FASTEST_MPS / speed
        x = float(row["x"]) + (ahead * cos - aside * sin) * step_s
        y = float(row["y"]) + (ahead * sin + aside * cos) * step_s
        self._pose(slot, x, y, heading + turn, ahead)

    def _step(self, slot: int, row: np.void, direction: Vector, speed_mps: float) -> None:
        """Move a walker."""
        length = math.hypot(direction[0], direction[1])
        if length < 1e-6 or speed_mps <= 0.0:
            return
        speed = min(speed_mps, _FASTEST_MPS)
        east, north = direction[0] / length, -direction[1] / length
        reach_m = speed * self._env.step_s
        x, y = float(row["x"]) + east * reach_m, float(row["y"]) + north * reach_m
        self._pose(slot, x, y, math.atan2(north, east), speed)

    def _pose(self, slot: int, x: float, y: float, heading: float, speed: float) -> None:
        """Let a vehicle reach a pose in the next step; at the edge of the map, it stops."""
        try:
            self._env.external.pose(slot, x, y, heading, speed=speed)
        except ActionError:
            one = self._spawned[slot]
            one.walk = one.constant = None
            self.controls.pop(slot, None)

    def _wheelbase_m(self, one: _Spawned) -> float:
        simulation = self._env.simulation
        return float(simulation.types["wheelbase"][simulation.type_rows[one.vtype]])
