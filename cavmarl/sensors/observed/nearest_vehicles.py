"""The nearest vehicles."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """Seven numbers a neighbour, nearest first; all 0 where there are fewer."""
    scale = f"{config.neighbors.range_m:g} m"
    return [
        Feature(f"{name}_{k}", f"neighbour {k}: {meaning}", unit)
        for k in range(config.neighbors.count)
        for name, meaning, unit in (
            ("present", "1 if there is one", ""),
            ("x", "forward place, ego frame", scale),
            ("y", "place to the left, ego frame", scale),
            ("vx", "forward velocity minus the own one, ego frame", "40 m/s"),
            ("vy", "velocity to the left minus the own one, ego frame", "40 m/s"),
            ("cos", "cosine of its heading minus the own one", ""),
            ("sin", "sine of its heading minus the own one", ""),
        )
    ]


def reach_m(config: SensorsConfig) -> float:
    return config.neighbors.range_m if config.neighbors.count else 0.0


def room(config: SensorsConfig) -> dict[str, Any]:
    """The arrays that the search works in."""
    count = config.neighbors.count
    return {
        "near_body": np.zeros(count, dtype=np.int32),
        "near_squared": np.zeros(count, dtype=np.float64),
    }
