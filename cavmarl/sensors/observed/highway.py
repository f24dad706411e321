"""Meanings and default ranges of highway-env's features of a vehicle."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import GRID_FEATURES, VEHICLE_FEATURES
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed.feature import Feature

MAX_SPEED_MPS = 40.0  # Vehicle.MAX_SPEED
LANE_WIDTH_M = 4.0  # AbstractLane.DEFAULT_WIDTH

# Upper bound of relative velocities: driving/kernels/motion/motion.py keeps speeds in 0–60 m/s.
MAX_RELATIVE_MPS = 120.0

_MEANINGS = {
    "presence": ("1 if there is a vehicle", ""),
    "x": ("position, to the east", "m"),
    "y": ("position, to the south", "m"),
    "vx": ("velocity, to the east", "m/s"),
    "vy": ("velocity, to the south", "m/s"),
    "heading": ("heading, clockwise from east", "rad"),
    "cos_h": ("cosine of its heading", ""),
    "sin_h": ("sine of its heading, clockwise from east", ""),
    "cos_d": ("cosine of the direction to its destination", ""),
    "sin_d": ("sine of the direction to its destination, clockwise from east", ""),
    "long_off": ("distance along its lane", "m"),
    "lat_off": ("lateral offset from its lane's centre, right positive", "m"),
    "ang_off": ("heading relative to its lane's direction, right positive", "rad"),
}

# Bounds of features without a range.
_LIMITS = {
    "presence": (0.0, 1.0),
    "vx": (-MAX_RELATIVE_MPS, MAX_RELATIVE_MPS),
    "vy": (-MAX_RELATIVE_MPS, MAX_RELATIVE_MPS),
    "heading": (-math.pi, math.pi),
    "ang_off": (-math.pi, math.pi),
    **dict.fromkeys(("cos_h", "sin_h", "cos_d", "sin_d"), (-1.0, 1.0)),
}
_NO_LIMIT = (-math.inf, math.inf)


# Features whose sign changes if north and south, or left and right, are exchanged.
NEGATED = ("y", "vy", "heading", "sin_h", "sin_d", "lat_off", "ang_off")


def off_centre(ranges: Mapping[str, tuple[float, ...]], features: tuple[str, ...]) -> str:
    """Return a feature that cannot be negated because its range is not symmetric, if any."""
    for name in NEGATED:
        if name in features and name in ranges and ranges[name][0] != -ranges[name][1]:
            low, high = ranges[name]
            return (
                f"left and right cannot be exchanged, because the range of {name} is from {low:g} "
                f"to {high:g}, not symmetric"
            )
    return ""


def default_ranges(network: RoadNetwork) -> dict[str, tuple[float, ...]]:
    """Return highway-env's default ranges of features.

    In highway-env, the range of `y` spans the lanes of the road in the first observation. Here it
    spans the lanes of the widest road of the map, so that it is constant for a map.
    """
    outside = network.edges[~network.edges["internal"]]
    y = LANE_WIDTH_M * float(outside["num_lanes"].max())
    speed = 2.0 * MAX_SPEED_MPS
    return {
        "x": (-5.0 * MAX_SPEED_MPS, 5.0 * MAX_SPEED_MPS),
        "y": (-y, y),
        "vx": (-speed, speed),
        "vy": (-speed, speed),
    }


def range_table(ranges: Mapping[str, tuple[float, ...]]) -> NDArray[np.float64]:
    """Return the ranges (len(VEHICLE_FEATURES), 2) by feature code; nan where there is none."""
    table = np.full((len(VEHICLE_FEATURES), 2), np.nan)
    for name, bounds in ranges.items():
        table[VEHICLE_FEATURES.index(name)] = bounds
    return table


def codes(features: tuple[str, ...]) -> NDArray[np.int64]:
    return np.array([GRID_FEATURES.index(name) for name in features], dtype=np.int64)


def goal_places(network: RoadNetwork, plans: NDArray[np.void]) -> NDArray[np.float64]:
    """Return x and y (M, G, 2) of each goal of each map, in m: the end of its edge's kerb lane."""
    places = np.zeros((len(network.maps), len(plans), 2))
    for own, row in zip(places, network.maps, strict=True):
        first, end = row["first_lane"], row["first_lane"] + row["num_lanes"]
        for place, plan in zip(own, plans[:, first:end], strict=True):
            reached = np.isfinite(plan["to_go"]) & (plan["next"] < 0) & (plan["change"] == 0)
            goal = first + int(np.flatnonzero(reached)[0])
            place[:] = network.lane_polyline(goal)[-1, :2]
    return places


def vehicle_feature(
    name: str, label: str, subject: str, ranges: Mapping[str, tuple[float, ...]], clip: bool
) -> Feature:
    """Return one feature of a vehicle.

    Args:
        name: one of `VEHICLE_FEATURES`.
        label: the feature's name in the observation.
        subject: text for the vehicle, at the start of the meaning.
        ranges: values that are mapped to [-1, 1], by feature.
        clip: whether mapped values are clipped.
    """
    meaning, unit = _MEANINGS[name]
    text = f"{subject}: {meaning}"
    if name not in ranges:
        low, high = _LIMITS.get(name, _NO_LIMIT)
        return Feature(label, text, f"1 {unit}" if unit else "", low, high)
    start, end = ranges[name]
    low, high = (-1.0, 1.0) if clip else _NO_LIMIT
    if start == -end:
        return Feature(label, text, f"{end:g} {unit}".strip(), low, high)
    return Feature(label, text, f"{end:g} {unit}; -1 is {start:g}".replace(" ;", ";"), low, high)
