"""Calls about actors: vehicles, walkers and sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cavmarl.cosim.carla.call_arguments import (
    CallRefused,
    Check,
    actor_id,
    anything,
    flag,
    listed,
    number,
    place,
    pose,
    record_of,
    text,
    vector,
    whole,
)
from cavmarl.cosim.carla.call_table import (
    Caller,
    Returns,
    accept,
    answer_constant,
    answer_from,
    call,
    refuse,
)
from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_geometry import CarlaPose, Vector, compose, relative
from cavmarl.cosim.carla.carla_records import packed_actor, packed_box
from cavmarl.cosim.carla.carla_session import CarlaSession
from cavmarl.cosim.carla.external_vehicles import MASS_KG
from cavmarl.cosim.carla.vehicle_controls import (
    FULL_STEER_RAD,
    AckermannControl,
    CarlaControl,
    Control,
)

_MAX_ATTRIBUTES = 256
_SPAWNED = "vehicles and walkers that clients have spawned"
_WORLDS = "vehicles of the world move by themselves; spawn a vehicle to place it"
_KINEMATIC = "vehicles are kinematic: they have no mass"
_NO_BONES = "walkers have no bones"

description = record_of(whole, text, listed(record_of(text, whole, text), most=_MAX_ATTRIBUTES))
vehicle_control = record_of(number, number, number, flag, flag, flag, whole)
ackermann_control = record_of(number, number, number, number, number)
walker_control = record_of(vector, number, flag)
light_mask = record_of(whole)
_DEFAULT_ACKERMANN = [0.15, 0.0, 0.25, 0.01, 0.0, 0.01]
_WHEELS_CM = ((145.0, -80.0, 70.0), (145.0, 80.0, 70.0), (-145.0, -80.0, 0.0), (-145.0, 80.0, 0.0))


@call("get_actors_by_id", listed(actor_id))
def get_actors_by_id(caller: Caller, session: CarlaSession, ids: list[int]) -> list[Any]:
    actors = session.actors.actors
    return [packed_actor(actors[one], session.version) for one in ids if one in actors]


@call(
    "spawn_actor",
    description,
    pose,
    note="vehicles, walkers, props and sensors; they enter in the next tick, sensors at once",
)
def spawn_actor(
    caller: Caller, session: CarlaSession, what: tuple[Any, ...], there: CarlaPose
) -> list[Any]:
    return packed_actor(spawn(session, what, there, 0), session.version)


@call(
    "spawn_actor_with_parent",
    description,
    pose,
    actor_id,
    whole,
    text,
    required=3,
    note="each attachment is rigid",
)
def spawn_actor_with_parent(
    caller: Caller,
    session: CarlaSession,
    what: tuple[Any, ...],
    there: CarlaPose,
    parent: int,
    attachment: int = 0,
    socket: str = "",
) -> list[Any]:
    return packed_actor(spawn(session, what, there, parent), session.version)


def spawn(
    session: CarlaSession, what: tuple[Any, ...], there: CarlaPose, parent: int
) -> CarlaActor:
    _, type_id, attributes = what
    values = {name: value for name, _, value in attributes}
    return session.spawn(type_id, values, there, parent)


@call("destroy_actor", actor_id, note="vehicles of the world cannot be destroyed")
def destroy_actor(caller: Caller, session: CarlaSession, number: int) -> bool:
    session.destroy(number)
    return True


@call(
    "set_actor_transform",
    actor_id,
    pose,
    returns=Returns.NOTHING,
    note="the spectator, sensors, and vehicles and walkers that clients have spawned",
)
def set_actor_transform(
    caller: Caller, session: CarlaSession, number: int, there: CarlaPose
) -> None:
    actor = session.actors.find(number, "set_actor_transform")
    _move(session, actor, there)


@call("set_actor_location", actor_id, place, returns=Returns.NOTHING, note="as set_actor_transform")
def set_actor_location(
    caller: Caller, session: CarlaSession, number: int, there: tuple[float, float, float]
) -> None:
    actor = session.actors.find(number, "set_actor_location")
    _move(session, actor, session.actors.pose_of(actor).at(there))


@call(
    "set_walker_state",
    actor_id,
    pose,
    number,
    returns=Returns.NOTHING,
    note="in batches only; the pose is on the ground",
)
def set_walker_state(
    caller: Caller, session: CarlaSession, number: int, there: CarlaPose, speed: float
) -> None:
    actor = _walker(session, number, "set_walker_state")
    _move(session, actor, there.at((there.x, there.y, there.z + actor.half_m[2])))


@call(
    "apply_control_to_walker",
    actor_id,
    walker_control,
    returns=Returns.NOTHING,
    note="walkers that clients have spawned; they cannot jump",
)
def apply_control_to_walker(
    caller: Caller, session: CarlaSession, number: int, given: tuple[Any, ...]
) -> None:
    actor = _walker(session, number, "apply_control_to_walker")
    direction, speed, _ = given
    session.world.external.walk(actor.slot, direction, speed)


def _walker(session: CarlaSession, number: int, name: str) -> CarlaActor:
    actor = session.actors.find(number, name)
    if not actor.is_walker:
        raise CallRefused(f"{actor.type_id} is not a walker")
    if actor.slot < 0:
        raise CallRefused("walkers of the world move by their script")
    return actor


def _spawned(session: CarlaSession, number: int, name: str) -> int:
    """Return the slot of a vehicle or walker that a client has spawned."""
    actor = session.actors.find(number, name)
    if actor.slot < 0:
        raise CallRefused(_WORLDS)
    return actor.slot


@call(
    "set_actor_target_velocity",
    actor_id,
    vector,
    returns=Returns.NOTHING,
    note=f"{_SPAWNED}, in the next tick; then they follow their control, or roll on",
)
def set_actor_target_velocity(
    caller: Caller, session: CarlaSession, number: int, velocity: tuple[float, float, float]
) -> None:
    slot = _spawned(session, number, "set_actor_target_velocity")
    session.world.external.set_velocity(slot, velocity)


@call(
    "set_actor_target_angular_velocity",
    actor_id,
    vector,
    returns=Returns.NOTHING,
    note=f"{_SPAWNED}, in the next tick, about the vertical axis",
)
def set_actor_target_angular_velocity(
    caller: Caller, session: CarlaSession, number: int, spin: tuple[float, float, float]
) -> None:
    slot = _spawned(session, number, "set_actor_target_angular_velocity")
    session.world.external.set_spin(slot, math.radians(spin[2]))


@call(
    "enable_actor_constant_velocity",
    actor_id,
    vector,
    returns=Returns.NOTHING,
    note=f"{_SPAWNED}; steering still has an effect",
)
def enable_actor_constant_velocity(
    caller: Caller, session: CarlaSession, number: int, velocity: tuple[float, float, float]
) -> None:
    slot = _spawned(session, number, "enable_actor_constant_velocity")
    session.world.external.set_constant(slot, velocity)


@call("disable_actor_constant_velocity", actor_id, returns=Returns.NOTHING)
def disable_actor_constant_velocity(caller: Caller, session: CarlaSession, number: int) -> None:
    actor = session.actors.find(number, "disable_actor_constant_velocity")
    if actor.slot >= 0:
        session.world.external.set_constant(actor.slot, None)


def _push(name: str, *more: Check, is_force: bool) -> None:
    @call(
        name,
        actor_id,
        vector,
        *more,
        returns=Returns.NOTHING,
        note=f"{_SPAWNED}: changes the velocity of a body of {MASS_KG:g} kg",
    )
    def push(
        caller: Caller,
        session: CarlaSession,
        number: int,
        given: Vector,
        there: Vector | None = None,
    ) -> None:
        slot = _spawned(session, number, name)
        share = (session.world.step_s if is_force else 1.0) / MASS_KG
        session.world.external.push(slot, (given[0] * share, given[1] * share, 0.0))


_push("add_actor_impulse", is_force=False)
_push("add_actor_impulse_at_location", vector, is_force=False)
_push("add_actor_force", is_force=True)
_push("add_actor_force_at_location", vector, is_force=True)


def _move(session: CarlaSession, actor: CarlaActor, there: CarlaPose) -> None:
    if actor.slot >= 0:
        session.world.external.place(actor.slot, there)
    elif actor.vehicle >= 0:
        raise CallRefused(_WORLDS)
    elif actor.parent:
        parent = session.actors.find(actor.parent, "set_actor_transform")
        actor.local = relative(session.actors.pose_of(parent), there)
        session.actors.move_attached(actor)
    else:
        actor.pose = there


@call(
    "apply_control_to_vehicle",
    actor_id,
    vehicle_control,
    returns=Returns.NOTHING,
    note="agents (role_name `car_0`, …) and vehicles that clients have spawned",
)
def apply_control_to_vehicle(
    caller: Caller, session: CarlaSession, number: int, given: tuple[Any, ...]
) -> None:
    _drive(caller, session, number, CarlaControl(*given), "apply_control_to_vehicle")


@call(
    "apply_ackermann_control_to_vehicle",
    actor_id,
    ackermann_control,
    returns=Returns.NOTHING,
    note="as apply_control_to_vehicle; the limits of steering speed and jerk have no effect",
)
def apply_ackermann_control_to_vehicle(
    caller: Caller, session: CarlaSession, number: int, given: tuple[Any, ...]
) -> None:
    control = AckermannControl(*given)
    _drive(caller, session, number, control, "apply_ackermann_control_to_vehicle")


def _drive(caller: Caller, session: CarlaSession, number: int, control: Control, name: str) -> None:
    actor = session.actors.find(number, name)
    session.recordings.refuse_in_replay()
    if actor.agent >= 0:
        session.world.controls[actor.agent] = control
        caller.agents.add(actor.agent)
    elif actor.slot >= 0 and actor.is_vehicle:
        session.world.external.control(actor.slot, control)
    elif actor.is_vehicle:
        raise CallRefused("the built-in driver drives this vehicle; only agents can be controlled")
    else:
        raise CallRefused(f"{actor.type_id} is not a vehicle")


@call("get_actor_bounding_box", actor_id)
def get_actor_bounding_box(caller: Caller, session: CarlaSession, number: int) -> list[Any]:
    return packed_box(session.actors.actors.get(number), session.version)


@call("get_actor_component_names", actor_id)
def get_actor_component_names(caller: Caller, session: CarlaSession, number: int) -> list[str]:
    session.actors.find(number, "get_actor_component_names")
    return ["root"]


@call("get_actor_component_world_transform", actor_id, text)
def get_actor_component_world_transform(
    caller: Caller, session: CarlaSession, number: int, component: str
) -> list[Any]:
    actor = session.actors.find(number, "get_actor_component_world_transform")
    return session.actors.pose_of(actor).packed()


@call("get_actor_component_relative_transform", actor_id, text)
def get_actor_component_relative_transform(
    caller: Caller, session: CarlaSession, number: int, component: str
) -> list[Any]:
    session.actors.find(number, "get_actor_component_relative_transform")
    return CarlaPose(0.0, 0.0, 0.0).packed()


@call("get_vehicle_light_state", actor_id)
def get_vehicle_light_state(caller: Caller, session: CarlaSession, number: int) -> list[int]:
    return [session.actors.find(number, "get_vehicle_light_state").lights]


@call("set_vehicle_light_state", actor_id, light_mask, returns=Returns.NOTHING)
def set_vehicle_light_state(
    caller: Caller, session: CarlaSession, number: int, mask: tuple[int]
) -> None:
    session.actors.find(number, "set_vehicle_light_state").lights = mask[0] & 0xFFFFFFFF


@call("get_physics_control", actor_id, note="typical values; positions of the wheels from the pose")
def get_physics_control(caller: Caller, session: CarlaSession, number: int) -> list[Any]:
    if not session.version.has_wheel_physics:
        raise CallRefused("the physics of vehicles of CARLA 0.10 are not available")
    here = session.actors.pose_of(session.actors.find(number, "get_physics_control"))
    wheels = []
    for ahead, right, steer in _WHEELS_CM:
        there = compose(here, CarlaPose(0.01 * ahead, 0.01 * right, 0.35))
        middle = [100.0 * one for one in there.place]
        wheels.append([3.5, 0.25, steer, 35.0, 1500.0, 3000.0, 2.0, 17.0, 1000.0, middle])
    torque, steering = [[0.0, 500.0], [5000.0, 500.0]], [[0.0, 1.0], [120.0, 1.0]]
    engine = [torque, 5000.0, 1.0, 0.15, 2.0, 0.35, True, 0.5, 10.0, 4.0, [[2.85, 0.5, 0.65]]]
    return [*engine, MASS_KG, 0.3, [0.0, 0.0, 0.0], steering, wheels, True]


@call("get_wheel_steer_angle", actor_id, whole)
def get_wheel_steer_angle(caller: Caller, session: CarlaSession, number: int, wheel: int) -> float:
    steer = _vehicle_state(session, number, "get_wheel_steer_angle")["steer"]
    return float(np.degrees(FULL_STEER_RAD) * steer) if wheel in (0, 1) else 0.0


@call("get_telemetry_data", actor_id, note="speed and controls; the engine and the tyres are zero")
def get_telemetry_data(caller: Caller, session: CarlaSession, number: int) -> list[Any]:
    state = _vehicle_state(session, number, "get_telemetry_data")
    speed = float(np.linalg.norm(state["velocity"]))
    controls = [float(state[name]) for name in ("steer", "throttle", "brake")]
    return [speed, *controls, 0.0, int(state["gear"]), 0.0, [[0.0] * 11 for _ in range(4)]]


def _vehicle_state(session: CarlaSession, number: int, name: str) -> np.void:
    actor = session.actors.find(number, name)
    state = session.actors.state_of(actor)
    if state is None or not actor.is_vehicle:
        raise CallRefused(f"{actor.type_id} is not a vehicle")
    return state


answer_from(
    "get_spectator", lambda session: packed_actor(session.actors.spectator, session.version)
)
answer_from(
    "get_vehicle_light_states",
    lambda session: [[one.number, one.lights] for one in session.actors.vehicles if one.is_vehicle],
)
answer_constant(
    [],
    "get_actor_bone_names",
    "get_actor_socket_names",
    "get_actor_bone_world_transforms",
    "get_actor_bone_relative_transforms",
    "get_actor_socket_world_transforms",
    "get_actor_socket_relative_transforms",
    "get_vehicle_bone_world_transforms",
    checks=(actor_id,),
)
answer_constant(_DEFAULT_ACKERMANN, "get_ackermann_controller_settings", checks=(actor_id,))
answer_constant(False, "is_sensor_enabled_for_ros", checks=(actor_id,))
accept(
    "set_actor_simulate_physics",
    "set_actor_collisions",
    "set_actor_enable_gravity",
    "set_actor_autopilot",
    "show_vehicle_debug_telemetry",
    checks=(actor_id, flag),
)
accept("set_actor_dead", checks=(actor_id,))
accept("open_vehicle_door", "close_vehicle_door", checks=(actor_id, whole))
accept("apply_ackermann_controller_settings", "apply_physics_control", checks=(actor_id, anything))
accept("enable_sensor_for_ros", "disable_sensor_for_ros", checks=(actor_id,))
accept("set_ignored_vehicles", checks=(actor_id, listed(actor_id)))
accept("enable_gbuffers", checks=(actor_id, flag))
accept("add_actor_angular_impulse", "add_actor_torque", checks=(actor_id, vector))
accept("restore_physx_physics", checks=(actor_id,))
refuse("set_wheel_steer_direction", checks=(actor_id, whole, number), because=_KINEMATIC)
refuse("enable_carsim", checks=(actor_id, text), because=_KINEMATIC)
refuse("use_carsim_road", checks=(actor_id, flag), because=_KINEMATIC)
refuse("enable_chrono_physics", checks=(actor_id, *[anything] * 6), because=_KINEMATIC)
refuse(
    "set_bones_transform",
    "blend_pose",
    checks=(actor_id, anything),
    because=_NO_BONES,
)
refuse("get_pose_from_animation", checks=(actor_id,), because=_NO_BONES)
refuse("get_bones_transform", checks=(actor_id,), because=_NO_BONES, returns=Returns.VALUE)
refuse(
    "get_gbuffer_token",
    checks=(actor_id, whole),
    because="cameras have no G-buffers",
    returns=Returns.VALUE,
)
refuse("send", checks=(actor_id, text), because="there are no V2X sensors")
