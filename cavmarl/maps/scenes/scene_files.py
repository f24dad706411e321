"""Reads scene files: pickles of ScenarioNet (`.pkl`) and JSON files of GPUDrive (`.json`).

The fields are described at https://metadriverse.github.io/scenarionet and in GPUDrive's
`data_utils`. Positions stay in the frame of the file.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import cos_all, hypot_all, sin_all
from cavmarl.core.scene_names import is_scene_file
from cavmarl.maps.scenes.logged_scene import (
    FARTHEST_M,
    KINDS,
    LoggedScene,
    Numbers,
    SceneLane,
    Track,
    checked_track,
    count_overlaps,
    without_jumps,
)
from cavmarl.maps.scenes.scene_pickle import unpickle

MOST_BYTES = 1 << 26
MOST_TIMES = 100_000
MOST_TRACKS = 4_000  # 900 in Waymo's scenes
# Limit of the samples of all tracks together. MOST_BYTES does not bound them, because tracks in a
# pickle may share arrays.
MOST_SAMPLES = 10_000_000
GPUDRIVE_STEP_S = 0.1  # not stated in the file; Waymo's motion data set has 10 Hz
_MOVING_MPS = 2.0  # above this speed, the heading fits the direction of the motion
_ALONG_COS, _MOST_MISFITS = 0.97, 0.05  # 14°; allowed share of points beyond this angle
# Units of `speed_limit_UNIT`: Waymo states the first two, and nuPlan the last one.
_MPS_PER_UNIT = (("kmh", 1.0 / 3.6), ("mph", 0.44704), ("mps", 1.0))
_SIZES_M = {"vehicle": (4.5, 1.9, 1.6), "pedestrian": (0.5, 0.5, 1.75), "cyclist": (1.8, 0.7, 1.7)}
_GPUDRIVE_FREEWAY, _GPUDRIVE_BIKE_LANE = 1, 3  # map_element_id

_KNOWN = "a ScenarioNet scene (.pkl) or a scene of GPUDrive (.json)"


# Scenes by the hash of their files, because a world reads its scene several times.
_SCENES: dict[str, LoggedScene] = {}
_KEPT = 8


def _parsed(path: Path, content: bytes) -> LoggedScene:
    if path.name.endswith(".pkl"):
        return _scenarionet(unpickle(content))
    try:
        return _gpudrive(json.loads(content))
    except (ValueError, RecursionError) as error:
        raise MapError(f"broken JSON ({str(error)[:200]}): export the scene again") from error


def read_scene(path: str | Path) -> LoggedScene:
    """Read a scene file.

    Raises MapError: the file cannot be read, is broken, refers to code, or is not a scene; or a
    track or a lane is invalid.
    """
    path = Path(path)
    if not is_scene_file(path.name):
        raise MapError(f"{path}: not a scene file: give {_KNOWN}")
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise MapError(f"has {size} bytes, more than {MOST_BYTES}: cut the scene into parts")
        content = path.read_bytes()
        key = hashlib.sha256(content).hexdigest() + path.suffix
        if key not in _SCENES:
            scene = _parsed(path, content)
            while len(_SCENES) >= _KEPT:
                del _SCENES[next(iter(_SCENES))]
            _SCENES[key] = scene
        return _SCENES[key]
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
    except OSError as error:
        raise MapError(
            f"{path}: cannot be read ({error.strerror or error}): give {_KNOWN}"
        ) from error


class _Counts:
    """Counts omissions, guesses and changes."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, what: str, count: int = 1) -> None:
        self._counts[what] += count

    def notes(self) -> tuple[str, ...]:
        return tuple(f"{count} {what}" for what, count in sorted(self._counts.items()) if count)


