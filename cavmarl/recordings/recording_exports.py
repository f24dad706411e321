"""Export of recordings: SUMO's floating car data and emissions, CSV, and MCAP for Foxglove."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from cavmarl.core.errors import ConfigError, require
from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.driving.kernels.emissions import FUEL_PER_CO2
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.engine.world_frame import SEEN, FrameEvent, WorldFrame
from cavmarl.recordings.recording import Recording
from cavmarl.roads.network import VEHICLE_CLASSES

Track = Callable[[Iterator[WorldFrame]], Iterable[WorldFrame]]
"""Wraps the iterator of frames to show the progress."""
Export = Callable[[Recording, Path, int, int, Track], int]
_EVENT = "cavmarl.Event"


def write_fcd(
    recording: Recording, path: Path, world: int, episode: int, track: Track = iter
) -> int:
    """Write SUMO's FCD output; as in SUMO, x and y are the position of the front bumper.

    Angles are degrees clockwise from north; `pos` is the front bumper's position along its lane.

    Args:
        recording: the recording.
        path: the file to write.
        world: index of the world.
        episode: index of the episode.
        track: wraps the frames to show the progress.

    Returns:
        the number of frames.

    Raises:
        ConfigError: the file cannot be written.
        RecordingError: the recording cannot be read, or its map is missing.
    """
    network = recording.network
    count = 0
    with _writing(path) as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for frame in track(recording.frames(world, episode)):
            file.write(f'    <timestep time="{frame.time_s:.2f}">\n')
            for row in frame.vehicles:
                file.write(_fcd_line(row, network.lane_ids))
            file.write("    </timestep>\n")
            count += 1
        file.write("</fcd-export>\n")
    return count


def _fcd_line(row: np.void, lane_ids: tuple[str, ...]) -> str:
    vclass = int(row["vclass"])
    angle = (90.0 - math.degrees(float(row["heading"]))) % 360.0
    kind = "person" if vclass == CLASS_PEDESTRIAN else "vehicle"
    key = "edge" if kind == "person" else "lane"
    name = _lane_name(row, lane_ids)
    return (
        f'        <{kind} id="{row["id"]}" {_front(row)} z="{float(row["z"]):.3f}" '
        f'angle="{angle:.3f}" type="{_class_name(vclass)}" speed="{float(row["speed"]):.3f}" '
        f'slope="{math.degrees(float(row["pitch"])):.3f}" '
        f'acceleration="{float(row["accel"]):.3f}" odometer="{float(row["distance_m"]):.3f}" '
        f"{key}={quoteattr(name)}/>\n"
    )


def _front(row: np.void) -> str:
    """Return the attributes x and y: the place of the front bumper, as in SUMO."""
    half, heading = 0.5 * float(row["length"]), float(row["heading"])
    x = float(row["x"]) + half * math.cos(heading)
    y = float(row["y"]) + half * math.sin(heading)
    return f'x="{x:.3f}" y="{y:.3f}"'


def _lane_name(row: np.void, lane_ids: tuple[str, ...]) -> str:
    lane = int(row["lane"])
    return lane_ids[lane] if 0 <= lane < len(lane_ids) else ""


def write_csv(
    recording: Recording, path: Path, world: int, episode: int, track: Track = iter
) -> int:
    """Write one line per vehicle and frame, at full precision; see `write_fcd`."""
    names = SEEN.names or ()
    count = 0
    with _writing(path) as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(["tick", "time_s", *names])
        for frame in track(recording.frames(world, episode)):
            moment = (frame.tick, repr(frame.time_s))
            lines.writerows((*moment, *row) for row in frame.vehicles.tolist())
            count += 1
    return count


def write_emissions(
    recording: Recording, path: Path, world: int, episode: int, track: Track = iter
) -> int:
    """Write SUMO's emission output: in each frame, the emissions since the previous frame.

    Each vehicle has three values: `electricity` (Wh) for an electric car, `CO2` and `fuel` (mg) for
    a combustion engine. The speed and acceleration in a frame apply to the time since the previous
    frame. Arguments, result and errors are the same as in `write_fcd`.
    """
    lane_ids, count = recording.network.lane_ids, 0
    per_co2, before_s = np.array(FUEL_PER_CO2), math.nan
    with _writing(path) as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<emission-export>\n')
        for frame in track(recording.frames(world, episode)):
            file.write(f'    <timestep time="{frame.time_s:.2f}">\n')
            rows, vclass = frame.vehicles, frame.vehicles["vclass"]
            elapsed_s = frame.time_s - before_s if count else recording.head.step_s
            used = emissions_of(rows, vclass, elapsed_s)
            fuel_mg = 1e3 * used[:, 1] * per_co2[vclass]
            for row, (energy_wh, co2_g), fuel in zip(rows, used, fuel_mg, strict=True):
                file.write(
                    f'        <vehicle id="{row["id"]}" CO2="{1e3 * co2_g:.2f}" fuel="{fuel:.2f}" '
                    f'electricity="{energy_wh:.5f}" type="{_class_name(int(row["vclass"]))}" '
                    f'speed="{float(row["speed"]):.3f}" '
                    f"lane={quoteattr(_lane_name(row, lane_ids))} {_front(row)}/>\n"
                )
            before_s = frame.time_s
            file.write("    </timestep>\n")
            count += 1
        file.write("</emission-export>\n")
    return count


def write_mcap(
    recording: Recording, path: Path, world: int, episode: int, track: Track = iter
) -> int:
    """Write MCAP with JSON messages: `/vehicles` as Foxglove's SceneUpdate, and `/events`.

    Foxglove shows the file in its 3D panel. See `write_fcd` for the arguments.

    Raises:
        MissingExtraError: mcap is not installed.
    """
    writer_module = require("mcap.writer", "record")
    require("mcap.well_known", "record")
    events: dict[int, list[FrameEvent]] = {}
    for found in recording.events(world):
        if found.episode == episode:
            events.setdefault(found.event.tick, []).append(found.event)
    count = 0
    with _opened(path, "wb") as file:
        writer = writer_module.Writer(file)
        writer.start(profile="", library="cavmarl")
        scene = _channel(writer, "/vehicles", "foxglove.SceneUpdate", _SCENE_SCHEMA)
        event_channel = _channel(writer, "/events", _EVENT, _EVENT_SCHEMA)
        for frame in track(recording.frames(world, episode)):
            now_ns = round(frame.time_s * 1e9)
            _write(writer, scene, now_ns, _scene_update(frame, now_ns))
            for event in events.pop(frame.tick, ()):
                _write(writer, event_channel, now_ns, event._asdict())
            count += 1
        for tick, late in sorted(events.items()):  # events of a last step whose frame is missing
            for event in late:
                now_ns = round(tick * recording.head.sim_dt_s * 1e9)
                _write(writer, event_channel, now_ns, event._asdict())
        writer.finish()
    return count


EXPORTS: dict[str, Export] = {
    "fcd": write_fcd,
    "emissions": write_emissions,
    "csv": write_csv,
    "mcap": write_mcap,
}


def _class_name(vclass: int) -> str:
    return VEHICLE_CLASSES[vclass] if 0 <= vclass < len(VEHICLE_CLASSES) else "pedestrian"


def _scene_update(frame: WorldFrame, now_ns: int) -> dict[str, Any]:
    """Return Foxglove's SceneUpdate: a cube per vehicle in the frame `map`, and deletions."""
    stamp = {"sec": now_ns // 10**9, "nsec": now_ns % 10**9}
    still = {"sec": 0, "nsec": 0}
    entities = []
    for row in frame.vehicles:
        turn = 0.5 * float(row["heading"])
        height = float(row["height"])
        place = {"x": float(row["x"]), "y": float(row["y"]), "z": float(row["z"]) + 0.5 * height}
        size = {"x": float(row["length"]), "y": float(row["width"]), "z": height}
        is_agent = row["agent"] >= 0
        color = {"r": 0.2, "g": 0.5, "b": 1.0} if is_agent else {"r": 0.6, "g": 0.6, "b": 0.6}
        cube = {
            "pose": {
                "position": place,
                "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(turn), "w": math.cos(turn)},
            },
            "size": size,
            "color": {**color, "a": 1.0},
        }
        shown = {"speed": float(row["speed"]), "agent": int(row["agent"]), "zone": int(row["zone"])}
        entities.append(
            {
                "timestamp": stamp,
                "frame_id": "map",
                "id": str(row["id"]),
                "lifetime": still,
                "frame_locked": False,
                "metadata": [{"key": key, "value": str(value)} for key, value in shown.items()],
                "cubes": [cube],
            }
        )
    deletions = [{"timestamp": stamp, "type": 1, "id": ""}]  # 1: delete all earlier entities
    return {"deletions": deletions, "entities": entities}


_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_SCENE_SCHEMA = {
    "title": "foxglove.SceneUpdate",
    "type": "object",
    "properties": {
        "deletions": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "timestamp": _TIME,
                    "type": {"type": "integer"},
                    "id": {"type": "string"},
                },
            },
        },
        "entities": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "timestamp": _TIME,
                    "frame_id": {"type": "string"},
                    "id": {"type": "string"},
                    "lifetime": _TIME,
                    "frame_locked": {"type": "boolean"},
                    "metadata": {"type": "array", "items": {"type": "object"}},
                    "cubes": {"type": "array", "items": {"type": "object"}},
                },
            },
        },
    },
}
_EVENT_SCHEMA = {
    "title": _EVENT,
    "type": "object",
    "properties": {
        "tick": {"type": "integer"},
        "kind": {"type": "string"},
        "vehicle": {"type": "integer"},
        "agent": {"type": "integer"},
        "detail": {"type": "string"},
    },
}


def _channel(writer: Any, topic: str, name: str, schema: dict[str, Any]) -> int:
    data = json.dumps(schema).encode()
    known = writer.register_schema(name=name, encoding="jsonschema", data=data)
    return int(writer.register_channel(topic=topic, message_encoding="json", schema_id=known))


def _write(writer: Any, channel: int, now_ns: int, message: dict[str, Any]) -> None:
    data = json.dumps(message).encode()
    writer.add_message(channel, log_time=now_ns, data=data, publish_time=now_ns)


@contextmanager
def _opened(path: Path, mode: str, **form: Any) -> Iterator[IO[Any]]:
    try:
        with path.open(mode, **form) as file:
            yield file
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextmanager
def _writing(path: Path) -> Iterator[IO[str]]:
    with _opened(path, "w", encoding="utf-8", newline="") as file:
        yield file
