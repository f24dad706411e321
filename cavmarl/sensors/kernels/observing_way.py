"""The kernel of the `way` sensor: the shape of the path ahead, and its stop lines.

If the plan needs a lane change, the path continues from the target lane, so that the next turn is
visible from every lane of a road.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cos_sin
from cavmarl.core.math.geometry import lane_pose, wrap_angle
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import (
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.driving.kernels.junctions.gaps import link_signal, must_stop
from cavmarl.driving.kernels.junctions.signal_timing import time_to_change
from cavmarl.driving.kernels.lanes.route_following import next_step_of_plan
from cavmarl.sensors.kernels.sense import SPEED_SCALE, gives_way_on, soonness, unit

PLACE_FEATURES = 4  # number of features per point of the path
LINE_FEATURES = 5  # number of features per stop line; timing and `OWN` add one each
CURVATURE_SCALE = 0.2  # 1/m
STOP_SIGNS = ("give_way", "own", "red")  # values of `sensors.way.stop_signs`
GIVE_WAY, OWN, AS_RED = range(3)
WIDTH_SCALE = 8.0  # m
LINE_HALF_M = 20.0  # a line at this distance has a closeness of 0.5
MOST_LANES = 48  # a path is followed over at most this many lanes


class WaySensor(NamedTuple):
    """Settings of the `way` sensor."""

    at: int
    distances_m: NDArray[np.float64]  # (P,) distances of the points, increasing
    lines: int  # number of stop lines
    range_m: float  # range of the stop lines
    timing: bool
    stop_signs: int  # how stop signs are shown: an index in `STOP_SIGNS`


@kernel
def line_size(sensor: WaySensor) -> int:
    """Return the number of features per stop line."""
    return LINE_FEATURES + int(sensor.timing) + int(sensor.stop_signs == OWN)


@kernel
def _observe_line(
    roads: RoadArrays,
    controllers: NDArray[np.void],
    link: int,
    distance: float,
    phase: NDArray[np.int32],
    time: float,
    tick_s: float,
    sensor: WaySensor,
    out: NDArray[np.float32],
) -> bool:
    """Write the stop line before a link; return False if there is no reason to stop at it."""
    signal = link_signal(roads, link, phase)
    gives_way = gives_way_on(roads, link, signal)
    stops = must_stop(roads, link, signal)
    if signal == SIGNAL_NONE and not (gives_way or stops):
        return False
    has_sign = stops and signal == SIGNAL_NONE
    is_red = signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW or signal == SIGNAL_STOP_THEN_GO
    out[0] = LINE_HALF_M / (LINE_HALF_M + max(distance, 0.0))
    if is_red or (has_sign and sensor.stop_signs == AS_RED):
        out[1] = 1.0
    elif signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        out[2] = 1.0
    elif signal == SIGNAL_GREEN_MAJOR or signal == SIGNAL_GREEN_MINOR:
        out[3] = 1.0
    out[4] = 1.0 if gives_way or (has_sign and sensor.stop_signs != AS_RED) else 0.0
    if sensor.timing and signal != SIGNAL_NONE:
        out[5] = soonness(time_to_change(roads, controllers, link, phase, time, tick_s))
    if sensor.stop_signs == OWN:
        out[line_size(sensor) - 1] = 1.0 if stops else 0.0
    return True


@kernel
def observe_way(
    roads: RoadArrays,
    travel: TripTables,
    controllers: NDArray[np.void],
    row: np.void,
    phase: NDArray[np.int32],
    time: float,
    tick_s: float,
    sensor: WaySensor,
    observation: NDArray[np.float32],
) -> None:
    """Write points of the path at the given distances, then the next stop lines.

    Beyond the end of the path, its last point is repeated, without curvature. `time`: time of the
    tick, in s since the world's reset. `observation`: (D,), must be 0 before.
    """
    cos_heading, sin_heading = cos_sin(row["heading"])
    distances = sensor.distances_m
    lines_at = sensor.at + PLACE_FEATURES * distances.size
    size = line_size(sensor)
    lane, way = row["lane"], row["way"]
    here = roads.lanes[lane]
    start = -row["s"]  # distance from the vehicle to the beginning of the lane
    _, _, _, cos, sin, _ = lane_pose(
        roads.points, here["first_point"], here["num_points"], row["s"]
    )
    before_m = 0.0
    direction = atan2(sin, cos)
    written = 0
    lines = 0
    for _ in range(MOST_LANES):
        end = start + here["length_m"]
        following, way_there, link = next_step_of_plan(roads, travel, lane, way)
        while written < distances.size and (distances[written] <= end or following < 0):
            at = sensor.at + PLACE_FEATURES * written
            distance = min(distances[written], end)
            x, y, _, cos, sin, _ = lane_pose(
                roads.points, here["first_point"], here["num_points"], distance - start
            )
            left = (y - row["y"]) * cos_heading - (x - row["x"]) * sin_heading
            turned = atan2(sin, cos)
            out = observation[at : at + PLACE_FEATURES]
            out[0] = unit(left / distances[written])
            if distance > before_m:
                curvature = wrap_angle(turned - direction) / (distance - before_m)
                out[1] = unit(curvature / CURVATURE_SCALE)
            out[2] = unit(here["width_m"] / WIDTH_SCALE)
            out[3] = unit(here["speed_mps"] / SPEED_SCALE)
            direction = turned
            before_m = distance
            written += 1
        if link >= 0 and lines < sensor.lines and end <= sensor.range_m:
            out = observation[lines_at + size * lines : lines_at + size * (lines + 1)]
            if _observe_line(roads, controllers, link, end, phase, time, tick_s, sensor, out):
                lines += 1
        is_beyond = lines == sensor.lines or end > sensor.range_m
        if following < 0 or (written == distances.size and is_beyond):
            break
        lane, way, start = following, way_there, end
        here = roads.lanes[lane]
