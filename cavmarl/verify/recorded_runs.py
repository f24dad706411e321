"""Repeat a recorded run from its inputs, without drivers and clients, and compare the states."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.config.env import EnvConfig, MapConfig
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, RecordingError
from cavmarl.core.scene_names import is_scene_file
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.recorded_inputs import INPUTS, RESET, command_names, commands_of, inputs_dtype
from cavmarl.recordings.recording import Recording
from cavmarl.verify.recorded_command_check import seed_of, wrong_inputs

_MAY_DIFFER = ("zones", "workers", "nodes")  # keys that do not affect results
_MOST_SHOWN = 5


@dataclass(frozen=True)
class RepeatedRun:
    """The result of `repeat_recording`."""

    environment: str
    episodes: int  # number of repeated episodes
    steps: int  # number of repeated steps
    state_hash: str  # hash of the state at the end
    # first step (from 0 over all episodes) whose state differs, and its tick; None: all are equal
    first_difference: tuple[int, int] | None


def repeat_recording(
    path: str | Path,
    spec: WorldSpec,
    *,
    zones: int | None = None,
    backend: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RepeatedRun:
    """Repeat a run from a recording with the table `commands`.

    Args:
        path: folder of the recording.
        spec: the recorded world. Its zones may differ.
        zones: number of zones.
        backend: where the world runs.
        workers: number of worker processes.
        progress: called after each step with its number and the number of all steps.

    Raises:
        ConfigError: the recording has no commands, or belongs to another world.
        RecordingError: the recording cannot be read, or does not begin with a reset.
    """
    recording = Recording.open(path)
    if INPUTS not in recording.extras:
        raise ConfigError(
            f"{path}: has no commands, so it cannot be repeated; record with --record-also "
            f"{INPUTS}, or RecordOptions(path, include=('{INPUTS}',))"
        )
    rows = recording.extra(INPUTS)
    if not len(rows) or rows["kind"][0] != RESET or not rows["seed"][0]:
        raise RecordingError(
            f"{path}: does not begin with a reset with a seed; start to record before reset(seed=…)"
        )
    made = parallel_env(spec.env, zones=zones, backend=backend, workers=workers, **spec.keywords)
    with closing(made):
        _check_world(recording, made)
        return _repeat(path, made, rows, progress)


def _repeat(
    path: str | Path, made: CavEnv, rows: Any, progress: Callable[[int, int], None] | None
) -> RepeatedRun:
    worlds, agents = made.worlds, made.config.population.num_ids
    no_controls, no_choices = np.zeros((1, agents, 2)), np.zeros((1, agents), dtype=np.int64)
    _check_inputs(path, made, rows)
    difference, episodes = None, 0
    for step, row in enumerate(rows):
        if row["kind"] == RESET:
            worlds.arrays.chosen[:] = True
            worlds.reset(seed_of(row), 0)
            episodes += 1
        else:
            worlds.step(commands_of(row, no_controls, no_choices))
        if worlds.state_hash(0) != row["state_hash"]:
            difference = step, int(row["tick"])
            break
        if progress is not None:
            progress(step, len(rows))
    return RepeatedRun(
        environment=f"{made.config.name}-v{made.config.version}",
        episodes=episodes,
        steps=step + 1 - episodes,
        state_hash=worlds.state_hash(0),
        first_difference=difference,
    )


def _check_inputs(path: str | Path, made: CavEnv, rows: Any) -> None:
    """Raise RecordingError if the world cannot carry out the commands of a recording."""
    given, expected = rows.dtype, inputs_dtype(made.config, made.worlds.arrays)
    wanted = set(expected.names or ())
    differing = wanted ^ {*(wanted & set(given.names or ())), *command_names(given)}
    differing |= {name for name in wanted - differing if given[name] != expected[name]}
    if differing:
        raise RecordingError(
            f"{path}: the column {min(differing)} of its commands does not fit this world: it is "
            "damaged, or of another version of cavmarl; record the run again"
        )
    controlled, num_choices = made.config.controlled, None
    if controlled is not None:
        places = made.signals if controlled is made.config.signals else made.limits
        num_choices = places.num_choices
    if wrong := wrong_inputs(rows, made.network, num_choices):
        raise RecordingError(f"{path}: its commands are damaged: {wrong}; get the recording again")


def _check_world(recording: Recording, made: CavEnv) -> None:
    """Raise ConfigError if the environment is not the recorded one."""
    world = recording.manifest["world"]
    if world.get("map_source_sha256") != made.network.source_hash:
        raise ConfigError(
            f"{recording.path}: was recorded on another map than that of {made.config.name}; name "
            f"the environment of the recording, {recording.head.environment}"
        )
    recorded, present = _keys_of(world.get("config", {})), _keys_of(_plain(made.config))
    defaults = _keys_of(_plain(EnvConfig(name="", map=MapConfig(source="map"))))
    for name in present.keys() - recorded.keys():  # keys that did not exist for the recording
        if name in defaults:
            recorded[name] = defaults[name]
    for keys in (recorded, present):  # logged scenes, like maps, may be in other folders now
        if is_scene_file(str(keys.get("scenario.name"))):
            keys["scenario.name"] = Path(str(keys["scenario.name"])).name
    names = sorted(recorded.keys() | present.keys())
    differing = [
        f"{name} = {present.get(name)}, recorded with {recorded.get(name)}"
        for name in names
        if recorded.get(name) != present.get(name)
    ]
    if differing:
        shown = "; ".join(differing[:_MOST_SHOWN])
        more = f"; and {len(differing) - _MOST_SHOWN} more" if len(differing) > _MOST_SHOWN else ""
        raise ConfigError(
            f"{recording.path}: was recorded in another world: {shown}{more}; pass the settings of "
            "the recording (--set)"
        )


def _plain(config: EnvConfig) -> dict[str, Any]:
    """Return a configuration with lists in place of tuples, as in JSON."""
    found: dict[str, Any] = json.loads(json.dumps(asdict(config)))
    return found


def _keys_of(sections: Any, start: str = "") -> dict[str, Any]:
    """Return all values that affect results, by dotted key."""
    found: dict[str, Any] = {}
    for name, value in sections.items():
        if not start and name in _MAY_DIFFER:
            continue
        if isinstance(value, dict):
            found |= _keys_of(value, f"{start}{name}.")
        else:
            found[f"{start}{name}"] = value
    return found
