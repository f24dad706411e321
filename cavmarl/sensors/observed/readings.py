"""What an observation contains, by source, for the cards of drivers and environments.

The sources are the vehicle itself, ideal sensors (with their range and what hides vehicles), the
map, messages (V2X), and the world's state, which no device on a vehicle knows.
"""

from __future__ import annotations

from typing import get_args

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed import layout, sensors_of
from cavmarl.sensors.observed.feature import Reading, Source

SOURCES: tuple[Source, ...] = get_args(Source)
BUILT_IN_DRIVER = Reading(
    "world's state",
    "the action of the built-in driver, which knows the positions and plans of all vehicles",
)


def readings_of(config: SensorsConfig, residual: bool = False) -> list[Reading]:
    """Return what a driver with these sensors reads, ordered by source.

    `residual`: whether the driver also reads the built-in driver's action.
    """
    on = layout(config)
    found = [
        reading
        for sensor in sensors_of(config)
        if sensor.name in on
        for reading in sensor.reads(config)
    ]
    if residual:
        found.append(BUILT_IN_DRIVER)
    return sorted(found, key=lambda reading: SOURCES.index(reading.source))


def readings_table(readings: list[Reading]) -> str:
    """Return the readings as a table in Markdown, one row per source."""
    rows = ["| from | it reads |", "| --- | --- |"]
    for source in SOURCES:
        whats = [reading.what for reading in readings if reading.source == source]
        rows.append(f"| {source} | {'. '.join(map(_sentence, whats)) or 'Nothing'} |")
    return "\n".join(rows)


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]
