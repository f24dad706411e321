"""What the sensors observe that are made for driving on any map.

The way ahead, vehicles that come near it, and what was done last. The scales are those of the
kernels `observing_way`, `observing_conflicts` and `observing_history`.
"""

from __future__ import annotations

import numpy as np

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.math.neighbors import BODY
from cavmarl.core.math.walls import Walls
from cavmarl.sensors.kernels.observing_conflicts import (
    AGE_SCALE_S,
    CONFLICT_FEATURES,
    GAP_HALF_M,
    HEARD_FEATURES,
    INDICATED_FEATURES,
    NUM_LOOKS,
    PLACE_HALF_M,
    SPEED_HALF_MPS,
    WHEN_HALF_S,
)
from cavmarl.sensors.kernels.observing_history import HISTORY_FEATURES
from cavmarl.sensors.kernels.observing_way import CURVATURE_SCALE, LINE_HALF_M, WIDTH_SCALE
from cavmarl.sensors.kernels.sense import SPEED_SCALE
from cavmarl.sensors.kernels.sensor_arrays import (
    RANKED,
    ConflictsSensor,
    HistorySensor,
    WaySensor,
)
from cavmarl.sensors.observed.feature import Feature

_SPEED = f"{SPEED_SCALE:g} m/s"
_PLACE = f"x / ({PLACE_HALF_M:g} m + abs(x))"
_RELATIVE = f"v / ({SPEED_HALF_MPS:g} m/s + abs(v))"


def way(config: SensorsConfig) -> list[Feature]:
    """Four numbers a place, nearest first; then five a line, or six with `timing`."""
    found = []
    for k, distance in enumerate(config.way.distances_m):
        where = f"{distance:g} m along the way"
        found += [
            Feature(f"left_{k}", f"place to the left of what is {where}", f"{distance:g} m"),
            Feature(
                f"curvature_{k}",
                f"curvature from the place before to {where}, left positive",
                f"{CURVATURE_SCALE:g} 1/m",
            ),
            Feature(f"width_{k}", f"width of the lane {where}", f"{WIDTH_SCALE:g} m", 0.0),
            Feature(f"limit_{k}", f"speed limit {where}", _SPEED, 0.0),
        ]
    near = f"{LINE_HALF_M:g} m / ({LINE_HALF_M:g} m + way)"
    for k in range(config.way.lines):
        rows = [
            ("line", f"how near stop line {k} is along the way: {near}; 0: there is none"),
            ("line_red", f"1 if the signal of line {k} is red, or asks to stop first"),
            ("line_yellow", f"1 if the signal of line {k} is yellow"),
            ("line_green", f"1 if the signal of line {k} is green"),
            ("line_yields", f"1 if others have the right of way behind line {k}"),
        ]
        if config.way.timing:
            rows.append(
                ("line_change", f"how soon the signal of line {k} changes: 5 s / (5 s + time)")
            )
        found += [Feature(f"{name}_{k}", meaning, "", 0.0) for name, meaning in rows]
    return found


def conflicts(config: SensorsConfig) -> list[Feature]:
    """Nine numbers a vehicle, or up to twelve; first what comes nearest and soonest; or 0."""
    rows: tuple[tuple[str, str, str, float], ...] = (
        (
            "near",
            f"how near it comes: {GAP_HALF_M:g} m / ({GAP_HALF_M:g} m + gap); 0: there is none",
            "",
            0.0,
        ),
        (
            "soon",
            f"how soon: {WHEN_HALF_S:g} s / ({WHEN_HALF_S:g} s + time); 0: there is none",
            "",
            0.0,
        ),
        ("x", "forward place, ego frame", _PLACE, -1.0),
        ("y", "place to the left, ego frame", _PLACE, -1.0),
        ("vx", "forward velocity minus the own one, ego frame", _RELATIVE, -1.0),
        ("vy", "velocity to the left, ego frame", _RELATIVE, -1.0),
        ("cos", "cosine of its heading minus the own one", "", -1.0),
        ("sin", "sine of its heading minus the own one", "", -1.0),
        (
            "first",
            "1 if it goes first at the next junction, or is on it; -1 if it gives way; else 0",
            "",
            -1.0,
        ),
    )
    if config.conflicts.heard:
        age = "how old the message is that tells of it, if it is not seen"
        rows += (
            ("seen", "1 if it is seen; 0: a message tells of it, or there is none", "", 0.0),
            ("age", age, f"{AGE_SCALE_S:g} s", 0.0),
        )
    if config.conflicts.indicators:
        rows += (("turn", "1 if it indicates that it turns left, -1: right; else 0", "", -1.0),)
    return [
        Feature(f"{name}_{k}", f"vehicle {k}: {meaning}", scale, low)
        for k in range(config.conflicts.count)
        for name, meaning, scale, low in rows
    ]


def history(config: SensorsConfig) -> list[Feature]:
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


def conflicts_shape(config: SensorsConfig) -> tuple[int, ...]:
    more = HEARD_FEATURES if config.conflicts.heard else 0
    more += INDICATED_FEATURES if config.conflicts.indicators else 0
    return config.conflicts.count, CONFLICT_FEATURES + more


def history_shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.history.steps, HISTORY_FEATURES


def way_settings(config: SensorsConfig, at: int) -> WaySensor:
    """What the kernel takes."""
    given = config.way
    distances = np.array(given.distances_m, dtype=np.float64)
    return WaySensor(at, distances, given.lines, given.range_m, given.timing)


def conflicts_settings(
    config: SensorsConfig, at: int, walls: Walls, most_told: int, capacity: int
) -> ConflictsSensor:
    """What the kernel takes; `most_told`: vehicles that an inbox keeps; `capacity`: of the grid."""
    given = config.conflicts
    capacity = capacity if given.count else 0
    return ConflictsSensor(
        at,
        given.count,
        given.range_m,
        walls,
        given.heard,
        told=np.zeros(most_told, BODY),
        indicators=given.indicators,
        looks=np.zeros((NUM_LOOKS, 4)),
        heard_looks=np.zeros((NUM_LOOKS, 4)),
        others=np.zeros((capacity, NUM_LOOKS, 4)),
        indicated=np.zeros(capacity),
        foreseen=np.zeros(capacity, np.int64),
        filling=np.ones(1, np.int64),
        ranked=np.zeros(given.count, RANKED),
    )


def history_settings(config: SensorsConfig, at: int) -> HistorySensor:
    """What the kernel takes."""
    return HistorySensor(at, config.history.steps * HISTORY_FEATURES)
