"""Observation and action spaces, computed from the configuration without building a world."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike, NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.config.env import EnvConfig
from cavmarl.config.rig import samples_per_step
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.math.elementary_arrays import cos_all, sin_all
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.sensors.observed import layout, sensors_of
from cavmarl.sensors.observed.feature import Feature
from cavmarl.sensors.registry import type_of

# Features of one vehicle in the global state: present, x, y, cos, sin, speed.
STATE_FEATURES = 6
STATE_SPEED_MPS = 40.0  # the speed that the global state scales to 1


def _box(size: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


def flat_observation_space(config: EnvConfig) -> spaces.Box:
    """Return one Box of all features of all sensors, for any `observation.kind`.

    Scaled features are within [-1, 1]. With `sensors.stack`, frames follow one another, oldest
    first. In the mode `sensors`, the Box has the samples of the rig, in the order of its sensors.
    """
    if config.observation.mode == "sensors":
        boxes = [_frame_box(config, name) for name in config.rig]
        low = np.concatenate([box.low.ravel() for box in boxes]).astype(np.float32)
        high = np.concatenate([box.high.ravel() for box in boxes]).astype(np.float32)
        return spaces.Box(low, high, dtype=np.float32)
    features = [
        feature
        for sensor in sensors_of(config.sensors)
        for feature in sensor.features(config.sensors)
    ]
    stack = config.sensors.stack
    return _feature_box(features * stack, (stack * len(features),), np.float32)


def frames_space(config: EnvConfig, sensors: Iterable[str] | None = None) -> spaces.Dict:
    """Return a Dict with one Box per sensor of the rig, for its latest samples.

    If a sensor takes several samples in a step, they are the first axis.

    `sensors`: names of the sensors; None: all sensors of the rig.
    """
    names = config.rig if sensors is None else sensors
    return spaces.Dict({name: _frame_box(config, name) for name in names})


def observation_spaces(
    config: EnvConfig, agents: Sequence[str]
) -> dict[str, spaces.Box | spaces.Dict]:
    """Return the space of each agent's observation, by agent.

    They differ only if `population.fleet` gives them different sensors and an observation is a Dict
    of samples. A flat observation has zeros for sensors that a vehicle does not carry.
    """
    form = config.observation
    if not (config.population.fleet and form.mode == "sensors" and form.kind == "dict"):
        return dict.fromkeys(agents, observation_space(config))
    parts = [
        frames_space(config, [n for n in config.rig if part.rig is None or n in part.rig])
        for part in config.population.fleet
    ]
    return {
        agent: parts[part]
        for agent, part in zip(agents, config.population.part_of_agents.tolist(), strict=True)
    }


def _frame_box(config: EnvConfig, name: str) -> spaces.Box:
    sensor, clock = config.rig[name], config.clock
    kind = type_of(name, sensor)
    slots = samples_per_step(sensor, clock.sim_dt_s, clock.ticks_per_step)
    shape = (slots, *sensor.shape) if slots > 1 else sensor.shape
    dtype = np.dtype(kind.dtype).type
    low, high = (np.broadcast_to(bound, shape).astype(dtype) for bound in kind.bounds(sensor))
    return spaces.Box(low, high, shape, dtype)


def observation_space(config: EnvConfig) -> spaces.Box | spaces.Dict:
    """Return the space of one agent's observation: a flat Box, or a Dict with one Box per sensor.

    With `sensors.stack` the Boxes of a Dict have the frames as their first axis.
    """
    if config.observation.kind == "dict" and config.observation.mode == "sensors":
        return frames_space(config)
    if config.observation.kind == "flat":
        return flat_observation_space(config)
    sensors = {sensor.name: sensor for sensor in sensors_of(config.sensors)}
    return spaces.Dict(
        {
            name: _feature_box(
                sensors[name].features(config.sensors) * config.sensors.stack,
                part.shape,
                part.dtype,
            )
            for name, part in observation_parts(config.sensors).items()
        }
    )


def _feature_box(
    features: Sequence[Feature], shape: tuple[int, ...], dtype: DTypeLike
) -> spaces.Box:
    low = np.array([feature.low for feature in features], dtype=dtype)
    high = np.array([feature.high for feature in features], dtype=dtype)
    return spaces.Box(low.reshape(shape), high.reshape(shape), dtype=low.dtype.type)


@dataclass(frozen=True)
class ObservationPart:
    """One sensor's part of an observation."""

    place: slice  # range of its features in each frame of a flat observation
    shape: tuple[int, ...]  # shape in a Dict observation; frames of a stack come first
    dtype: DTypeLike  # dtype in a Dict observation


def observation_parts(config: SensorsConfig) -> dict[str, ObservationPart]:
    """Return the parts of the enabled sensors, in the order of their features."""
    places = layout(config)
    parts = {}
    for sensor in sensors_of(config):
        if sensor.name in places:
            place = places[sensor.name]
            shape = sensor.shape(config)
            if shape == (-1,):
                shape = (place.stop - place.start,)
            if config.stack > 1:
                shape = (config.stack, *shape)
            parts[sensor.name] = ObservationPart(place, shape, sensor.dtype(config))
    return parts


