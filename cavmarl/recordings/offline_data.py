"""Recorded trips as data for offline learning: observations, actions, rewards, and how trips end.

The data come from the table `observations` of a recording (`RecordOptions.include`). A trip is the
drive of one vehicle of an agent, starting with its first recorded observation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import validate
from cavmarl.core.errors import ConfigError, RecordingError
from cavmarl.recordings.recording import Recording
from cavmarl.recordings.recording_format import dtype_of

TABLE = "observations"
_FLAGS = ("acted", "terminated", "truncated")
_ACTIONS = (np.dtype(("<f4", (2,))), np.dtype("<i8"))  # throttle and steering, or a choice


class RecordedTrip(NamedTuple):
    """The N decisions of one vehicle of an agent, and N + 1 observations."""

    world: int
    episode: int
    agent: int
    vehicle: int
    ticks: NDArray[np.int64]  # (N + 1,) ticks of the observations
    observations: NDArray[np.float32]  # (N + 1, D) flat observations
    actions: NDArray[Any]  # (N, 2) float32 throttle and steering, or (N,) int64 choices
    rewards: NDArray[np.float32]  # (N,)
    terms: NDArray[np.float32]  # (N, T) reward terms, named in `Recording.head.terms`
    terminated: bool  # the trip ended by an event of the vehicle
    truncated: bool  # the trip was cut: by a horizon, a reset, or the end of the recording


def recorded_trips(recording: Recording) -> Iterator[RecordedTrip]:
    """Yield the trips of all worlds, by world, episode, agent and vehicle.

    A trip is either terminated or truncated. Trips without a complete decision are left out. Only
    one episode is in memory at a time.

    Raises:
        RecordingError: the recording has no observations, or was made by a version that did not
            record actions, or a part is missing or damaged.
    """
    _check_columns(recording)
    for world in recording.worlds:
        for episode, rows in recording.extra_by_episode(TABLE, world):
            order = np.lexsort((rows["tick"], rows["vehicle"], rows["agent"]))
            rows = rows[order]
            begins = ~rows["acted"]
            for name in ("agent", "vehicle"):
                begins[1:] |= rows[name][1:] != rows[name][:-1]
            for own in np.split(rows, np.flatnonzero(begins)):
                if len(own) > 1:
                    yield _trip(world, episode, own)


def settings_of(recording: Recording) -> EnvConfig:
    """Return the configuration of the recorded environment.

    Raises RecordingError: this version cannot read the configuration.
    """
    try:
        settings = recording.manifest["world"]["config"]
        return validate(EnvConfig, settings, f"{recording.path}")
    except (ConfigError, KeyError, TypeError) as error:
        faults = "; ".join(str(error).splitlines())
        raise RecordingError(
            f"{recording.path}: its manifest has no settings that this version can read "
            f"({faults}); use the version of cavmarl that wrote it, or record the run again"
        ) from error


def _check_columns(recording: Recording) -> None:
    columns = recording.head.extras.get(TABLE, ())
    kinds = dtype_of(columns)
    if not columns:
        raise RecordingError(
            f"{recording.path}: has no observations; record the run again with --record-also "
            'observations, or RecordOptions(path, include=("observations",))'
        )
    if missing := [name for name in (*_FLAGS, "action") if name not in (kinds.names or ())]:
        raise RecordingError(
            f"{recording.path}: its observations have no {missing[0]}, because an earlier version "
            "of cavmarl recorded them; record the run again"
        )
    wanted = dict.fromkeys(_FLAGS, (np.dtype(np.bool_),)) | {"action": _ACTIONS}
    for name, allowed in wanted.items():
        if kinds[name] not in allowed:
            raise RecordingError(
                f"{recording.path}: column {name} of its observations has the type {kinds[name]}; "
                "the recording is damaged: get it again"
            )


def _trip(world: int, episode: int, rows: NDArray[np.void]) -> RecordedTrip:
    """Return the trip of rows (N + 1,): an observation each, and the decision that led to it."""
    after = rows[1:]
    # A vehicle that left at the horizon of its trip has both flags; its trip counts as truncated.
    terminated = bool(after["terminated"][-1] and not after["truncated"][-1])
    return RecordedTrip(
        world,
        episode,
        int(rows["agent"][0]),
        int(rows["vehicle"][0]),
        rows["tick"].copy(),
        rows["values"].copy(),
        after["action"].copy(),
        after["reward"].copy(),
        after["terms"].copy(),
        terminated,
        not terminated,
    )
