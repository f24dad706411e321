"""Spaces: pure functions of the config. No world is built to learn a shape."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from cavmarl.config import ActionConfig, EnvConfig, SensorsConfig
from cavmarl.shard.sensors import SENSORS, Feature, layout

__all__ = [
    "STATE_FEATURES",
    "action_space",
    "flat_observation_space",
    "observation_space",
    "observation_table",
    "state_space",
]

# Features of one vehicle in the global state: present, x, y, cos, sin, speed.
STATE_FEATURES = 6
NUM_META_ACTIONS = 5


def _box(size: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


def flat_observation_space(config: EnvConfig) -> spaces.Box:
    """All features of all sensors in one Box within [-1, 1], whatever `observation.kind` says."""
    return _box(max(place.stop for place in layout(config.sensors).values()))


def observation_space(config: EnvConfig) -> spaces.Box | spaces.Dict:
    """What one agent observes: a flat Box, or a Dict with one Box a sensor."""
    if config.observation.kind == "flat":
        return flat_observation_space(config)
    places = layout(config.sensors)
    return spaces.Dict({name: _box(place.stop - place.start) for name, place in places.items()})


def action_space(config: ActionConfig) -> spaces.Box | spaces.Discrete:
    """What one agent does: (throttle, steering) in [-1, 1], or one of five meta-actions."""
    if config.kind == "continuous":
        return spaces.Box(-1.0, 1.0, (2,), np.float32)
    return spaces.Discrete(NUM_META_ACTIONS)


def state_space(config: EnvConfig) -> spaces.Box:
    """The global state: `STATE_FEATURES` numbers for each vehicle that the world can hold."""
    capacity = config.population.agents + config.population.background
    return _box(capacity * STATE_FEATURES)


def observation_table(config: SensorsConfig) -> str:
    """A Markdown table of the flat observation, index by index, for the cards of `envs/`.

    Features that repeat (points, neighbours, rays) are folded into one line.
    """
    lines = ["| index | sensor | feature | meaning | 1.0 is |", "|---|---|---|---|---|"]
    places = layout(config)
    for sensor in SENSORS:
        if sensor.name in places:
            start = places[sensor.name].start
            lines += _lines(sensor.name, start, sensor.features(config))
    return "\n".join(lines)


def _lines(sensor: str, start: int, features: list[Feature]) -> list[str]:
    """One line for each name without its number; the first of its features says what it means."""
    groups: dict[str, list[int]] = {}
    for k, feature in enumerate(features):
        groups.setdefault(feature.name.rstrip("0123456789").rstrip("_"), []).append(k)
    lines = []
    for name, members in groups.items():
        index = ", ".join(str(start + k) for k in members[:2])
        if len(members) > 2:
            index += f" … {start + members[-1]}"
        first = features[members[0]]
        lines.append(f"| {index} | {sensor} | {name} | {first.meaning} | {first.scale or '-'} |")
    return lines
