"""The `history` sensor: recent controls and speeds of the agent's vehicle."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_history import HISTORY_FEATURES, HistorySensor
from cavmarl.sensors.kernels.sense import SPEED_SCALE
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides

_SPEED = f"{SPEED_SCALE:g} m/s"


def features(config: SensorsConfig) -> list[Feature]:
    """List three features per step, latest step first; the first step fills all steps before it."""
    rows = (
        ("throttle", "commanded acceleration", "10 m/s²"),
        ("steering", "front wheel angle, left positive", "pi/4 rad"),
        ("speed", "speed along the heading", _SPEED),
    )
    return [
        Feature(f"{name}_{k}", f"{_when(k)}: {meaning}", scale)
        for k in range(config.history.steps)
        for name, meaning, scale in rows
    ]


def _when(k: int) -> str:
    if k == 0:
        return "last step"
    return "step before the last" if k == 1 else f"{k} steps before the last"


def shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.history.steps, HISTORY_FEATURES


def settings(config: SensorsConfig, at: int) -> HistorySensor:
    return HistorySensor(at, config.history.steps * HISTORY_FEATURES)


def reads(config: SensorsConfig) -> list[Reading]:
    what = f"its controls and speeds of the last {config.history.steps} steps"
    return [Reading("own vehicle", what)]


SENSOR = Sensor(
    "history",
    features,
    shape=shape,
    settings=lambda made: settings(made.config, made.at),
    reads=reads,
    sides=Sides(("steering",)),
)
