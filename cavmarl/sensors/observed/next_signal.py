"""The next stop line on the way: its signal, and the duty to give way."""

from __future__ import annotations

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """All 0 where no such line is within range."""
    if not config.signal.enabled:
        return []
    found = [
        Feature("present", "1 if there is a line with a signal or a duty to give way"),
        Feature("distance", "way to the line", f"{config.signal.range_m:g} m"),
        Feature("red", "1 if its signal is red, or asks to stop first"),
        Feature("yellow", "1 if its signal is yellow"),
        Feature("green", "1 if its signal is green"),
        Feature("give_way", "1 if others have the right of way"),
    ]
    if config.signal.timing:
        found += [
            Feature("change", "how soon the signal changes: 5 s / (5 s + time)"),
            Feature("reach", "how soon the line is reached at the present speed, likewise"),
        ]
    return found


def reach_m(config: SensorsConfig) -> float:
    return 0.0
