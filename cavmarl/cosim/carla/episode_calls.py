"""Calls about the connection, maps, time, weather and traffic managers."""

from __future__ import annotations

import math
from typing import Any

from cavmarl.cosim.carla.call_arguments import (
    CallRefused,
    actor_id,
    anything,
    flag,
    listed,
    number,
    optional,
    place,
    record_of,
    shown,
    text,
    vector,
    whole,
)
from cavmarl.cosim.carla.call_table import (
    Caller,
    Effect,
    Returns,
    accept,
    answer_constant,
    answer_from,
    call,
)
from cavmarl.cosim.carla.carla_blueprints import BLUEPRINTS
from cavmarl.cosim.carla.carla_session import CarlaSession, EpisodeSettings
from cavmarl.cosim.carla.carla_streams import EPISODE_STREAM
from cavmarl.cosim.carla.hosted_world import GENERATED_MAP

_ROAD_TAG = 1  # CARLA's semantic tag
_MAX_MANAGERS = 256
_MAX_PORT = 65535
_SHORTEST_S, _LONGEST_S = 0.001, 10.0  # limits of `fixed_delta_seconds`

_settings = record_of(flag, flag, optional(number), *[anything] * 8, required=3)
_weather = record_of(*[number] * 14, required=12)
_xodr_options = anything


def port(value: Any) -> int:
    if not 0 <= whole(value) <= _MAX_PORT:
        raise CallRefused(f"{value} is not a port")
    return int(value)


@call("get_sensor_token", actor_id)
def get_sensor_token(caller: Caller, session: CarlaSession, stream: int) -> list[Any]:
    return [session.streams.token(stream)]


@call(
    "set_episode_settings",
    _settings,
    note="synchronous mode and fixed step; a step that the world cannot make restarts it",
)
def set_episode_settings(caller: Caller, session: CarlaSession, given: tuple[Any, ...]) -> int:
    synchronous, no_rendering, delta_s, *others = given
    if delta_s is not None and delta_s == 0.0:
        delta_s = None  # the same as a variable step
    if delta_s is not None and not _SHORTEST_S <= delta_s <= _LONGEST_S:
        raise CallRefused(
            f"fixed_delta_seconds = {delta_s:g}: must be from {_SHORTEST_S:g} to {_LONGEST_S:g}"
        )
    kept = session.settings.others
    others = [*others, *kept[len(others) :]]
    session.change_settings(EpisodeSettings(synchronous, no_rendering, delta_s, tuple(others)))
    return session.frame


@call(
    "tick_cue",
    note="each call runs a tick, if `--other-ticks` permits; no effect in asynchronous mode",
)
def tick_cue(caller: Caller, session: CarlaSession) -> int:
    return session.tick_for(caller) if session.settings.synchronous else session.frame + 1


@call(
    "load_new_episode",
    text,
    flag,
    whole,
    returns=Returns.NOTHING,
    required=1,
    note="names of environments; the present map again; the map that the client has sent",
)
def load_new_episode(
    caller: Caller, session: CarlaSession, name: str, reset_settings: bool = True, layers: int = 0
) -> None:
    session.load(name, reset_settings)


@call(
    "copy_opendrive_to_file",
    text,
    _xodr_options,
    returns=Returns.NOTHING,
    required=1,
    note=f"the map becomes `{GENERATED_MAP}`; the options for its mesh have no effect",
)
def copy_opendrive_to_file(
    caller: Caller, session: CarlaSession, document: str, options: Any = None
) -> None:
    session.source.take_map(document)


@call(
    "set_weather_parameters",
    _weather,
    returns=Returns.NOTHING,
    effect=Effect.ACCEPTED,
    note="kept and readable",
)
def set_weather_parameters(caller: Caller, session: CarlaSession, given: tuple[float, ...]) -> None:
    session.weather = [*given, *session.weather[len(given) :]]


@call(
    "set_imui_gravity",
    number,
    returns=Returns.NOTHING,
    effect=Effect.ACCEPTED,
    note="kept and readable",
)
def set_imui_gravity(caller: Caller, session: CarlaSession, gravity: float) -> None:
    session.gravity = gravity


@call("get_actor_definitions")
def get_actor_definitions(caller: Caller, session: CarlaSession) -> list[Any]:
    first = session.version.first_attribute_kind
    return [one.packed(row, first) for row, one in enumerate(BLUEPRINTS.values(), start=1)]


@call("is_traffic_manager_running", port)
def is_traffic_manager_running(caller: Caller, session: CarlaSession, at: int) -> bool:
    return at in session.managers


