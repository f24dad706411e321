"""The `signal` sensor: the next stop line with a signal or a duty to yield."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, features_of

_SIGNAL_TIMING = (
    ("change", "how soon the signal changes: 5 s / (5 s + time)", ""),
    ("reach", "how soon the line is reached at the present speed: 5 s / (5 s + time)", ""),
)
_STOP = (
    ("stop", "1 if vehicles must stop at the line before they go: a stop sign or an arrow", ""),
)


def features(config: SensorsConfig) -> list[Feature]:
    """List the features of the next stop line in range; without a stop line, all are 0."""
    if not config.signal.enabled:
        return []
    rows = (
        ("present", "1 if there is a line with a signal or a duty to yield", ""),
        ("distance", "distance to the line", f"{config.signal.range_m:g} m"),
        ("red", "1 if its signal is red, also with a green arrow", ""),
        ("yellow", "1 if its signal is yellow", ""),
        ("green", "1 if its signal is green", ""),
        ("give_way", "1 if other vehicles have the right of way, also at a stop sign", ""),
    )
    timing = _SIGNAL_TIMING if config.signal.timing else ()
    return features_of((*rows, *timing, *(_STOP if config.signal.stop_signs == "own" else ())))


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.signal
    found = [
        Reading("ideal sensors", f"the next signal on its path within {own.range_m:g} m"),
        Reading("map", "the right of way at the next stop line"),
    ]
    if own.timing:
        found.append(
            Reading("world's state", "the exact time until the next signal on its path changes")
        )
    return found


SENSOR = Sensor("signal", features, reads=reads, sides=Sides())
