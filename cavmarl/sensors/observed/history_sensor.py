"""The `history` sensor: what the vehicle was told to do, and its speeds."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_history import HISTORY_FEATURES, HistorySensor
from cavmarl.sensors.kernels.sense import SPEED_SCALE
from cavmarl.sensors.observed.feature import Feature, Sensor

_SPEED = f"{SPEED_SCALE:g} m/s"


def features(config: SensorsConfig) -> list[Feature]:
    """Three numbers a step, the last one first; those before the vehicle entered are its first."""
    rows = (
        ("throttle", "acceleration that was asked for", "10 m/s²"),
        ("steering", "front wheel angle, left positive", "pi/4 rad"),
        ("speed", "speed along the heading", _SPEED),
    )
    return [
        Feature(f"{name}_{k}", f"{k} steps before the last: {meaning}", scale)
        for k in range(config.history.steps)
        for name, meaning, scale in rows
    ]


def shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.history.steps, HISTORY_FEATURES


def settings(config: SensorsConfig, at: int) -> HistorySensor:
    """What the kernel takes."""
    return HistorySensor(at, config.history.steps * HISTORY_FEATURES)


SENSOR = Sensor(
    "history", features, shape=shape, settings=lambda made: settings(made.config, made.at)
)
