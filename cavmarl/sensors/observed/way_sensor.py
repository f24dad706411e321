"""The `way` sensor: the shape, lanes and stop lines of the path ahead.

The scales are defined in the kernel `observing_way`.
"""

from __future__ import annotations

import numpy as np

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_way import (
    CURVATURE_SCALE,
    LINE_HALF_M,
    STOP_SIGNS,
    WIDTH_SCALE,
    WaySensor,
)
from cavmarl.sensors.kernels.sense import SPEED_SCALE
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides

_SPEED = f"{SPEED_SCALE:g} m/s"


def features(config: SensorsConfig) -> list[Feature]:
    """List four features per point, nearest first, then five to seven per stop line."""
    found = []
    for k, distance in enumerate(config.way.distances_m):
        where = f"{distance:g} m along the path"
        found += [
            Feature(f"left_{k}", f"lateral position {where}, left positive", f"{distance:g} m"),
            Feature(
                f"curvature_{k}",
                f"curvature from the previous point to {where}, left positive",
                f"{CURVATURE_SCALE:g} 1/m",
            ),
            Feature(f"width_{k}", f"width of the lane {where}", f"{WIDTH_SCALE:g} m", 0.0),
            Feature(f"limit_{k}", f"speed limit {where}", _SPEED, 0.0),
        ]
    near = f"{LINE_HALF_M:g} m / ({LINE_HALF_M:g} m + distance)"
    at_signs = ", or it has a stop sign"
    is_red = config.way.stop_signs == "red"
    signs, yields = (at_signs, "") if is_red else ("", at_signs)
    for k in range(config.way.lines):
        rows = [
            ("line", f"closeness of stop line {k} along the path: {near}; 0: no line"),
            ("line_red", f"1 if the signal of line {k} is red, also with a green arrow{signs}"),
            ("line_yellow", f"1 if the signal of line {k} is yellow"),
            ("line_green", f"1 if the signal of line {k} is green"),
            (
                "line_yields",
                f"1 if other vehicles have the right of way behind line {k}{yields}",
            ),
        ]
        if config.way.timing:
            rows.append(
                ("line_change", f"how soon the signal of line {k} changes: 5 s / (5 s + time)")
            )
        if config.way.stop_signs == "own":
            rows.append(
                (
                    "line_stop",
                    f"1 if vehicles must stop at line {k} before they go: a stop sign or an arrow",
                )
            )
        found += [Feature(f"{name}_{k}", meaning, "", 0.0) for name, meaning in rows]
    return found


def settings(config: SensorsConfig, at: int) -> WaySensor:
    given = config.way
    distances = np.array(given.distances_m, dtype=np.float64)
    return WaySensor(
        at, distances, given.lines, given.range_m, given.timing, STOP_SIGNS.index(given.stop_signs)
    )


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.way
    found = []
    if own.distances_m:
        what = f"shape, width and speed limit of its path for {own.distances_m[-1]:g} m"
        found.append(Reading("map", what))
    if own.lines:
        lines = "stop line" if own.lines == 1 else f"{own.lines} stop lines"
        within = f"the next {lines} up to {own.range_m:g} m ahead on its path"
        found.append(Reading("map", f"right of way at {within}"))
        found.append(Reading("ideal sensors", f"colours of the signals at {within}"))
        if own.timing:
            what = "the exact time until the signals on its path change"
            found.append(Reading("world's state", what))
    return found


SENSOR = Sensor(
    "way",
    features,
    settings=lambda made: settings(made.config, made.at),
    reads=reads,
    sides=Sides(("left", "curvature")),
)