def _scenarionet(scene: Any) -> LoggedScene:
    """Return the scene of ScenarioNet's dictionary."""
    scene = _mapping(scene, "the scene")
    counts = _Counts()
    meta = _mapping(scene.get("metadata", {}), "metadata")
    length = scene.get("length")
    if not isinstance(length, int | np.integer) or not 1 <= length <= MOST_TIMES:
        raise MapError(f"length = {length!r}: must be a whole number from 1 to {MOST_TIMES}")
    length = int(length)
    step_s = _step_of(meta.get("ts"), length)
    _check_size(len(_mapping(scene.get("tracks"), "tracks")), length)
    tracks = []
    for name, entry in _mapping(scene.get("tracks"), "tracks").items():
        track = _scenarionet_track(str(name), _mapping(entry, f"track '{name}'"), length, counts)
        if track is not None:
            tracks.append(track)
    lanes, edges = [], []
    for name, entry in _mapping(scene.get("map_features"), "map_features").items():
        entry = _mapping(entry, f"map feature '{name}'")
        kind = str(entry.get("type", ""))
        if kind == "ROAD_EDGE_SIDEWALK" and "polyline" not in entry:
            counts.add("sidewalks ignored")  # areas, with a polygon instead of a line
        elif kind.startswith("ROAD_EDGE"):
            edges.append(_points(entry.get("polyline"), f"road edge '{name}'", 2))
        elif not kind.startswith("LANE"):
            counts.add(_ignored(kind.startswith("ROAD_LINE"), kind))
        elif "BIKE" in kind:
            counts.add("bicycle lanes ignored")
        else:
            lanes.append(_scenarionet_lane(str(name), entry, "FREEWAY" in kind))
    if _have_headings(lanes):
        flat = [np.concatenate([lane.points[:, :2], 0.0 * lane.points[:, 2:]], 1) for lane in lanes]
        lanes = [lane._replace(points=points) for lane, points in zip(lanes, flat, strict=True)]
        counts.add("lanes with headings in place of heights: height 0", len(lanes))
    if lights := len(_mapping(scene.get("dynamic_map_states") or {}, "dynamic_map_states")):
        counts.add("traffic lights ignored", lights)
    own = str(meta.get("sdc_id", ""))
    present = meta.get("current_time_index", 0)
    return _scene(
        str(scene.get("id", "")),
        step_s,
        lanes,
        edges,
        tracks,
        own,
        int(present) if isinstance(present, int | np.integer) and 0 <= present < length else 0,
        counts,
    )


def _scenarionet_track(
    name: str, entry: Mapping[str, Any], length: int, counts: _Counts
) -> Track | None:
    kind = str(entry.get("type", "")).lower()
    if kind not in KINDS:
        counts.add(f"tracks of type {entry.get('type')!s:.40} ignored")
        return None
    state = _mapping(entry.get("state"), f"state of track '{name}'")
    where = f"of track '{name}'"
    position = _array(state.get("position"), f"position {where}", length, (2, 3))
    heading = _array(state.get("heading"), f"heading {where}", length, (1,))
    valid = np.ones(length, dtype=np.bool_)
    if "valid" in state:
        valid = _array(state["valid"], f"valid {where}", length, (1,))[:, 0] > 0.5
    sizes = []
    for number, key in enumerate(("length", "width", "height")):
        if key in state:
            sizes.append(_array(state[key], f"{key} {where}", length, (1,)))
        else:
            counts.add(f"tracks without {key}: default of their type")
            sizes.append(np.full((length, 1), _SIZES_M[kind][number]))
    poses = np.concatenate([position[:, :2], heading], axis=1)
    return checked_track(name, kind, poses, valid, np.concatenate(sizes, axis=1))


def _scenarionet_lane(name: str, entry: Mapping[str, Any], is_freeway: bool) -> SceneLane:
    limits = ((_number(entry.get(f"speed_limit_{unit}")), factor) for unit, factor in _MPS_PER_UNIT)
    speed = next((value * factor for value, factor in limits if value is not None), None)
    exits = entry.get("exit_lanes")
    return SceneLane(
        name,
        _points(entry.get("polyline"), f"lane '{name}'", 3),
        is_freeway,
        speed,
        None,
        tuple(map(str, exits)) if isinstance(exits, list | tuple | np.ndarray) else None,
    )


def _have_headings(lanes: Sequence[SceneLane]) -> bool:
    """Return whether the third column of the lanes is their direction, as in scenes of nuScenes."""
    apart = []
    for lane in lanes:
        moves = np.diff(lane.points, axis=0)
        length = hypot_all(moves[:, 0], moves[:, 1])
        moves, headings = moves[length > 0.0], lane.points[:-1, 2][length > 0.0]
        along = moves[:, 0] * cos_all(headings) + moves[:, 1] * sin_all(headings)
        apart.append(along < _ALONG_COS * length[length > 0.0])
    far = np.concatenate([np.zeros(0, dtype=np.bool_), *apart])
    is_flat = all((lane.points[:, 2] == lane.points[0, 2]).all() for lane in lanes)
    return not is_flat and float(np.mean(far)) < _MOST_MISFITS


