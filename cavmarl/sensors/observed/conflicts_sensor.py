"""The `conflicts` sensor: the vehicles that come closest to the agent's path.

The scales are defined in the kernel `observing_conflicts`.
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
    LOOK_S,
    PLACE_HALF_M,
    RANKED,
    SPEED_HALF_MPS,
    WHEN_HALF_S,
    ConflictsSensor,
)
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, hidden
from cavmarl.sensors.observed.sensor_setup import walls_of

_PLACE = f"x / ({PLACE_HALF_M:g} m + abs(x))"
_RELATIVE = f"v / ({SPEED_HALF_MPS:g} m/s + abs(v))"


def features(config: SensorsConfig) -> list[Feature]:
    """List nine to twelve features per vehicle; the closest and soonest approach comes first."""
    rows: tuple[tuple[str, str, str, float], ...] = (
        (
            "near",
            f"nearest approach: {GAP_HALF_M:g} m / ({GAP_HALF_M:g} m + gap); 0: none",
            "",
            0.0,
        ),
        (
            "soon",
            f"soonness of this approach: {WHEN_HALF_S:g} s / ({WHEN_HALF_S:g} s + time); 0: none",
            "",
            0.0,
        ),
        ("x", "longitudinal position, ego frame", _PLACE, -1.0),
        ("y", "lateral position, left positive, ego frame", _PLACE, -1.0),
        ("vx", "longitudinal velocity minus the ego speed, ego frame", _RELATIVE, -1.0),
        ("vy", "lateral velocity, left positive, ego frame", _RELATIVE, -1.0),
        ("cos", "cosine of its heading relative to the ego heading", "", -1.0),
        ("sin", "sine of its heading relative to the ego heading", "", -1.0),
        (
            "first",
            "1 if it has priority at the next junction or is on it; -1 if it yields; else 0",
            "",
            -1.0,
        ),
    )
    if config.conflicts.heard:
        age = "age of the message about it, if the vehicle is not seen"
        rows += (
            ("seen", "1 if seen; 0 if known from a message only, or none", "", 0.0),
            ("age", age, f"{AGE_SCALE_S:g} s", 0.0),
        )
    if config.conflicts.indicators:
        rows += (("turn", "1 if it indicates a left turn, -1 a right turn, else 0", "", -1.0),)
    return [
        Feature(f"{name}_{k}", f"vehicle {k}: {meaning}", scale, low)
        for k in range(config.conflicts.count)
        for name, meaning, scale, low in rows
    ]


def shape(config: SensorsConfig) -> tuple[int, ...]:
    more = HEARD_FEATURES if config.conflicts.heard else 0
    more += INDICATED_FEATURES if config.conflicts.indicators else 0
    return config.conflicts.count, CONFLICT_FEATURES + more


def reach_m(config: SensorsConfig) -> float:
    return config.conflicts.range_m * (config.conflicts.count > 0)


def settings(
    config: SensorsConfig, at: int, walls: Walls, most_told: int, capacity: int
) -> ConflictsSensor:
    """Return the kernel's settings; `most_told`: vehicles per inbox; `capacity`: rows per world."""
    given = config.conflicts
    capacity = capacity if given.count else 0
    num_looks = round(given.horizon_s / LOOK_S) + 1
    return ConflictsSensor(
        at,
        given.count,
        given.range_m,
        walls,
        given.heard,
        told=np.zeros(most_told, BODY),
        indicators=given.indicators,
        indicators_m=given.indicators_m,
        departs=given.departs,
        looks=np.zeros((num_looks, 4)),
        heard_looks=np.zeros((num_looks, 4)),
        others=np.zeros((capacity, num_looks, 4)),
        indicated=np.zeros(capacity),
        foreseen=np.zeros(capacity, np.int64),
        filling=np.ones(1, np.int64),
        ranked=np.zeros(given.count, RANKED),
    )


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.conflicts
    what = f"the {own.count} vehicles within {own.range_m:g} m that come closest to its path"
    found = [
        Reading("ideal sensors", f"{what}; {hidden(own.through_walls)}"),
        Reading("map", "the right of way of the vehicles near its path"),
    ]
    if own.heard:
        found.append(Reading("V2X", "messages about vehicles that it does not see"))
    if own.indicators and own.indicators_m:
        what = f"the indicators of these vehicles, up to {own.indicators_m:g} m before a junction"
        found.append(Reading("ideal sensors", what))
    elif own.indicators:
        what = "the next turn of vehicles near its path, from their routes, as if always indicated"
        found.append(Reading("world's state", what))
    return found


SENSOR = Sensor(
    "conflicts",
    features,
    reach_m,
    shape,
    settings=lambda made: settings(
        made.config,
        made.at,
        walls_of(made.network, made.config.conflicts.through_walls),
        made.most_told,
        made.capacity,
    ),
    reads=reads,
    sides=Sides(("y", "vy", "sin", "turn")),
)
