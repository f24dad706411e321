"""Calls about traffic lights."""

from __future__ import annotations

from cavmarl.cosim.carla.call_arguments import CallRefused, actor_id, flag, number, whole
from cavmarl.cosim.carla.call_table import Caller, Returns, answer_constant, call
from cavmarl.cosim.carla.carla_map import GREEN, RED, YELLOW
from cavmarl.cosim.carla.carla_session import CarlaSession

_GROUP = "a group is the lights of one signal"


@call("get_group_traffic_lights", actor_id, note=_GROUP)
def get_group_traffic_lights(caller: Caller, session: CarlaSession, actor: int) -> list[int]:
    approaches = session.map.approaches
    signal = approaches[_light(session, actor, "get_group_traffic_lights")].signal
    ids = session.actors.lights["id"].tolist()
    return [one for one, each in zip(ids, approaches, strict=True) if each.signal == signal]


@call(
    "set_traffic_light_state",
    actor_id,
    whole,
    returns=Returns.NOTHING,
    note="for the light's time of that state, or while it is frozen; then it follows its group",
)
def set_traffic_light_state(caller: Caller, session: CarlaSession, actor: int, state: int) -> None:
    light = _light(session, actor, "set_traffic_light_state")
    session.world.lights.set_state(light, state)


def _set_time(name: str, state: int, note: str) -> None:
    @call(name, actor_id, number, returns=Returns.NOTHING, note=note)
    def set_time(caller: Caller, session: CarlaSession, actor: int, seconds: float) -> None:
        session.world.lights.set_time(_light(session, actor, name), state, seconds)


_set_time("set_traffic_light_green_time", GREEN, "scales the green phases of the group")
_set_time("set_traffic_light_yellow_time", YELLOW, "scales the yellow phases of the group")
_set_time(
    "set_traffic_light_red_time",
    RED,
    "scales the phases in which all lights of the group are red, if there are any",
)


@call(
    "freeze_traffic_light",
    actor_id,
    flag,
    returns=Returns.NOTHING,
    note="all lights of the group; CARLA's client calls freeze_all_traffic_lights instead",
)
def freeze_traffic_light(
    caller: Caller, session: CarlaSession, actor: int, is_frozen: bool
) -> None:
    session.world.lights.freeze(is_frozen, _light(session, actor, "freeze_traffic_light"))


@call("freeze_all_traffic_lights", flag, returns=Returns.NOTHING)
def freeze_all_traffic_lights(caller: Caller, session: CarlaSession, is_frozen: bool) -> None:
    session.world.lights.freeze(is_frozen)


@call(
    "reset_traffic_light_group",
    actor_id,
    returns=Returns.NOTHING,
    note="the group begins its first phase",
)
def reset_traffic_light_group(caller: Caller, session: CarlaSession, actor: int) -> None:
    session.world.lights.reset(_light(session, actor, "reset_traffic_light_group"))


@call(
    "reset_all_traffic_lights",
    returns=Returns.NOTHING,
    note="each group begins its first phase",
)
def reset_all_traffic_lights(caller: Caller, session: CarlaSession) -> None:
    session.world.lights.reset()


answer_constant([], "get_light_boxes", checks=(actor_id,))


def _light(session: CarlaSession, actor: int, name: str) -> int:
    """Return the index of a traffic light's approach."""
    session.actors.find(actor, name)
    ids = session.actors.lights["id"].tolist()
    if actor not in ids:
        raise CallRefused(f"actor {actor} is not a traffic light")
    return int(ids.index(actor))
