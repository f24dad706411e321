"""`ActorTable`: the actors of an episode: the spectator, traffic lights, vehicles and sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import CLASS_PEDESTRIAN, DRIVER_EXTERNAL
from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_blueprints import (
    BLUEPRINT_OF_CLASS,
    BLUEPRINTS,
    PROP,
    WALKER,
    Blueprint,
)
from cavmarl.cosim.carla.carla_geometry import ZERO, CarlaPose, Vector, axes_of, compose
from cavmarl.cosim.carla.carla_map import CarlaMap
from cavmarl.cosim.carla.carla_snapshots import (
    ACTIVE,
    ACTOR_STATE,
    LIGHT_STATE,
    VEHICLE_STATE,
    WALKER_STATE,
    place_state,
)
from cavmarl.cosim.carla.external_vehicles import ExternalBody
from cavmarl.cosim.carla.hosted_world import HostedWorld
from cavmarl.cosim.carla.vehicle_controls import (
    BRAKE_MPS2,
    FULL_STEER_RAD,
    THROTTLE_MPS2,
    AckermannControl,
    CarlaControl,
)
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.sensors.kernels.panorama import (
    BICYCLE,
    BUS,
    CAR,
    MOTORCYCLE,
    PEDESTRIAN,
    SEMANTIC_OF_CLASS,
    TRAM,
    TRUCK,
)

SPECTATOR_POSE = CarlaPose(0.0, 0.0, 50.0, -90.0, 0.0, 0.0)
AT_LIGHT_M = 14.0  # a vehicle whose centre is this close to its stop line is at the light
LIGHT_TAG = 7
PROP_TAG = 21  # CARLA's "dynamic": objects that may change their place
TAG_OF_CLASS = {
    CAR: 14,
    TRUCK: 15,
    BUS: 16,
    TRAM: 17,
    MOTORCYCLE: 18,
    BICYCLE: 19,
    PEDESTRIAN: 12,
}
TAG_OF_BASE = {
    "car": 14, "van": 14, "truck": 15, "bus": 16, "motorcycle": 18, "bicycle": 19,
    WALKER: 12, PROP: PROP_TAG,
}  # fmt: skip
_CLASS_NAMES = {**dict(enumerate(VEHICLE_CLASSES)), CLASS_PEDESTRIAN: "pedestrian"}


@dataclass
class CarlaActor:
    """One actor.

    Attributes:
        number: CARLA's id of the actor; `parent`: that of its parent, or 0.
        attributes: values by name; kinds as in the blueprint.
        pose: the current pose; for vehicles and walkers, see `ActorTable.pose_of`.
        local: pose relative to the parent.
        centre, half_m: the bounding box in the actor's frame.
        vehicle: id of the row of a vehicle or walker; -1: none.
        agent: index of the agent that the vehicle belongs to; -1: none.
        slot: number of a vehicle that a client has spawned, see `ExternalVehicles`; -1: none.
    """

    number: int
    type_id: str
    pose: CarlaPose
    attributes: dict[str, str] = field(default_factory=dict)
    parent: int = 0
    local: CarlaPose | None = None
    centre: Vector = ZERO
    half_m: Vector = ZERO
    tags: bytes = b""
    token: bytes = b""
    velocity: Vector = ZERO
    vehicle: int = -1
    agent: int = -1
    slot: int = -1
    lights: int = 0

    @property
    def is_vehicle(self) -> bool:
        return self.type_id.startswith("vehicle.")

    @property
    def is_walker(self) -> bool:
        return self.type_id.startswith("walker.")

    @property
    def is_prop(self) -> bool:
        return self.type_id.startswith("static.")

    @property
    def is_attached(self) -> bool:
        """Whether this is a sensor or a controller."""
        return self.type_id.startswith(("sensor.", "controller."))

    def attribute(self, name: str) -> str:
        return self.attributes.get(name) or BLUEPRINTS[self.type_id].default(name)


class ActorTable:
    """The actors of one episode, and their states as records of a snapshot.

    `first_number`: number of the first actor, larger than all numbers of earlier episodes, because
    clients remember actors by their numbers. `next_number`: smallest number of a vehicle.
    `known`: actors, by vehicle id, that keep their numbers when these vehicles appear.
    """

    def __init__(
        self,
        world: HostedWorld,
        first_number: int,
        next_number: int = 0,
        known: Mapping[int, CarlaActor] | None = None,
    ) -> None:
        self._next = first_number
        self._known = known or {}
        self.actors: dict[int, CarlaActor] = {}
        self._by_vehicle: dict[int, CarlaActor] = {}
        self.spectator = self.add("spectator", SPECTATOR_POSE)
        self._light_states = self._make_lights(world.map)
        self._next = max(self._next, next_number)
        self._ids = np.zeros(0, np.int64)
        self._listed: list[CarlaActor] = []
        self._row_of: dict[int, int] = {}
        self._is_walker = self._is_prop = np.zeros(0, np.bool_)
        self._other_states = np.zeros(0, ACTOR_STATE)
        self.vehicle_states = np.zeros(0, VEHICLE_STATE)
        self.take(world)

    @property
    def next_number(self) -> int:
        """The number of the next actor."""
        return self._next

    def skip_to(self, number: int) -> None:
        """Do not give new actors numbers below this number."""
        self._next = max(self._next, number)

    @property
    def vehicles(self) -> list[CarlaActor]:
        """Vehicles and walkers, in the order of `vehicle_states`."""
        return self._listed

    @property
    def props(self) -> NDArray[np.int64]:
        """The ids (n,) of the rows of props."""
        return self._ids[self._is_prop]

    @property
    def lights(self) -> NDArray[np.void]:
        """LIGHT_STATE (approaches,)."""
        return self._light_states

    def add(self, type_id: str, pose: CarlaPose, **more: Any) -> CarlaActor:
        """Add an actor with the next number."""
        actor = CarlaActor(self._next, type_id, pose, **more)
        self.actors[actor.number] = actor
        self._next += 1
        return actor

    def find(self, number: int, call: str) -> CarlaActor:
        """Return an actor; raise CallRefused, with CARLA's text, if there is none."""
        actor = self.actors.get(number)
        if actor is None:
            raise CallRefused(
                f"Responding error from function {call}: Actor could not be found in the registry. "
                f"Actor Id: {number}"
            )
        return actor

    def remove(self, number: int) -> list[CarlaActor]:
        """Remove an actor and all actors attached to it; return the removed actors."""
        actor = self.actors.pop(number, None)
        if actor is None:
            return []
        self._by_vehicle.pop(actor.vehicle, None)
        removed = [actor]
        for child in [one.number for one in self.actors.values() if one.parent == number]:
            removed += self.remove(child)
        return removed

    def of_vehicle(self, vehicle: int) -> CarlaActor | None:
        """Return the actor of a vehicle's id."""
        return self._by_vehicle.get(vehicle)

    def state_of(self, actor: CarlaActor) -> np.void | None:
        """Return the VEHICLE_STATE of a vehicle or walker; None for other actors."""
        row = self._row_of.get(actor.number)
        return None if row is None else self.vehicle_states[row]

    def pose_of(self, actor: CarlaActor) -> CarlaPose:
        state = self.state_of(actor)
        if state is None:
            return actor.pose
        return CarlaPose(*state["place"].tolist(), *state["turn"].tolist())

    def of_agent(self, agent: int) -> CarlaActor | None:
        """Return the actor of an agent's vehicle at the last call of `take`."""
        return next((actor for actor in self._listed if actor.agent == agent), None)

    def spawned(self) -> Iterator[CarlaActor]:
        """Yield the actors that clients have spawned."""
        yield from self.attached()
        yield from (actor for actor in self.actors.values() if actor.slot >= 0)

    def add_spawned(
        self,
        blueprint: Blueprint,
        attributes: dict[str, str],
        pose: CarlaPose,
        slot: int,
        size_m: tuple[float, float, float],
    ) -> CarlaActor:
        """Add a vehicle, walker or prop that enters in the next tick."""
        length, width, height = size_m
        base_type = blueprint.base_type
        return self.add(
            blueprint.type_id,
            pose,
            attributes=dict(attributes),
            centre=(0.0, 0.0, 0.0 if base_type == WALKER else 0.5 * height),
            half_m=(0.5 * length, 0.5 * width, 0.5 * height),
            tags=bytes([TAG_OF_BASE[base_type]]),
            slot=slot,
        )

    def keep_spawned(self, world: HostedWorld, before: ActorTable) -> list[CarlaActor]:
        """Take over the actors that clients have spawned into an earlier world of the same map.

        Return the actors that could not be kept: their places are occupied, or their parents gone.
        """
        self.spectator.pose = before.spectator.pose
        gone = []
        for actor in before.actors.values():
            if actor.slot >= 0:
                state = before.state_of(actor)
                pose, speed = before.pose_of(actor), 0.0
                if state is not None:
                    speed = float(state["velocity"] @ axes_of(pose)[:, 0])
                base_type = BLUEPRINTS[actor.type_id].base_type
                length, width, height = (2.0 * half for half in actor.half_m)
                body = ExternalBody(actor.type_id, base_type, pose, (length, width, height), speed)
                try:
                    actor.slot, _ = world.external.spawn(body)
                except CallRefused:
                    gone.append(actor)
                    continue
                actor.pose, actor.vehicle = pose, -1
            elif not actor.is_attached:
                continue
            elif actor.parent and actor.parent not in self.actors:
                gone.append(actor)
                continue
            self.actors[actor.number] = actor
        return gone

    def attached(self) -> Iterator[CarlaActor]:
        """Yield sensors and controllers."""
        for actor in self.actors.values():
            if actor.is_attached:
                yield actor

    def take(self, world: HostedWorld) -> list[CarlaActor]:
        """Take over the current state of a world; return the removed actors."""
        rows = world.rows
        gone: list[CarlaActor] = []
        if not np.array_equal(rows["id"], self._ids):
            gone = self._list(world, rows)
        self._write_vehicles(world, rows)
        self._write_lights(world)
        for actor in self.attached():
            self.move_attached(actor)
        return gone

    def move_attached(self, actor: CarlaActor) -> None:
        """Move an attached actor with its parent."""
        parent = self.actors.get(actor.parent)
        if parent is not None and actor.local is not None:
            actor.pose = compose(self.pose_of(parent), actor.local)
            state = self.state_of(parent)
            actor.velocity = parent.velocity if state is None else tuple(state["velocity"].tolist())

    def states(self) -> list[NDArray[np.void]]:
        """Return the records of all actors."""
        others = [
            actor for actor in self.actors.values() if actor.vehicle < 0 and actor.tags != _LIGHT
        ]
        if len(others) != len(self._other_states):
            self._other_states = np.zeros(len(others), ACTOR_STATE)
            self._other_states["state"] = ACTIVE
        for state, actor in zip(self._other_states, others, strict=True):
            state["id"] = actor.number
            place_state(state, actor.pose)
            state["velocity"] = actor.velocity
        return [self._other_states, self._light_states, self.vehicle_states]

    def _make_lights(self, carla_map: CarlaMap) -> NDArray[np.void]:
        states = np.zeros(len(carla_map.approaches), LIGHT_STATE)
        for state, approach in zip(states, carla_map.approaches, strict=True):
            centre, half_m = approach.box
            actor = self.add("traffic.traffic_light", approach.pose, tags=_LIGHT)
            actor.centre = (centre[0], centre[1], centre[2])
            actor.half_m = (half_m[0], half_m[1], half_m[2])
            state["id"] = actor.number
            state["pole"] = approach.pole
            state["signal_id"] = approach.signal_id.encode()[:31]
            place_state(state, approach.pose)
        states["state"] = ACTIVE
        return states

    def _write_lights(self, world: HostedWorld) -> None:
        states = self._light_states
        if not len(states):
            return
        states["light_state"] = world.light_states()
        states["elapsed_s"] = world.lights.elapsed_s
        states["times_s"] = world.lights.times_s
        states["is_frozen"] = world.lights.is_frozen

    def _list(self, world: HostedWorld, rows: NDArray[np.void]) -> list[CarlaActor]:
        """List the actors of the rows; return those whose vehicle has left."""
        present = set(rows["id"].tolist())
        gone: list[CarlaActor] = []
        ids = world.external.ids()
        for actor in [one for one in self.actors.values() if one.slot >= 0]:
            vehicle = ids.get(actor.slot, -1)
            if actor.vehicle != vehicle:  # the vehicle has entered, or has a new id after a jump
                self._by_vehicle.pop(actor.vehicle, None)
                actor.vehicle = vehicle
                if vehicle >= 0:
                    self._by_vehicle[vehicle] = actor
            if actor.slot not in ids:
                gone += self.remove(actor.number)
        for vehicle in [one for one in self._by_vehicle if one not in present]:
            gone += self.remove(self._by_vehicle[vehicle].number)
        self._listed = [
            self._by_vehicle.get(int(row["id"])) or self._add_vehicle(world, row) for row in rows
        ]
        self._ids = rows["id"].copy()
        self._row_of = {actor.number: k for k, actor in enumerate(self._listed)}
        self._is_walker = np.array([actor.is_walker for actor in self._listed], np.bool_)
        self._is_prop = np.array([actor.is_prop for actor in self._listed], np.bool_)
        self.vehicle_states = np.zeros(len(rows), VEHICLE_STATE)
        self.vehicle_states["state"] = ACTIVE
        self.vehicle_states["id"] = list(self._row_of)
        return gone

    def _add_vehicle(self, world: HostedWorld, row: np.void) -> CarlaActor:
        known = self._known.get(int(row["id"]))
        if known is not None:
            self.actors[known.number] = self._by_vehicle[known.vehicle] = known
            return known
        vclass = int(world.simulation.types["vclass"][row["vtype"]])
        semantic = SEMANTIC_OF_CLASS[_CLASS_NAMES[vclass]]
        agent = int(row["agent"])
        type_id = BLUEPRINT_OF_CLASS[semantic]
        length, width, height = (float(row[name]) for name in ("length", "width", "height"))
        up = 0.0 if semantic == PEDESTRIAN else 0.5 * height
        actor = self.add(
            type_id,
            CarlaPose(0.0, 0.0, 0.0),
            attributes={one.name: one.default for one in BLUEPRINTS[type_id].attributes},
            centre=(0.0, 0.0, up),
            half_m=(0.5 * length, 0.5 * width, 0.5 * height),
            tags=bytes([TAG_OF_CLASS[semantic]]),
            vehicle=int(row["id"]),
            agent=agent,
        )
        actor.attributes["role_name"] = f"car_{agent}" if agent >= 0 else "background"
        self._by_vehicle[actor.vehicle] = actor
        return actor

    def _write_vehicles(self, world: HostedWorld, rows: NDArray[np.void]) -> None:
        states = self.vehicle_states
        if not len(states):
            return
        heading, pitch, speed, accel = (
            rows[name] for name in ("heading", "pitch", "speed", "accel")
        )
        level = np.cos(pitch)
        ahead = np.stack([np.cos(heading) * level, -np.sin(heading) * level, np.sin(pitch)], axis=1)
        aside = np.stack([np.sin(heading), np.cos(heading), np.zeros(len(rows))], axis=1)
        lift = np.where(self._is_walker, 0.5 * rows["height"], 0.0)
        states["place"] = np.stack([rows["x"], -rows["y"], rows["z"] + lift], axis=1)
        states["turn"][:, 0] = np.degrees(pitch)
        states["turn"][:, 1] = -np.degrees(heading)
        states["velocity"] = ahead * speed[:, None]
        states["spin"][:, 2] = -np.degrees(rows["yaw_rate"])
        turning = speed * rows["yaw_rate"]  # acceleration to the left
        states["acceleration"] = ahead * accel[:, None] - aside * turning[:, None]
        states["throttle"] = np.clip(accel / THROTTLE_MPS2, 0.0, 1.0)
        states["brake"] = np.clip(-accel / BRAKE_MPS2, 0.0, 1.0)
        states["steer"] = np.clip(-rows["steering"] / FULL_STEER_RAD, -1.0, 1.0)
        states["gear"] = 1
        self._write_lanes(world, rows)
        for k in np.flatnonzero(rows["agent"] >= 0).tolist():
            self._write_control(states[k], world.controls.get(int(rows["agent"][k])))
        for k in np.flatnonzero(rows["driver"] == DRIVER_EXTERNAL).tolist():
            self._write_control(states[k], world.external.controls.get(int(rows["order"][k])))
        raw = states.view(np.uint8).reshape(len(states), -1)
        raw[self._is_walker | self._is_prop, _FIRST_OWN_BYTE:] = 0
        self._write_walkers(ahead, speed)

    def _write_lanes(self, world: HostedWorld, rows: NDArray[np.void]) -> None:
        """Write the current speed limit and the traffic light of each vehicle's lane."""
        states, lanes = self.vehicle_states, world.present_lanes
        lane = rows["lane"]
        states["speed_limit"] = 3.6 * lanes["speed_mps"][lane]
        approach = world.map.approach_of_lane[lane]
        left = lanes["length_m"][lane] - rows["s"]
        at = (approach >= 0) & (left < AT_LIGHT_M)
        states["is_at_light"] = at
        if len(self._light_states):
            lights = self._light_states[approach]
            states["light"] = np.where(at, lights["id"], 0)
            states["light_state"] = np.where(at, lights["light_state"], 2)

    @staticmethod
    def _write_control(state: np.void, control: CarlaControl | AckermannControl | None) -> None:
        if isinstance(control, CarlaControl):
            state["throttle"], state["steer"], state["brake"] = control[:3]
            state["hand_brake"], state["reverse"], state["manual_gear"] = control[3:6]
            automatic = -1 if control.reverse else 1
            state["gear"] = control.gear if control.manual_gear_shift else automatic

    def _write_walkers(self, ahead: NDArray[np.float64], speed: NDArray[np.float64]) -> None:
        if not self._is_walker.any():
            return
        walkers = self.vehicle_states.view(WALKER_STATE)
        walkers["direction"][self._is_walker] = ahead[self._is_walker]
        walkers["speed"][self._is_walker] = speed[self._is_walker]


_LIGHT = bytes([LIGHT_TAG])
_FIRST_OWN_BYTE = 65  # byte of a record from which the content depends on the actor's type