def sensed_observation(frames: Frames) -> dict[str, NDArray[Any]]:
    """Return W worlds' frames as observations of mode `sensors`: views (W, A, …) by sensor."""
    return {
        name: sensor.data if sensor.data.shape[2] > 1 else sensor.data[:, :, 0]
        for name, sensor in frames.items()
    }


def named_observation(
    parts: Mapping[str, ObservationPart],  # see `observation_parts`
    frames: NDArray[np.float32],  # (…, stack, frame size): flat observations, reshaped
) -> dict[str, NDArray[Any]]:  # one array (…, *shape) per sensor
    """Split flat observations by sensor, as views; images are converted to bytes."""
    before = frames.shape[:-2]
    return {
        name: frames[..., part.place].reshape(*before, *part.shape).astype(part.dtype, copy=False)
        for name, part in parts.items()
    }


def flat_observation(
    names: Iterable[str],  # sensors in the order of the flat observation
    named: Mapping[str, NDArray[Any]],  # one array per sensor, in any order
    stack: int,  # frames in an observation
) -> NDArray[np.float32]:
    """Return the flat observation (stack · frame size,) from the observations by sensor."""
    frames = [np.asarray(named[name], np.float32).reshape(stack, -1) for name in names]
    return np.concatenate(frames, axis=1).ravel()


def write_sensed(
    frames: Frames, chosen: NDArray[np.bool_], observations: NDArray[np.float32]
) -> None:
    """Write the frames of the chosen worlds (W,) into flat observations (W, A, D)."""
    start = 0
    for sensor in frames.values():
        flat = sensor.data.reshape(*sensor.fresh.shape, -1)
        observations[chosen, :, start : start + flat.shape[2]] = flat[chosen]
        start += flat.shape[2]


def action_space(config: ActionConfig) -> spaces.Box | spaces.Discrete:
    """Return the space of an action: (throttle, steering) in [-1, 1], or the index of a choice."""
    if config.kind == "continuous":
        return spaces.Box(-1.0, 1.0, (2,), np.float32)
    return spaces.Discrete(config.choices)


def state_space(capacity: int) -> spaces.Box:
    """Return the space of the global state: `STATE_FEATURES` numbers per possible vehicle."""
    return _box(capacity * STATE_FEATURES)


def global_state(
    network: RoadNetwork, vehicles: NDArray[np.void], space: spaces.Box
) -> NDArray[np.float32]:
    """Return the global state: all vehicles in the order of their ids.

    The features of a vehicle are present, x, y, cosine and sine of the heading, and speed. x and y
    are scaled to [-1, 1] over the map's extent, speed is divided by 40 m/s. Places without a
    vehicle are 0.
    """
    state = np.zeros((space.shape[0] // STATE_FEATURES, STATE_FEATURES), dtype=np.float32)
    rows = vehicles[np.argsort(vehicles["id"])]
    min_x, min_y, max_x, max_y = network.extent_m
    live = state[: len(rows)]
    live[:, 0] = 1.0
    live[:, 1] = 2.0 * (rows["x"] - min_x) / max(max_x - min_x, 1.0) - 1.0
    live[:, 2] = 2.0 * (rows["y"] - min_y) / max(max_y - min_y, 1.0) - 1.0
    live[:, 3] = cos_all(rows["heading"])
    live[:, 4] = sin_all(rows["heading"])
    live[:, 5] = rows["speed"] / STATE_SPEED_MPS
    return np.clip(state, -1.0, 1.0).ravel()


def observation_table(config: SensorsConfig) -> str:
    """Return a Markdown table of a frame, index by index, for the cards of `envs/`.

    Repeated features (points, neighbours, rays, cells) share one line. In a stack, frame `k` (0 is
    the oldest) begins at `k` times the size of a frame.
    """
    lines = ["| index | sensor | feature | meaning | 1.0 is |", "|---|---|---|---|---|"]
    places = layout(config)
    for sensor in sensors_of(config):
        if sensor.name in places:
            start = places[sensor.name].start
            lines += _lines(sensor.name, start, sensor.features(config))
    return "\n".join(lines)


def _lines(sensor: str, start: int, features: list[Feature]) -> list[str]:
    """Return one line for each group of features whose names differ only in numbers."""
    groups: dict[str, list[int]] = {}
    for k, feature in enumerate(features):
        groups.setdefault(re.sub(r"(_\d+)+$", "", feature.name), []).append(k)
    lines = []
    for name, members in groups.items():
        index = ", ".join(str(start + k) for k in members[:2])
        if len(members) > 2:
            index += f" … {start + members[-1]}"
        first = features[members[0]]
        lines.append(f"| {index} | {sensor} | {name} | {first.meaning} | {first.scale or '-'} |")
    return lines
