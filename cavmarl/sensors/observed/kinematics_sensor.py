"""highway-env's `Kinematics`: a table of the vehicles near the agent, its own vehicle first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.kinematics_observation import PERCEPTION_M, KinematicsSensor
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, hidden
from cavmarl.sensors.observed.highway import (
    NEGATED,
    codes,
    default_ranges,
    off_centre,
    range_table,
    vehicle_feature,
)

# The map determines the range of y, which is mapped to [-1, 1] whatever its size.
_DEFAULT_RANGES = {
    "x": (-200.0, 200.0), "y": (-4.0, 4.0), "vx": (-80.0, 80.0), "vy": (-80.0, 80.0)
}  # fmt: skip

_RELATIVE = ("x", "y", "vx", "vy")


def features(config: SensorsConfig) -> list[Feature]:
    """List the features row by row; rows without a vehicle are 0."""
    kinematics = config.kinematics
    ranges = kinematics.features_range or _DEFAULT_RANGES
    if not kinematics.normalize:
        ranges = {}
    found = []
    for row in range(kinematics.vehicles_count):
        for name in kinematics.features:
            subject = f"vehicle {row}"
            if name in _RELATIVE and not kinematics.absolute:
                subject += " (row 0: ego; other rows: relative to ego)"
            feature = vehicle_feature(name, f"{name}_{row}", subject, ranges, kinematics.clip)
            if name == "y" and ranges is _DEFAULT_RANGES:
                feature = replace(feature, scale="4 m · lanes of the widest road")
            found.append(feature)
    return found


def shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.kinematics.vehicles_count, len(config.kinematics.features)


def reach_m(config: SensorsConfig) -> float:
    """Return highway-env's perception distance, or 0 if the sensor is off."""
    return PERCEPTION_M if config.kinematics.vehicles_count else 0.0


def settings(
    config: SensorsConfig, at: int, network: RoadNetwork, goals: NDArray[np.float64]
) -> KinematicsSensor:
    """Return the kernel's settings; `goals`: see `highway.goal_places`."""
    kinematics = config.kinematics
    ranges = kinematics.features_range or default_ranges(network)
    table = range_table(ranges if kinematics.normalize else {})
    return KinematicsSensor(
        at=at,
        vehicles=kinematics.vehicles_count,
        features=codes(kinematics.features),
        ranges=table,
        absolute=kinematics.absolute,
        shuffled=kinematics.order == "shuffled",
        clip=kinematics.clip,
        see_behind=kinematics.see_behind,
        observe_intentions=kinematics.observe_intentions,
        destinations=goals,
        near_body=np.zeros(max(kinematics.vehicles_count, 1), dtype=np.int64),
        near_key=np.zeros(max(kinematics.vehicles_count, 1)),
        values=np.zeros(len(table)),
    )


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.kinematics
    what = f"{own.vehicles_count - 1} vehicles within {PERCEPTION_M:g} m"
    found = [
        Reading("own vehicle", "its motion and its position on the map"),
        Reading("ideal sensors", f"{what}; {hidden(through_walls=True)}"),
    ]
    if own.observe_intentions and {"cos_d", "sin_d"} & set(own.features):
        found.append(Reading("world's state", "the destinations of other vehicles"))
    return found


def _refusal(config: SensorsConfig) -> str:
    kinematics = config.kinematics
    ranges = kinematics.features_range if kinematics.normalize else {}
    return off_centre(ranges, kinematics.features)


# The mirror axis is the x axis, because positions are in the world's frame.
SENSOR = Sensor(
    "kinematics",
    features,
    reach_m,
    shape,
    settings=lambda made: settings(made.config, made.at, made.network, made.goals),
    reads=reads,
    sides=Sides(NEGATED, refusal=_refusal),
)
