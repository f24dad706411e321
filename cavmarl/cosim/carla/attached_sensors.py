"""`SensorSuite`: the sensors that clients attach while a world runs, and their frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import EVENT_COLLIDED
from cavmarl.cosim.carla.attached_imaging import (
    DepthCameraSensor,
    InstanceCameraSensor,
    LidarSensor,
    RadarSensor,
    RgbCameraSensor,
    SemanticCameraSensor,
    SemanticLidarSensor,
)
from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_geodesy import geolocation
from cavmarl.cosim.carla.carla_geometry import axes_of
from cavmarl.cosim.carla.carla_records import packed_actor
from cavmarl.cosim.carla.carla_streams import StreamHub
from cavmarl.cosim.carla.optical_flow_camera import OpticalFlowCamera
from cavmarl.cosim.carla.rpc_messages import pack
from cavmarl.cosim.carla.sensor_settings import SensorContext, SensorSettings

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_session import CarlaSession

GRAVITY_MPS2 = 9.81
_SOON_S = 1e-6  # a sample that is due within this time is taken now
_FIRST_STREAM = 2
_LISTENERS_DUE_S = 1.0  # clients listen to a new sensor within this time
_IMPULSE_PER_MPS = 1500.0  # kg: impulse of a collision per m/s of difference in speed


class AttachedSensor(Protocol):
    """A sensor of a client."""

    kind: ClassVar[int]  # number of the sensor in the client's registry

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes | None:
        """Return the body of a frame, or None if there is nothing to report.

        `elapsed_s`: time since the last sample, or since the last tick.
        """
        ...


class GnssSensor:
    """Latitude, longitude and altitude."""

    kind: ClassVar[int] = 4

    def __init__(self, settings: SensorSettings) -> None:
        names = ("lat", "lon", "alt")
        self._bias = np.array([settings.number(f"noise_{name}_bias") for name in names])
        self._noise = np.array([settings.number(f"noise_{name}_stddev", 0.0) for name in names])
        self._random = settings.generator()

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        pose = actor.pose
        session = context.session
        degrees = geolocation(session.map.origin, pose.x, pose.y, session.version.is_mercator)
        measured = np.array([*degrees, pose.z])
        return pack((measured + self._bias + self._noise * self._random.normal(size=3)).tolist())


class ImuSensor:
    """Specific force, rotation rate, and the direction to the north."""

    kind: ClassVar[int] = 5

    def __init__(self, settings: SensorSettings) -> None:
        def per_axis(name: str, low: float = -math.inf) -> NDArray[np.float64]:
            return np.array([settings.number(f"noise_{name}_{axis}", low) for axis in "xyz"])

        self._accel_noise = per_axis("accel_stddev", 0.0)
        self._gyro_noise, self._gyro_bias = per_axis("gyro_stddev", 0.0), per_axis("gyro_bias")
        self._random = settings.generator()

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes:
        force, spin = np.array([0.0, 0.0, GRAVITY_MPS2]), np.zeros(3)
        actors = context.session.actors
        parent = actors.actors.get(actor.parent)
        state = None if parent is None else actors.state_of(parent)
        if state is not None:
            force += state["acceleration"]
            spin += np.radians(state["spin"])
        axes = axes_of(actor.pose)
        accel = axes.T @ force + self._accel_noise * self._random.normal(size=3)
        gyro = axes.T @ spin + self._gyro_bias + self._gyro_noise * self._random.normal(size=3)
        compass = math.atan2(axes[0, 0], -axes[1, 0]) % (2.0 * math.pi)
        return pack([accel.tolist(), gyro.tolist(), compass])


class CollisionSensor:
    """Contacts of the parent with another vehicle, a walker or a prop."""

    kind: ClassVar[int] = 0

    def __init__(self, settings: SensorSettings) -> None:
        pass

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes | None:
        session = context.session
        parent = session.actors.actors.get(actor.parent)
        if parent is None or parent.vehicle < 0:
            return None
        rows = session.world.rows
        found = np.flatnonzero(
            (rows["id"] == parent.vehicle) & (rows["events"] & EVENT_COLLIDED > 0)
        )
        if not len(found):
            return None
        other = session.actors.of_vehicle(int(rows["hit"][found[0]]))
        return collision_body(session, parent, other)


def collision_body(
    session: CarlaSession, actor: CarlaActor, other: CarlaActor | None
) -> bytes | None:
    """Return the body of a collision's frame; None if the other vehicle is unknown."""
    if other is None:
        return None
    own, its = session.actors.state_of(actor), session.actors.state_of(other)
    if own is None or its is None:
        return None
    impulse = (_IMPULSE_PER_MPS * (its["velocity"] - own["velocity"])).tolist()
    version = session.version
    return pack([packed_actor(actor, version), packed_actor(other, version), impulse])


class ObstacleSensor:
    """The nearest vehicle ahead within a tube."""

    kind: ClassVar[int] = 7

    def __init__(self, settings: SensorSettings) -> None:
        self._distance_m = settings.number("distance", 0.0, 1000.0)
        self._radius_m = settings.number("hit_radius", 0.0, 100.0)

    def sense(self, context: SensorContext, actor: CarlaActor, elapsed_s: float) -> bytes | None:
        session = context.session
        parent = session.actors.actors.get(actor.parent)
        states = session.actors.vehicle_states
        if parent is None or not len(states):
            return None
        rows = session.world.rows
        half = 0.5 * np.stack([rows["length"], rows["width"]], axis=1)
        yaw = np.radians(states["turn"][:, 1] - actor.pose.yaw)
        axes = axes_of(actor.pose)
        relative = states["place"] - np.array(actor.pose.place)
        ahead, aside = relative @ axes[:, 0], relative @ axes[:, 1]
        along = np.abs(np.cos(yaw)) * half[:, 0] + np.abs(np.sin(yaw)) * half[:, 1]
        across = np.abs(np.sin(yaw)) * half[:, 0] + np.abs(np.cos(yaw)) * half[:, 1]
        gaps = np.where(
            (np.abs(aside) < across + self._radius_m) & (ahead > 0.0), ahead - along, np.inf
        )
        gaps[states["id"] == parent.number] = np.inf
        nearest = int(gaps.argmin())
        if gaps[nearest] > self._distance_m:
            return None
        version = session.version
        other = packed_actor(session.actors.vehicles[nearest], version)
        return pack([packed_actor(parent, version), other, max(0.0, float(gaps[nearest]))])


