"""`apply_batch`: several commands in one call, with one answer each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cavmarl.core.errors import CavmarlError
from cavmarl.cosim.carla.actor_calls import description, spawn
from cavmarl.cosim.carla.call_arguments import (
    CallRefused,
    actor_id,
    flag,
    listed,
    pose,
    record_of,
    shown,
)
from cavmarl.cosim.carla.call_table import CALLS, Caller, Returns, call
from cavmarl.cosim.carla.carla_session import CarlaSession

MAX_COMMANDS = 1 << 14
_SPAWN, _DESTROY, _LIGHTS, _CONSOLE = 0, 1, 18, 20  # CARLA's numbers of commands
_CALL_OF_COMMAND = {
    2: "apply_control_to_vehicle",
    3: "apply_ackermann_control_to_vehicle",
    4: "apply_control_to_walker",
    5: "apply_physics_control",
    6: "set_actor_transform",
    7: "set_walker_state",
    8: "set_actor_target_velocity",
    9: "set_actor_target_angular_velocity",
    10: "add_actor_impulse",
    11: "add_actor_force",
    12: "add_actor_angular_impulse",
    13: "add_actor_torque",
    14: "set_actor_simulate_physics",
    15: "set_actor_enable_gravity",
    16: "set_actor_autopilot",
    17: "show_vehicle_debug_telemetry",
    18: "set_vehicle_light_state",
    19: "set_actor_location",
    21: "set_traffic_light_state",
}


def _command(value: Any) -> tuple[int, list[Any]]:
    match value:
        case [[int(index), list(body)]]:
            return index, body
    raise CallRefused(f"{shown(value)} is not a command")


@call(
    "apply_batch",
    listed(_command, most=MAX_COMMANDS),
    flag,
    returns=Returns.BARE,
    note="a command works like the call of its name; after a spawn, actor 0 is the spawned actor",
)
def apply_batch(
    caller: Caller, session: CarlaSession, commands: Sequence[tuple[int, list[Any]]], do_tick: bool
) -> list[Any]:
    answers = [_answer(caller, session, index, body) for index, body in commands]
    if do_tick and session.settings.synchronous:
        try:
            session.tick_for(caller)
        except CallRefused as problem:  # only the tick is refused; the commands keep their answers
            session.tell(f"{caller.name}: apply_batch: {problem}")
    return answers


def _answer(caller: Caller, session: CarlaSession, index: int, body: list[Any]) -> list[Any]:
    try:
        return [[1, _carry_out(caller, session, index, body)]]
    except (CallRefused, CavmarlError) as problem:
        session.tell(f"{caller.name}: apply_batch: {problem}")
        return [[0, [str(problem)]]]


def _carry_out(
    caller: Caller, session: CarlaSession, index: int, body: list[Any], spawned: int = 0
) -> int:
    """Carry out a command; return its actor. `spawned`: the actor that replaces the number 0."""
    if index == _SPAWN:
        if spawned:
            raise CallRefused("a spawn command after a spawn command")
        return _spawn(caller, session, body)
    if index == _CONSOLE:
        raise CallRefused("there is no console")
    if not body:
        raise CallRefused("a command without an actor")
    number = actor_id(body[0]) or spawned
    if index == _DESTROY:
        session.destroy(number)
        return number
    name = _CALL_OF_COMMAND.get(index)
    if name is None:
        raise CallRefused(f"there is no command {index}")
    # A command has a plain number for the lamps; the call has a record.
    rest = [[body[1]]] if index == _LIGHTS and len(body) == 2 else body[1:]
    CALLS[name].carry_out(caller, session, [number, *rest])
    return number


def _spawn(caller: Caller, session: CarlaSession, body: list[Any]) -> int:
    if not body:
        raise CallRefused("a spawn command without fields")
    *fields, after = body
    what, there, parent = record_of(description, pose, _parent)(fields)
    actor = spawn(session, what, there, parent)
    for index, following in listed(_command, most=MAX_COMMANDS)(after):
        try:
            _carry_out(caller, session, index, following, actor.number)
        except (CallRefused, CavmarlError) as problem:
            session.tell(f"{caller.name}: apply_batch: after a spawn: {problem}")
    return actor.number


def _parent(value: Any) -> int:
    """Return an optional actor; 0 for none. The rest of the field may be uninitialised."""
    match value:
        case [False, *_]:
            return 0
        case [True, int(number)]:
            return actor_id(number)
    raise CallRefused(f"{shown(value)} is not an optional actor")
