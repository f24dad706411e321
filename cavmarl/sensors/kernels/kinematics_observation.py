"""highway-env's `KinematicObservation`: a table of nearby vehicles and their features.

The table shows vehicles within `PERCEPTION_M` and, without `see_behind`, at most two ego lengths
behind. Unless shuffled, they are ordered by distance along the ego lane, which is extended straight
beyond its ends. The first row is the ego vehicle, always in the world's frame.

`vehicle_features` returns the numbers of highway-env's `Vehicle.to_dict`. Their frame is that of
highway-env's pictures: x points right (east), y points down (south), and headings turn clockwise.
So on a road to the east, y grows to the right of the driving direction. Compared with this package,
y, headings and lateral offsets have the opposite sign.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cos_sin, cosine, sine
from cavmarl.core.math.geometry import lane_pose, project, wrap_angle
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.rng import STREAM_SENSOR, below
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import RoadArrays

# In the order of `config.sensors.VEHICLE_FEATURES`; then `on_road`, which is a feature of a place
# and not of a vehicle.
FEATURE_PRESENCE = 0
FEATURE_X = 1
FEATURE_Y = 2
FEATURE_VX = 3
FEATURE_VY = 4
FEATURE_HEADING = 5
FEATURE_COS_H = 6
FEATURE_SIN_H = 7
FEATURE_COS_D = 8
FEATURE_SIN_D = 9
FEATURE_LONG_OFF = 10
FEATURE_LAT_OFF = 11
FEATURE_ANG_OFF = 12
FEATURE_ON_ROAD = 13


class KinematicsSensor(NamedTuple):
    """Settings and scratch of highway-env's `Kinematics`."""

    at: int
    vehicles: int  # rows, including the ego vehicle; 0: off
    features: NDArray[np.int64]  # (F,) FEATURE_* codes, the columns
    ranges: NDArray[np.float64]  # (len(VEHICLE_FEATURES), 2) mapped to [-1, 1]; nan: not mapped
    absolute: bool
    shuffled: bool
    clip: bool
    see_behind: bool
    observe_intentions: bool
    destinations: NDArray[np.float64]  # (M, G, 2) position of each goal of each map, m
    near_body: NDArray[np.int64]  # (vehicles,) scratch
    near_key: NDArray[np.float64]
    values: NDArray[np.float64]  # (len(VEHICLE_FEATURES),) scratch


@kernel
def vehicle_features(
    lanes: NDArray[np.void],
    points: NDArray[np.void],
    row: np.void,
    destinations: NDArray[np.float64],
    intentions: bool,
    out: NDArray[np.float64],
) -> None:
    """Write all features of a vehicle in the world's frame.

    `destinations`: (M, G, 2) x and y of each map's goals in m, in this package's frame.
    `intentions`: whether to write the direction to the vehicle's goal; otherwise 0 is written.
    `out`: (len(VEHICLE_FEATURES),), overwritten.
    """
    cos, sin = cos_sin(row["heading"])
    out[FEATURE_PRESENCE] = 1.0
    out[FEATURE_X] = row["x"]
    out[FEATURE_Y] = -row["y"]
    out[FEATURE_VX] = row["speed"] * cos
    out[FEATURE_VY] = -row["speed"] * sin
    out[FEATURE_HEADING] = -row["heading"]
    out[FEATURE_COS_H] = cos
    out[FEATURE_SIN_H] = -sin
    out[FEATURE_COS_D] = 0.0
    out[FEATURE_SIN_D] = 0.0
    if intentions:
        own_map = lanes[row["lane"]]["map"]
        dx = destinations[own_map, row["goal"], 0] - row["x"]
        dy = destinations[own_map, row["goal"], 1] - row["y"]
        distance = math.sqrt(dx * dx + dy * dy)
        if distance > 0.0:
            out[FEATURE_COS_D] = dx / distance
            out[FEATURE_SIN_D] = -dy / distance
    lane = lanes[row["lane"]]
    _, _, _, lane_cos, lane_sin, _ = lane_pose(
        points, lane["first_point"], lane["num_points"], row["s"]
    )
    out[FEATURE_LONG_OFF] = row["s"]
    out[FEATURE_LAT_OFF] = -row["d"]
    out[FEATURE_ANG_OFF] = -wrap_angle(row["heading"] - atan2(lane_sin, lane_cos))


@kernel
def make_relative(values: NDArray[np.float64], ego: np.void) -> None:
    """Subtract the position and velocity of `ego` from `values`, in the world's axes."""
    values[FEATURE_X] -= ego["x"]
    values[FEATURE_Y] -= -ego["y"]
    values[FEATURE_VX] -= ego["speed"] * cosine(ego["heading"])
    values[FEATURE_VY] -= -ego["speed"] * sine(ego["heading"])


