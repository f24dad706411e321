"""The rigs of benchmarks: read from files, listed, and made heavier."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import places
from cavmarl.config.rig import MAX_SAMPLE_NUMBERS, MountedConfig
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.mounted.catalogue import type_of

__all__ = ["Rig", "describe_rig", "find_rig", "load_rig", "scaled"]

Rig = dict[str, dict[str, Any]]

# The most of each that a sensor can have; see `config_rig`.
_LIMITS = {"rays": 8192, "layers": 128, "width": 4096, "height": 4096}
_LEAST_CELL_M = 0.05
_SCALED = {*_LIMITS, "cell_m"}
_PLACE = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def find_rig(rig: str) -> Path:
    """The file that `rig` means: a path, or a name in `configs/rigs/`.

    Raises:
        ConfigError: there is none.
    """
    if Path(rig).is_file():
        return Path(rig)
    for place in places("configs"):
        path = place / "rigs" / f"{rig}.yaml"
        if path.is_file():
            return path
    raise ConfigError(f"no rig or file '{rig}': give 'ten_sensors' or the path of a .yaml")


def load_rig(path: Path) -> Rig:
    """The sensors in a file, as they stand under `rig` of an env.yaml.

    Raises:
        ConfigError: not YAML, or no mapping of sensors.
    """
    found = read_yaml(path)
    if not isinstance(found, Mapping) or not all(
        isinstance(sensor, Mapping) for sensor in found.values()
    ):
        raise ConfigError(f"{path}: must be sensors by name, as under rig of an env.yaml")
    return {name: dict(sensor) for name, sensor in found.items()}


def describe_rig(config: EnvConfig) -> list[dict[str, Any]]:
    """Type, resolution, lines, rate and placement of each sensor of an environment."""
    return [
        {
            "name": name,
            "type": getattr(sensor, "type", type(sensor).__name__),
            "resolution": list(sensor.shape),
            "lines": type_of(name, sensor).num_lines(sensor),
            "rate_hz": getattr(sensor, "rate_hz", None),
            "placement": {key: getattr(sensor, key) for key in _PLACE},
        }
        for name, sensor in config.rig.items()
    ]


def scaled(config: EnvConfig, factors: Mapping[str, float], rate_hz: float) -> Rig:
    """The rig of an environment with more pixels, rays and cells.

    As far as may be: there is a most of each. Pictures keep the proportions of their sides. Sensors
    that have none of them stay as they are.

    Args:
        config: of the environment.
        factors: how many times as many each sensor gets.
        rate_hz: of all that are scaled.
    """
    return {name: _scaled(sensor, factors[name], rate_hz) for name, sensor in config.rig.items()}


def _scaled(sensor: MountedConfig, factor: float, rate_hz: float) -> dict[str, Any]:
    values = {field.name: getattr(sensor, field.name) for field in fields(sensor)}
    if _SCALED & values.keys():
        values |= {"rate_hz": rate_hz, "phase_ticks": 0}
    side = math.sqrt(min(factor, MAX_SAMPLE_NUMBERS / math.prod(sensor.shape)))
    if "cell_m" in values:
        values["cell_m"] = max(values["cell_m"] / side, _LEAST_CELL_M)
    for name in ("width", "height"):
        if name in values:
            values[name] = min(int(values[name] * side), _LIMITS[name])
    for name in ("rays", "layers"):
        if name in values:
            wanted = max(1, min(round(values[name] * factor), _LIMITS[name]))
            factor *= values[name] / wanted  # what is left of it
            values[name] = wanted
    return values
