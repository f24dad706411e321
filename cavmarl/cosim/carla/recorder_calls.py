"""Calls about recordings: start, stop, show and replay them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from cavmarl.cosim.carla.call_arguments import (
    CallRefused,
    actor_id,
    flag,
    number,
    pose,
    shown,
    text,
    whole,
)
from cavmarl.cosim.carla.call_table import Caller, Returns, accept, call
from cavmarl.cosim.carla.carla_geometry import CarlaPose
from cavmarl.cosim.carla.carla_recorder import RecordedActor
from cavmarl.cosim.carla.carla_replay import CarlaRecording, nearest_to
from cavmarl.cosim.carla.carla_session import CarlaSession

_MOST_CHARACTERS = 1 << 22  # limit of a report
_MOST_FACTOR = 1000.0
_KINDS = {"vehicle": 1, "walker": 2}  # CARLA's numbers; all other types are 0
_LETTERS = {"h": "hero", "v": "vehicle", "w": "walker", "t": "light", "o": "other", "a": "any"}
_NO_OFFSET = CarlaPose(0.0, 0.0, 0.0)
_BEHIND = CarlaPose(-10.0, 0.0, 5.0, -25.0)  # spectator behind a vehicle


@call(
    "start_recorder",
    text,
    flag,
    required=1,
    note="a name, without a path; vehicles, walkers, props and lights of each tick",
)
def start_recorder(
    caller: Caller, session: CarlaSession, name: str, additional: bool = False
) -> str:
    return str(session.recordings.start(name))


@call("stop_recorder", returns=Returns.NOTHING)
def stop_recorder(caller: Caller, session: CarlaSession) -> None:
    session.recordings.stop()


@call(
    "replay_file",
    text,
    number,
    number,
    actor_id,
    flag,
    pose,
    required=4,  # client 0.9.15 has no offset
    note="shows the recorded vehicles instead of the world, which is paused until the end",
)
def replay_file(
    caller: Caller,
    session: CarlaSession,
    name: str,
    start_s: float,
    duration_s: float,
    follow: int,
    sensors: bool = False,
    offset: CarlaPose = _NO_OFFSET,
) -> str:
    recording = session.recordings.open(name)
    replay = session.recordings.begin_replay(
        recording, start_s, duration_s, follow, _BEHIND if offset == _NO_OFFSET else offset
    )
    return (
        f"Replaying File: {name}\n\nTotal time recorded: {recording.duration_s:g}\n\nReplaying "
        f"from {replay.begin_s:g} s - {replay.end_s:g} s ({recording.duration_s:g} s) at "
        f"{replay.factor:.1f}x\n"
    )


@call("stop_replayer", flag, returns=Returns.NOTHING, note="the world continues where it stopped")
def stop_replayer(caller: Caller, session: CarlaSession, keep_actors: bool) -> None:
    session.recordings.end_replay()


@call("set_replayer_time_factor", number, returns=Returns.NOTHING)
def set_replayer_time_factor(caller: Caller, session: CarlaSession, factor: float) -> None:
    if not 0.0 < factor <= _MOST_FACTOR:
        raise CallRefused(f"{factor:g}: must be above 0 and at most {_MOST_FACTOR:g}")
    session.recordings.set_replay_factor(factor)


@call("show_recorder_file_info", text, flag, required=1)
def show_recorder_file_info(
    caller: Caller, session: CarlaSession, name: str, show_all: bool = False
) -> str:
    recording = session.recordings.open(name)
    head = f"Version: 1\nMap: {recording.session.map}\nDate: {recording.started}\n\n"
    return _cut(head, _frame_lines(recording, show_all)) + (
        f"\nFrames: {len(recording.times_s)}\nDuration: {recording.duration_s:g} seconds\n"
    )


@call("show_recorder_collisions", text, whole, whole)
def show_recorder_collisions(
    caller: Caller, session: CarlaSession, name: str, first: int, second: int
) -> str:
    recording = session.recordings.open(name)
    wanted = _matcher(first), _matcher(second)
    head = f"{_title(recording)}{'Time':>8}  Types  {'Id':>6} {'Actor 1':<35} {'Id':>6} Actor 2\n"
    return _cut(head, _collision_lines(recording, *wanted)) + _tail(recording)


@call(
    "show_recorder_actors_blocked", text, number, number, note="the distance is in cm, as CARLA's"
)
def show_recorder_actors_blocked(
    caller: Caller, session: CarlaSession, name: str, least_s: float, distance_cm: float
) -> str:
    recording = session.recordings.open(name)
    head = f"{_title(recording)}{'Time':>8}  {'Id':>6} {'Actor':<35} {'Duration':>10}\n"
    return _cut(head, _blocked_lines(recording, least_s, 0.01 * distance_cm)) + _tail(recording)


accept("set_replayer_ignore_hero", "set_replayer_ignore_spectator", checks=(flag,))


def _title(recording: CarlaRecording) -> str:
    return f"Version: 1\nMap: {recording.session.map}\nDate: {recording.started}\n\n"


def _tail(recording: CarlaRecording) -> str:
    return f"\nFrames: {len(recording.times_s)}\nDuration: {recording.duration_s:g} seconds\n"


def _cut(head: str, lines: Iterator[str]) -> str:
    """Return a report; if it is too long for a message, cut it and say so in a last line."""
    parts, size = [head], len(head)
    for line in lines:
        size += len(line) + 1
        if size > _MOST_CHARACTERS:
            parts.append(f"(the rest is left out: more than {_MOST_CHARACTERS} characters)\n")
            break
        parts.append(line + "\n")
    return "".join(parts)


def _frame_lines(recording: CarlaRecording, show_all: bool) -> Iterator[str]:
    """Yield lines about actors that appear or leave; `show_all`: also all places, in cm."""
    actors = recording.session.actors
    present: set[int] = set()
    for frame_number, (time_s, frame) in enumerate(recording.moments(), start=1):
        vehicles = frame.vehicles
        ids = set(vehicles["id"].tolist())
        if not (show_all or ids != present):
            continue
        yield f"Frame {frame_number} at {time_s:g} seconds"
        for row in vehicles:
            actor = actors.get(int(row["id"]))
            there = f"({100.0 * row['x']:.0f}, {-100.0 * row['y']:.0f}, {100.0 * row['z']:.0f})"
            if int(row["id"]) not in present and actor is not None:
                kind = _KINDS.get(_kind_of(actor), 0)
                yield f" Create {actor.number}: {actor.type_id} ({kind}) at {there}"
                yield from (f"  {name} = {value}" for name, value in actor.attributes.items())
            elif show_all and actor is not None:
                yield f" Position {actor.number}: {there}"
        for vehicle in sorted(present - ids):
            if vehicle in actors:
                yield f" Destroy {actors[vehicle].number}"
        present = ids


def _collision_lines(
    recording: CarlaRecording,
    is_first: Callable[[RecordedActor], bool],
    is_second: Callable[[RecordedActor], bool],
) -> Iterator[str]:
    """Yield the collisions of agents; the other vehicle is taken to be the nearest vehicle."""
    actors = recording.session.actors
    for time_s, vehicle, frame in recording.collisions():
        row = int(np.flatnonzero(frame.vehicles["id"] == vehicle)[0])
        pair = vehicle, nearest_to(row, frame.vehicles)
        one, other = (actors.get(vehicle) for vehicle in pair)
        if one is None or other is None or not (is_first(one) and is_second(other)):
            continue
        types = f"{_kind_of(one)[0]} {_kind_of(other)[0]}"
        yield (
            f"{time_s:>8.2f}  {types:<5}  {one.number:>6} {one.type_id:<35} "
            f"{other.number:>6} {other.type_id}"
        )


def _blocked_lines(recording: CarlaRecording, least_s: float, distance_m: float) -> Iterator[str]:
    """Yield the actors that have moved by less than a distance for a time, the longest first."""
    stood: list[tuple[float, float, int]] = []  # duration, begin, vehicle
    since: dict[int, tuple[float, float, float]] = {}  # begin and place of each present vehicle
    time_s = 0.0

    def end(vehicle: int) -> None:
        begin_s = since.pop(vehicle)[0]
        if time_s - begin_s >= least_s:
            stood.append((time_s - begin_s, begin_s, vehicle))

    for moment in recording.moments():
        rows = moment.frame.vehicles
        places = dict(
            zip(
                rows["id"].tolist(),
                zip(rows["x"].tolist(), rows["y"].tolist(), strict=True),
                strict=True,
            )
        )
        for vehicle in [one for one in since if one not in places]:
            end(vehicle)
        time_s = moment.time_s
        for vehicle, (x, y) in places.items():
            if vehicle in since:
                _, was_x, was_y = since[vehicle]
                if np.hypot(x - was_x, y - was_y) < distance_m:
                    continue
                end(vehicle)
            since[vehicle] = time_s, x, y
    for vehicle in list(since):
        end(vehicle)
    actors = recording.session.actors
    for duration_s, begin_s, vehicle in sorted(stood, key=lambda one: (-one[0], one[1:])):
        actor = actors.get(vehicle)
        if actor is not None:
            yield (f"{begin_s:>8.2f}  {actor.number:>6} {actor.type_id:<35} {duration_s:>10.2f}")


def _kind_of(actor: RecordedActor) -> str:
    """Return vehicle, walker, or other."""
    first = actor.type_id.partition(".")[0]
    return first if first in _KINDS else "other"


def _matcher(letter: int) -> Callable[[RecordedActor], bool]:
    """Return a function that tests the kind of an actor; `letter`: a key of `_LETTERS`."""
    wanted = _LETTERS.get(chr(letter) if 0 <= letter < 128 else "")
    if wanted is None:
        raise CallRefused(
            f"{shown(letter)} is not the code of a kind of actors: use one of "
            f"{', '.join(f'{key!r} ({name})' for key, name in _LETTERS.items())}"
        )
    if wanted == "any":
        return lambda actor: True
    if wanted == "hero":
        return lambda actor: actor.attributes.get("role_name") in ("hero", "ego_vehicle")
    return lambda actor: _kind_of(actor) == wanted