@kernel
def in_range(value: float, ranges: NDArray[np.float64], feature: int) -> float:
    """Map a value from the feature's range to [-1, 1]; without a range, return it unchanged."""
    low = ranges[feature, 0]
    if math.isnan(low):
        return value
    mapped: float = -1.0 + (value - low) * 2.0 / (ranges[feature, 1] - low)
    return mapped


PERCEPTION_M = 200.0  # AbstractEnv.PERCEPTION_DISTANCE


@kernel
def _find_near(
    roads: RoadArrays, rows: NDArray[np.void], i: int, grid: Grid, sensor: KinematicsSensor
) -> int:
    """Fill `near_body` with the vehicles to show, sorted, and return their number."""
    ego = rows[i]
    lane = roads.lanes[ego["lane"]]
    first_point, num_points = lane["first_point"], lane["num_points"]
    own_s, _, _, _ = project(roads.points, first_point, num_points, ego["x"], ego["y"])
    bodies = grid.bodies
    keys = sensor.near_key
    most = sensor.vehicles - 1
    found = 0
    first_column, last_column = cell_columns(grid, ego["x"], PERCEPTION_M)
    first_row, last_row = cell_rows(grid, ego["y"], PERCEPTION_M)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = bodies[b]
            dx = body["x"] - ego["x"]
            dy = body["y"] - ego["y"]
            if (
                not dx * dx + dy * dy < PERCEPTION_M * PERCEPTION_M
                or body["row"] == i
                or abs(body["z"] - ego["z"]) > LEVEL_HEIGHT_M
            ):
                continue
            s, _, _, _ = project(roads.points, first_point, num_points, body["x"], body["y"])
            along = s - own_s
            if not (sensor.see_behind or along > -2.0 * ego["length"]):
                continue
            # Without sorting, highway-env takes vehicles in order of creation, which is the order
            # of ids.
            key = 0.0 if sensor.shuffled else abs(along)
            place = found
            while place > 0 and (
                key < keys[place - 1]
                or (
                    key == keys[place - 1]
                    and body["id"] < bodies[sensor.near_body[place - 1]]["id"]
                )
            ):
                place -= 1
            if place == most:
                continue
            if found < most:
                found += 1
            for m in range(found - 1, place, -1):
                sensor.near_body[m] = sensor.near_body[m - 1]
                keys[m] = keys[m - 1]
            sensor.near_body[place] = b
            keys[place] = key
    return found


@kernel
def _write(sensor: KinematicsSensor, table_row: int, out: NDArray[np.float32]) -> None:
    """Write the selected features of `sensor.values` to a row of the table."""
    num = sensor.features.size
    at = sensor.at + table_row * num
    for f in range(num):
        feature = sensor.features[f]
        value = in_range(sensor.values[feature], sensor.ranges, feature)
        if sensor.clip and not np.isnan(sensor.ranges[feature, 0]):
            value = clamp(value, -1.0, 1.0)
        out[at + f] = value


@kernel
def _shuffle(sensor: KinematicsSensor, ego: np.void, out: NDArray[np.float32]) -> None:
    """Shuffle all rows except the first, including empty ones (Fisher and Yates)."""
    num = sensor.features.size
    for last in range(sensor.vehicles - 1, 1, -1):
        other = 1 + below(ego["rng_key"], ego["id"], ego["tick"], STREAM_SENSOR + last, last)
        for f in range(num):
            a = sensor.at + last * num + f
            b = sensor.at + other * num + f
            out[a], out[b] = out[b], out[a]


@kernel
def observe_kinematics(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    sensor: KinematicsSensor,
    out: NDArray[np.float32],
) -> None:
    """Write the table of one vehicle, row by row; rows without a vehicle are left unchanged.

    At equal distance along the lane, the vehicle with the smaller id comes first.

    `sensor`: settings and scratch, with ranges in the frame of `vehicle_features`. `out`: an
    observation, which must be 0 from `sensor.at` on.
    """
    ego = rows[i]
    vehicle_features(roads.lanes, roads.points, ego, sensor.destinations, True, sensor.values)
    _write(sensor, 0, out)
    found = _find_near(roads, rows, i, grid, sensor)
    for k in range(found):
        other = rows[grid.bodies[sensor.near_body[k]]["row"]]
        vehicle_features(
            roads.lanes,
            roads.points,
            other,
            sensor.destinations,
            sensor.observe_intentions,
            sensor.values,
        )
        if not sensor.absolute:
            make_relative(sensor.values, ego)
        _write(sensor, 1 + k, out)
    if sensor.shuffled:
        _shuffle(sensor, ego, out)