def _number(value: Any) -> float | None:
    """Return a speed limit; None: not stated."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, complex)
    return float(value) if is_number and 0.0 < value < 1000.0 else None


def _step_of(stamps: Any, length: int) -> float:
    """Return the time between two samples."""
    if length == 1:
        return GPUDRIVE_STEP_S
    given = _array(stamps, "metadata.ts", length, (1,))[:, 0]
    steps = np.diff(given)
    step_s = float(np.median(steps))
    if not (np.isfinite(given).all() and 1e-3 <= step_s <= 10.0):
        raise MapError(
            f"metadata.ts: its steps are {step_s:g} s: must be ascending seconds, 0.001 to 10 apart"
        )
    if not (np.abs(steps - step_s) <= 0.2 * step_s).all():
        raise MapError(
            "metadata.ts: the samples are not evenly spaced: resample the scene to a constant rate"
        )
    return round(step_s, 3)


def _gpudrive(scene: Any) -> LoggedScene:
    """Return the scene of a JSON document of GPUDrive."""
    scene = _mapping(scene, "the scene")
    counts = _Counts()
    meta = _mapping(scene.get("metadata") or {}, "metadata")
    entries = _list(scene.get("objects"), "objects")
    own, tracks = "", []
    own_number = meta.get("sdc_track_index", -1)
    parts = [_gpudrive_object(number, entry, counts) for number, entry in enumerate(entries)]
    lengths = {len(part[2]) for part in parts if part is not None}
    if len(lengths) > 1:
        raise MapError(
            f"objects have {sorted(lengths)[:5]} samples: must all have the same number; pad them "
            "with samples that are not valid"
        )
    _check_size(len(parts), max(lengths, default=0))
    factor = _heading_unit([part for part in parts if part is not None])
    if factor != 1.0:
        counts.add("scene with headings in degrees, as their directions of motion show")
    for number, (part, entry) in enumerate(zip(parts, entries, strict=True)):
        if part is None:
            continue
        name, kind, poses, valid, sizes = part
        poses[:, 2] *= factor
        track = checked_track(name, kind, poses, valid, sizes)
        if track is not None:
            tracks.append(track)
            own = name if entry.get("is_sdc") or number == own_number else own
    lanes, edges = [], []
    for number, entry in enumerate(_list(scene.get("roads"), "roads")):
        entry = _mapping(entry, f"road {number}")
        kind, name = str(entry.get("type", "")), str(entry.get("id", number))
        if kind == "road_edge":
            edges.append(_xyz(entry.get("geometry"), f"road edge '{name}'")[:, :2])
        elif kind != "lane":
            counts.add(_ignored(kind == "road_line", kind))
        elif entry.get("map_element_id") == _GPUDRIVE_BIKE_LANE:
            counts.add("bicycle lanes ignored")
        else:
            points = _xyz(entry.get("geometry"), f"lane '{name}'")
            is_freeway = entry.get("map_element_id") == _GPUDRIVE_FREEWAY
            lanes.append(SceneLane(name, points, is_freeway, None, None, None))
    if lights := len(_mapping(scene.get("tl_states") or {}, "tl_states")):
        counts.add("traffic lights ignored", lights)
    name = str(scene.get("scenario_id") or scene.get("name") or "")
    return _scene(name, GPUDRIVE_STEP_S, lanes, edges, tracks, own, 0, counts)


_Object = tuple[str, str, Numbers, NDArray[np.bool_], Numbers]


def _gpudrive_object(number: int, entry: Any, counts: _Counts) -> _Object | None:
    """Return name, kind, poses, validity and size of an object; headings as in the file."""
    entry = _mapping(entry, f"object {number}")
    kind, name = str(entry.get("type", "")), str(entry.get("id", number))
    if kind not in KINDS:
        counts.add(f"objects of type {kind[:40]} ignored")
        return None
    where = f"of object '{name}'"
    position = _xyz(entry.get("position"), f"position {where}", least=1)
    length = len(position)
    heading = _array(entry.get("heading"), f"heading {where}", length, (1,))
    valid = _array(entry.get("valid"), f"valid {where}", length, (1,))[:, 0] > 0.5
    sizes = [entry.get(key) for key in ("length", "width", "height")]
    for place, size in enumerate(sizes):
        if size is None:
            key = ("length", "width", "height")[place]
            counts.add(f"tracks without {key}: default of their type")
            sizes[place] = _SIZES_M[kind][place]
        elif not isinstance(size, int | float):
            raise MapError(f"size {where}: must be numbers, is {str(size)[:40]!r}")
    poses = np.concatenate([position[:, :2], heading], axis=1)
    return name, kind, poses, valid, _array([sizes], f"size {where}", 1, (3,))


def _heading_unit(parts: Sequence[_Object]) -> float:
    """Return 1, or π / 180 if the headings are in degrees.

    Versions of the format differ. The result is the unit in which headings fit the directions of
    motion better; without motion, degrees if a heading is above 2 π.
    """
    misfit = {1.0: 0.0, np.pi / 180.0: 0.0}
    largest, count = 0.0, 0
    for _, kind, poses, valid, _ in parts:
        largest = max(largest, float(np.abs(poses[valid, 2]).max(initial=0.0)))
        if kind != "vehicle":
            continue
        moves = np.diff(poses[:, :2], axis=0)
        length = np.sqrt(moves[:, 0] * moves[:, 0] + moves[:, 1] * moves[:, 1])
        moving = valid[1:] & valid[:-1] & (length > _MOVING_MPS * GPUDRIVE_STEP_S)
        count += int(np.count_nonzero(moving))
        for factor in misfit:
            heading = poses[1:, 2][moving] * factor
            along = moves[moving, 0] * cos_all(heading) + moves[moving, 1] * sin_all(heading)
            misfit[factor] += float((1.0 - along / length[moving]).sum())
    if not count:
        return np.pi / 180.0 if largest > 2.0 * np.pi + 1e-3 else 1.0
    return min(misfit, key=lambda factor: misfit[factor])


def _ignored(is_line: bool, kind: str) -> str:
    return "road lines ignored" if is_line else f"map features of type {kind[:40]} ignored"


def _scene(
    name: str,
    step_s: float,
    lanes: list[SceneLane],
    edges: list[Numbers],
    tracks: list[Track],
    own: str,
    present: int,
    counts: _Counts,
) -> LoggedScene:
    names = [track.name for track in tracks]
    if twice := [name for name, number in Counter(names).items() if number > 1]:
        raise MapError(f"two tracks are named '{twice[0][:80]}': ids must be unique")
    if not tracks:
        raise MapError(
            "no track of a vehicle, pedestrian or cyclist is ever valid: export a scene with tracks"
        )
    if not lanes:
        raise MapError(
            "no lane for motor vehicles: export the scene with the centre lines of its lanes"
        )
    tracks, jumps = without_jumps(tracks, step_s)
    counts.add("jumps of over 60 m/s, at which tracks were cut", jumps)
    counts.add("pairs of tracks overlap at some time", count_overlaps(tracks))
    edges = [edge for edge in edges if len(edge) >= 2]
    return LoggedScene(name, step_s, lanes, edges, tracks, own, present, counts.notes())


def _check_size(tracks: int, length: int) -> None:
    if tracks > MOST_TRACKS or tracks * length > MOST_SAMPLES:
        raise MapError(
            f"{tracks} tracks of {length} samples: must be at most {MOST_TRACKS} tracks, and "
            f"{MOST_SAMPLES} samples in total; cut the scene into parts"
        )


def _mapping(value: Any, what: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise MapError(f"{what}: must be a mapping, is {type(value).__name__}: give {_KNOWN}")
    return value


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise MapError(f"{what}: must be a list, is {type(value).__name__}: give {_KNOWN}")
    return value


def _numbers(value: Any, what: str) -> Numbers:
    """Return an array; rows of lists have at most 3 numbers.

    In a pickle, nested lists that share elements could expand to any amount of memory.
    """
    try:
        if isinstance(value, list | tuple) and not all(map(_is_row, value)):
            raise ValueError("long rows")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MapError(f"{what}: must be an array of numbers; export the scene again") from error


def _is_row(value: object) -> bool:
    """Return whether a value is a number or has at most 3 numbers."""
    if isinstance(value, list | tuple):
        return len(value) <= 3 and not any(
            isinstance(one, list | tuple | np.ndarray) for one in value
        )
    return not isinstance(value, np.ndarray) or value.size <= 3


def _array(value: Any, what: str, length: int, columns: tuple[int, ...]) -> Numbers:
    """Return numbers (length, one of `columns`)."""
    found = _numbers(value, what)
    if found.ndim == 1 and columns == (1,):
        found = found[:, None]
    if found.ndim != 2 or found.shape[0] != length or found.shape[1] not in columns:
        raise MapError(
            f"{what}: has the shape {np.shape(value)}: must have {length} rows of "
            f"{' or '.join(map(str, columns))} numbers"
        )
    return found


def _points(value: Any, what: str, columns: int) -> Numbers:
    """Return the points (n, columns) of a polyline; missing heights are 0."""
    found = _numbers(value, what)
    if found.ndim != 2 or found.shape[1] not in (2, 3) or not len(found):
        raise MapError(f"{what}: has the shape {found.shape}: must have points x, y (z)")
    if not (np.abs(found) <= FARTHEST_M).all():
        raise MapError(f"{what}: a point is not finite, or beyond {FARTHEST_M:g} m: correct it")
    if found.shape[1] < columns:
        found = np.concatenate([found, np.zeros((len(found), 1))], axis=1)
    return found[:, :columns]


def _xyz(value: Any, what: str, least: int = 1) -> Numbers:
    """Return (n, 3) of a list of mappings with x, y and perhaps z."""
    points = _list(value, what)
    if len(points) < least or len(points) > MOST_TIMES:
        raise MapError(f"{what}: has {len(points)} points: must have 1 to {MOST_TIMES}")
    try:
        rows = [(float(p["x"]), float(p["y"]), float(p.get("z", 0.0))) for p in points]
    except (TypeError, KeyError, ValueError, AttributeError, OverflowError) as error:
        raise MapError(f"{what}: each point must have the numbers x and y") from error
    found = np.array(rows, dtype=np.float64)
    if what.startswith(("lane", "road edge")):
        return _points(found, what, 3)
    return found