@call("get_traffic_manager_running", port)
def get_traffic_manager_running(caller: Caller, session: CarlaSession, at: int) -> list[Any]:
    return [session.managers.get(at, ""), at if at in session.managers else 0]


@call("add_traffic_manager_running", record_of(text, port))
def add_traffic_manager_running(
    caller: Caller, session: CarlaSession, manager: tuple[str, int]
) -> bool:
    host, at = manager
    if len(session.managers) >= _MAX_MANAGERS:
        raise CallRefused(f"{_MAX_MANAGERS} traffic managers are running")
    is_new = at not in session.managers
    session.managers.setdefault(at, host)
    return is_new


@call("destroy_traffic_manager", port)
def destroy_traffic_manager(caller: Caller, session: CarlaSession, at: int) -> bool:
    return session.managers.pop(at, None) is not None


@call("project_point", place, vector, number, note="the ground is the plane z = 0")
def project_point(
    caller: Caller,
    session: CarlaSession,
    start: tuple[float, ...],
    way: tuple[float, ...],
    reach_m: float,
) -> list[Any]:
    hit = _on_ground(start, way, reach_m)
    return [hit is not None, [hit or [0.0, 0.0, 0.0], _ROAD_TAG]]


@call("cast_ray", place, place, note="the ground is the plane z = 0")
def cast_ray(
    caller: Caller, session: CarlaSession, start: tuple[float, ...], end: tuple[float, ...]
) -> list[Any]:
    way = tuple(b - a for a, b in zip(start, end, strict=True))
    hit = _on_ground(start, way, math.dist(start, end))
    return [] if hit is None else [[hit, _ROAD_TAG]]


def _on_ground(
    start: tuple[float, ...], way: tuple[float, ...], reach_m: float
) -> list[float] | None:
    """Return where a ray meets the plane z = 0, within a distance."""
    length = math.hypot(*way)
    fall = -way[2] / length if length > 0.0 else 0.0
    if fall <= 0.0 or not 0.0 <= start[2] / fall <= reach_m:
        return None
    share = start[2] / fall / length
    return [start[0] + share * way[0], start[1] + share * way[1], 0.0]


answer_from("version", lambda session: session.version.name)
answer_from(
    "get_episode_info", lambda session: [session.episode, [session.streams.token(EPISODE_STREAM)]]
)
answer_from("get_episode_settings", lambda session: session.settings.packed())
answer_from(
    "get_map_info",
    lambda session: [session.map.path, [pose.packed() for pose in session.map.spawn_points]],
)
answer_from("get_map_data", lambda session: session.map.document)
answer_from(
    "get_available_maps",
    lambda session: [f"/Game/Carla/Maps/{name}" for name in session.source.map_names],
)
answer_from("get_weather_parameters", lambda session: session.weather)
answer_from("get_imui_gravity", lambda session: session.gravity)
answer_from(
    "get_navigation_mesh",
    lambda session: (
        b"" if session.map.navigation_mesh is None else session.map.navigation_mesh.content
    ),
)
accept(
    "draw_debug_shape",
    checks=(anything,),
    note="nothing is drawn",
)
accept("clear_debug_shape", "clear_debug_string", checks=(), note="nothing is drawn")
accept("load_map_layer", "unload_map_layer", checks=(whole,))
accept("enable_environment_objects", checks=(listed(whole), flag))
accept("update_lights_state", checks=(text, listed(anything), flag), note="no street lights")
accept("update_day_night_cycle", checks=(text, flag), note="no street lights")
accept("set_annotations_traverse_translucency", checks=(flag,))
accept(
    "apply_color_texture_to_objects",
    "apply_float_color_texture_to_objects",
    checks=(listed(text), whole, anything),
)
answer_constant([], "query_lights_state", checks=(text,), note="no street lights")
answer_constant([], "get_names_of_all_objects")
answer_constant([], "get_environment_objects", "get_all_level_BBs", checks=(whole,))
answer_constant(True, "is_weather_enabled")


@call("get_required_files", text, note="the navigation mesh")
def get_required_files(caller: Caller, session: CarlaSession, folder: str) -> list[str]:
    mesh = session.map.navigation_mesh
    return [mesh.name] if mesh is not None and folder == "Nav" else []


@call("request_file", text, note="the navigation mesh")
def request_file(caller: Caller, session: CarlaSession, name: str) -> bytes:
    mesh = session.map.navigation_mesh
    if mesh is None or name != mesh.name:
        raise CallRefused(f"this server has no file {shown(name)}")
    return mesh.content
