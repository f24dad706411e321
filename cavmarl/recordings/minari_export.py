"""Export of recorded trips as a data set of Minari (https://minari.farama.org).

The layout is Minari's storage "arrow": a file data/metadata.json, and for each episode a folder
data/N with the file metadata.json and an Arrow file. An episode of Minari is a recorded trip.
Minari's class MinariDataset reads the folder data.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, RecordingError, require
from cavmarl.engine.spaces import action_space, flat_observation_space
from cavmarl.recordings.offline_data import RecordedTrip, recorded_trips, settings_of
from cavmarl.recordings.recording import Recording

MINARI_VERSION = "0.5.4"  # version of Minari that defines the layout
DATA_FOLDER = "data"
_METADATA_FILE = "metadata.json"


def write_minari(recording: Recording, folder: Path) -> tuple[int, int]:
    """Write all trips of a recording to a new folder; return the number of trips and of decisions.

    The metadata of the data set contain the names of the environment, the observed numbers and the
    reward terms. The metadata of a trip contain its world, episode, agent and vehicle.

    Raises:
        ConfigError: the folder exists and is not empty, or cannot be written.
        RecordingError: the recording cannot be read, has no observations or no whole trip, or its
            observations and actions do not match its settings.
        MissingExtraError: pyarrow is not installed.
    """
    arrow = require("pyarrow", "record")
    config = settings_of(recording)
    trips = recorded_trips(recording)
    first = next(trips, None)
    if first is None:
        raise RecordingError(
            f"{recording.path}: no agent made a decision; record a run of several steps"
        )
    observed, acted = flat_observation_space(config), action_space(config.action)
    shapes = first.observations.shape[1:], first.actions.shape[1:], first.actions.dtype.kind == "i"
    if shapes != (observed.shape, acted.shape, isinstance(acted, spaces.Discrete)):
        raise RecordingError(
            f"{recording.path}: its observations and actions do not match the settings in its "
            "manifest; use the version of cavmarl that wrote it, or record the run again"
        )
    data = folder / DATA_FOLDER
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(f"{folder}: exists and is not an empty folder; give a new one")
        data.mkdir(parents=True)
        count, steps = _write_trips(arrow, data, chain([first], trips))
        document = {
            "dataset_id": _dataset_id(recording.head.environment),
            "minari_version": MINARI_VERSION,
            "data_format": "arrow",
            "jpeg_encoding": False,
            "total_episodes": count,
            "total_steps": steps,
            "observation_space": _space(observed),
            "action_space": _space(acted),
            "dataset_size": _megabytes(data),
            "description": f"Recorded by cavmarl in the environment {recording.head.environment}.",
            "cavmarl_environment": recording.head.environment,
            "cavmarl_features": list(recording.head.features),
            "cavmarl_terms": list(recording.head.terms),
            "cavmarl_step_s": recording.head.step_s,
        }
        _write_json(data / _METADATA_FILE, document)
    except OSError as error:
        raise ConfigError(
            f"{folder}: cannot be written ({error.strerror or error}); give a new folder in a "
            "place with free space that you can write"
        ) from error
    return count, steps


def _write_trips(arrow: Any, data: Path, trips: Iterable[RecordedTrip]) -> tuple[int, int]:
    """Write trips; return their number and the number of decisions."""
    count = steps = 0
    for trip in trips:
        own = data / str(count)
        own.mkdir()
        table = _table(arrow, trip)
        with arrow.OSFile(str(own / "part-0.arrow"), "wb") as file:
            with arrow.ipc.new_file(file, table.schema) as writer:
                writer.write_batch(table)
        decisions = len(trip.rewards)
        facts = {"id": count, "total_steps": decisions}
        names = ("world", "episode", "agent", "vehicle")
        facts |= {f"cavmarl_{name}": getattr(trip, name) for name in names}
        _write_json(own / _METADATA_FILE, facts)
        count, steps = count + 1, steps + decisions
    return count, steps


def _table(arrow: Any, trip: RecordedTrip) -> Any:
    """Return the rows of a trip; the last row has only an observation, its other columns are 0."""
    ended = np.zeros((2, len(trip.ticks)), dtype=np.bool_)
    ended[:, -2] = trip.terminated, trip.truncated
    columns = {
        "observations": _lists(arrow, trip.observations),
        "actions": _lists(arrow, _padded(trip.actions)),
        "rewards": arrow.array(_padded(trip.rewards)),
        "terminations": arrow.array(ended[0]),
        "truncations": arrow.array(ended[1]),
    }
    terms = _lists(arrow, _padded(trip.terms))
    infos = arrow.StructArray.from_arrays([arrow.array(trip.ticks), terms], names=["tick", "terms"])
    return arrow.RecordBatch.from_pydict({**columns, "infos": infos})


def _padded(rows: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([rows, np.zeros_like(rows[:1])])


def _lists(arrow: Any, rows: NDArray[Any]) -> Any:
    """Return an Arrow array of numbers (n,), or of lists (n, k)."""
    if rows.ndim == 1:
        return arrow.array(rows)
    flat = arrow.array(np.ascontiguousarray(rows).reshape(-1))
    return arrow.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def _space(space: spaces.Space[Any]) -> str:
    """Return a space as Minari writes it."""
    if isinstance(space, spaces.Discrete):
        facts = {"type": "Discrete", "dtype": "int64", "start": int(space.start), "n": int(space.n)}
    else:
        assert isinstance(space, spaces.Box)
        facts = {
            "type": "Box",
            "dtype": str(space.dtype),
            "shape": list(space.shape),
            "low": space.low.tolist(),
            "high": space.high.tolist(),
        }
    return json.dumps(facts)


def _dataset_id(environment: str) -> str:
    """Return Minari's name of the data set: `cavmarl/merge/recorded-v6` for `merge-v6`."""
    name, _, version = environment.rpartition("-v")
    return f"cavmarl/{re.sub(r'[^A-Za-z0-9_-]+', '-', name)}/recorded-v{version}"


def _megabytes(folder: Path) -> float:
    return round(sum(file.stat().st_size for file in folder.rglob("*")) / 1e6, 1)


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document) + "\n", encoding="utf-8")