Make = Callable[[SensorSettings], AttachedSensor]

_SENSORS: dict[str, Make] = {
    "sensor.camera.rgb": RgbCameraSensor,
    "sensor.camera.depth": DepthCameraSensor,
    "sensor.camera.semantic_segmentation": SemanticCameraSensor,
    "sensor.camera.instance_segmentation": InstanceCameraSensor,
    "sensor.camera.optical_flow": OpticalFlowCamera,
    "sensor.lidar.ray_cast": LidarSensor,
    "sensor.lidar.ray_cast_semantic": SemanticLidarSensor,
    "sensor.other.radar": RadarSensor,
    "sensor.other.collision": CollisionSensor,
    "sensor.other.gnss": GnssSensor,
    "sensor.other.imu": ImuSensor,
    "sensor.other.obstacle": ObstacleSensor,
}
# The client computes these from the map and from snapshots.
_OF_THE_CLIENT = ("sensor.other.lane_invasion", "controller.ai.walker")


@dataclass
class _Mounted:
    actor: CarlaActor
    sensor: AttachedSensor
    stream: int
    every_s: float
    due_s: float = 0.0
    last_s: float | None = None
    is_heard: bool = False  # whether a client has listened to the sensor
    added_wall_s: float = field(default_factory=time.monotonic)


class SensorSuite:
    """All sensors of a session. `streams`: the streams to which clients listen."""

    def __init__(self, session: CarlaSession, streams: StreamHub) -> None:
        self._context = SensorContext(session)
        self._streams = streams
        self._mounted: dict[int, _Mounted] = {}
        self._next_stream = _FIRST_STREAM
        self._added = 0  # number of sensors added in this episode

    def begin_episode(self) -> None:
        """Give the next sensors the same random numbers as in the first episode."""
        self._added = 0

    def add(self, actor: CarlaActor) -> None:
        """Mount the sensor of a new actor; raise CallRefused if an attribute is invalid."""
        if actor.type_id in _OF_THE_CLIENT:
            return
        settings = SensorSettings(actor, self._added)
        self._added += 1
        every_s = settings.number("sensor_tick", 0.0, 1e6)
        sensor = _SENSORS[actor.type_id](settings)
        self._mounted[actor.number] = _Mounted(actor, sensor, self._next_stream, every_s)
        actor.token = self._streams.token(self._next_stream)
        self._next_stream += 1

    def remove(self, actor: CarlaActor) -> None:
        """End the sensor of an actor and its stream, if it has one."""
        mounted = self._mounted.pop(actor.number, None)
        if mounted is not None:
            self._streams.end(mounted.stream)

    def await_listeners(self) -> None:
        """Restart the time in which `are_listeners_due` expects listeners of new sensors.

        The restart of a world may have taken longer than that time.
        """
        for mounted in self._mounted.values():
            mounted.added_wall_s = time.monotonic()

    def are_listeners_due(self) -> bool:
        """Return whether a client may be about to listen to a sensor that it has just spawned."""
        now_s = time.monotonic()
        for mounted in self._mounted.values():
            mounted.is_heard = mounted.is_heard or self._streams.is_wanted(mounted.stream)
            if not mounted.is_heard and now_s - mounted.added_wall_s < _LISTENERS_DUE_S:
                return True
        return False

    def last_collisions(self, actor: CarlaActor) -> Iterator[tuple[int, CarlaActor, int, bytes]]:
        """Yield frames of a vehicle that leaves the world after a collision; see `sense`.

        The other vehicle is taken to be the nearest vehicle.
        """
        session = self._context.session
        states = session.actors.vehicle_states
        own = session.actors.state_of(actor)
        assert own is not None
        apart = np.linalg.norm(states["place"] - own["place"], axis=1)
        apart[states["id"] == actor.number] = np.inf
        other = session.actors.vehicles[int(apart.argmin())]
        body = collision_body(session, actor, other)
        for mounted in self._mounted.values():
            is_own = mounted.actor.parent == actor.number
            if is_own and isinstance(mounted.sensor, CollisionSensor) and body is not None:
                yield mounted.stream, mounted.actor, mounted.sensor.kind, body

    def sense(self) -> Iterator[tuple[int, CarlaActor, int, bytes]]:
        """Yield stream, actor, kind and body of each frame that is due and has a listener."""
        session = self._context.session
        for mounted in list(self._mounted.values()):
            now_s = session.time_s
            if now_s + _SOON_S < mounted.due_s or not self._streams.is_wanted(mounted.stream):
                continue
            if mounted.last_s is None:
                mounted.last_s, mounted.due_s = now_s - session.delta_s, now_s
            elapsed_s = now_s - mounted.last_s
            mounted.last_s = now_s
            mounted.due_s = max(mounted.due_s + mounted.every_s, now_s)
            body = mounted.sensor.sense(self._context, mounted.actor, elapsed_s)
            if body is not None:
                yield mounted.stream, mounted.actor, mounted.sensor.kind, body
