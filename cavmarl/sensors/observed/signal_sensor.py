"""The `signal` sensor: the next stop line with a signal or a duty to yield."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor, features_of

_SIGNAL_TIMING = (
    ("change", "how soon the signal changes: 5 s / (5 s + time)", ""),
    ("reach", "how soon the line is reached at the present speed: 5 s / (5 s + time)", ""),
)


def features(config: SensorsConfig) -> list[Feature]:
    """List the features of the next stop line in range; all are 0 if there is none."""
    if not config.signal.enabled:
        return []
    rows = (
        ("present", "1 if there is a line with a signal or a duty to yield", ""),
        ("distance", "distance to the line", f"{config.signal.range_m:g} m"),
        ("red", "1 if its signal is red, or it requires a stop first", ""),
        ("yellow", "1 if its signal is yellow", ""),
        ("green", "1 if its signal is green", ""),
        ("give_way", "1 if other vehicles have the right of way", ""),
    )
    return features_of((*rows, *(_SIGNAL_TIMING if config.signal.timing else ())))


SENSOR = Sensor("signal", features)
