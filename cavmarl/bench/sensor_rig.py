"""The rigs of `cavmarl bench sensors`: read from files, and described."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import places
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.registry import type_of

Rig = dict[str, dict[str, Any]]

_PLACE = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def find_rig(rig: str) -> Path:
    """The file that `rig` means: a path, or a name in `configs/rigs/`."""
    if Path(rig).is_file():
        return Path(rig)
    for place in places("configs"):
        path = place / "rigs" / f"{rig}.yaml"
        if path.is_file():
            return path
    raise ConfigError(f"no rig or file '{rig}': give 'ten_sensors' or the path of a .yaml")


def load_rig(path: Path) -> Rig:
    """The sensors in a file, as they stand under `rig` of an env.yaml."""
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
