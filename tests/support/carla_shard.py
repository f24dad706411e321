"""A backend on the client of CARLA 0.9.16, and a fake of that client: no CARLA server was run.

The adapter calls what that client's reference documents, so that the protocol of backends is seen
to be enough for such a simulator. CARLA's frames are left-handed: y and yaw change their signs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.shards.shard_backend import VehicleControl

FULL_THROTTLE_MPS2, FULL_BRAKE_MPS2 = 4.0, 8.0
FULL_STEER_RAD = math.radians(70.0)


@dataclass
class Vector3D:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Rotation:
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


@dataclass
class Transform:
    location: Vector3D
    rotation: Rotation


@dataclass
class CarlaControl:  # carla.VehicleControl
    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0


@dataclass
class WorldSettings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float | None = None


@dataclass
class FakeActor:
    world: FakeCarlaWorld
    id: int
    transform: Transform
    speed: float = 0.0
    control: CarlaControl = field(default_factory=CarlaControl)
    has_physics: bool = True

    def get_transform(self) -> Transform:
        return self.transform

    def set_transform(self, transform: Transform) -> None:
        self.transform = transform

    def get_velocity(self) -> Vector3D:
        yaw = math.radians(self.transform.rotation.yaw)
        return Vector3D(self.speed * math.cos(yaw), self.speed * math.sin(yaw))

    def set_target_velocity(self, velocity: Vector3D) -> None:
        self.speed = math.hypot(velocity.x, velocity.y)

    def apply_control(self, control: CarlaControl) -> None:
        self.control = control

    def set_simulate_physics(self, enabled: bool) -> None:
        self.has_physics = enabled

    def destroy(self) -> bool:
        return self.world.actors.pop(self.id, None) is not None


class FakeCarlaWorld:
    """A world of actors that drive straight on."""

    def __init__(self) -> None:
        self.actors: dict[int, FakeActor] = {}
        self.settings = WorldSettings()
        self.frame = 0
        self._next = 100

    def get_settings(self) -> WorldSettings:
        return replace(self.settings)

    def apply_settings(self, settings: WorldSettings) -> int:
        self.settings = settings
        return self.frame

    def try_spawn_actor(self, blueprint: str, transform: Transform) -> FakeActor | None:
        for actor in self.actors.values():
            at, here = actor.transform.location, transform.location
            if math.hypot(at.x - here.x, at.y - here.y) < 1.0:
                return None  # it would stand in another
        self._next += 1
        actor = self.actors[self._next] = FakeActor(self, self._next, transform)
        return actor

    def tick(self) -> int:
        dt = self.settings.fixed_delta_seconds
        assert self.settings.synchronous_mode
        assert dt is not None
        for actor in self.actors.values():
            if actor.has_physics:
                accel = FULL_THROTTLE_MPS2 * actor.control.throttle
                accel -= FULL_BRAKE_MPS2 * actor.control.brake
                actor.speed = max(0.0, actor.speed + accel * dt)
                velocity = actor.get_velocity()
                actor.transform.location.x += velocity.x * dt
                actor.transform.location.y += velocity.y * dt
        self.frame += 1
        return self.frame


class CarlaShard:
    """A `ShardBackend` on a world of CARLA: what it does not have, the records keep as it was."""

    reach_m = 50.0

    def __init__(self, world: Any, zone: int, dt_s: float) -> None:
        self.zone = zone
        self._world = world
        self._tick = 0
        self._own: dict[int, tuple[NDArray[np.void], Any]] = {}
        self._ghosts: dict[int, Any] = {}
        settings = world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, dt_s
        world.apply_settings(settings)

    def reset(self, seed: int) -> None:
        self.destroy([*self._own])
        self.remove_ghosts([*self._ghosts])
        self._tick = 0

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        for row in vehicles:
            number = int(row["id"])
            if number in self._own or number in self._ghosts:
                raise ConfigError(f"vehicle {number}: is in zone {self.zone} already")
            actor = self._place(row)
            actor.set_target_velocity(_velocity(row))
            self._own[number] = row.copy(), actor

    def destroy(self, vehicles: Sequence[int]) -> None:
        self._check_owned(vehicles)
        for number in vehicles:
            self._own.pop(number)[1].destroy()

    def apply_controls(self, controls: Mapping[int, VehicleControl]) -> None:
        self._check_owned(controls)
        for number, control in controls.items():
            wanted = control.acceleration_mps2
            throttle = min(max(wanted / FULL_THROTTLE_MPS2, 0.0), 1.0)
            brake = min(max(-wanted / FULL_BRAKE_MPS2, 0.0), 1.0)
            steer = min(max(-control.steering_rad / FULL_STEER_RAD, -1.0), 1.0)
            self._own[number][1].apply_control(CarlaControl(throttle, steer, brake))

    def advance(self) -> None:
        self._world.tick()
        self._tick += 1

    def upsert_ghosts(self, vehicles: NDArray[np.void]) -> None:
        for row in vehicles:
            number = int(row["id"])
            if number in self._own:
                raise ConfigError(f"vehicle {number}: is owned by zone {self.zone}")
            if number in self._ghosts:
                self._ghosts[number].set_transform(_transform(row))
                continue
            self._ghosts[number] = actor = self._place(row)
            actor.set_simulate_physics(False)

    def remove_ghosts(self, vehicles: Sequence[int]) -> None:
        for number in vehicles:
            if number in self._ghosts:
                self._ghosts.pop(number).destroy()

    def commit(self) -> int:
        return self._tick

    def read_vehicles(self) -> NDArray[np.void]:
        found = np.zeros(len(self._own), dtype=VEHICLE)
        for place, (row, actor) in enumerate(self._own.values()):
            at, velocity = actor.get_transform(), actor.get_velocity()
            found[place] = row
            found[place]["x"], found[place]["y"] = at.location.x, -at.location.y
            found[place]["z"] = at.location.z
            found[place]["heading"] = -math.radians(at.rotation.yaw)
            found[place]["speed"] = math.hypot(velocity.x, velocity.y)
        return found

    def read_sensors(self) -> dict[int, NDArray[np.float32]]:
        return {
            int(row["id"]): np.array([row["speed"]], dtype=np.float32)
            for row in self.read_vehicles()
            if row["agent"] >= 0
        }

    def snapshot(self) -> bytes:
        return self._tick.to_bytes(8) + self.read_vehicles().tobytes()

    def restore(self, data: bytes) -> None:
        self.reset(0)
        self._tick = int.from_bytes(data[:8])
        self.spawn(np.frombuffer(data[8:], VEHICLE))

    def _place(self, row: np.void) -> Any:
        actor = self._world.try_spawn_actor("vehicle.tesla.model3", _transform(row))
        if actor is None:
            raise ConfigError(f"vehicle {row['id']}: there is no room for it in zone {self.zone}")
        return actor

    def _check_owned(self, vehicles: Sequence[int] | Mapping[int, object]) -> None:
        for number in vehicles:
            if number not in self._own:
                raise ConfigError(f"vehicle {number}: zone {self.zone} does not own it")


def _transform(row: np.void) -> Transform:
    yaw = -math.degrees(row["heading"])
    return Transform(
        Vector3D(float(row["x"]), -float(row["y"]), float(row["z"])), Rotation(yaw=yaw)
    )


def _velocity(row: np.void) -> Vector3D:
    heading, speed = -float(row["heading"]), float(row["speed"])
    return Vector3D(speed * math.cos(heading), speed * math.sin(heading))
