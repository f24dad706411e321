"""The sensors that observe the lanes of signals, made from the settings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SignalsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.signal_places import place_of_signal
from cavmarl.signals.kernels.camera_counts import IN_RANGE, Cameras
from cavmarl.signals.kernels.loop_counts import CAR_MM, READINGS, Loops
from cavmarl.signals.kernels.message_counts import UnitLanes
from cavmarl.signals.kernels.signal_observations import MIN_GAP_M
from cavmarl.signals.signal_table import SignalSizes, SignalTable

LOOP_M = 2.0  # length of a loop
BEFORE_LINE_M = 1.0  # distance from the end of a loop to the stop line
STANDING_S = 2.0  # a vehicle that covers a loop for this time counts as stopped
# If the exit loop has been free for the driving time from loop to loop (at the speed limit) plus
# this time, earlier vehicles have left.
CLEAR_S = 2.0


def make_cameras(
    config: SignalsConfig, network: RoadNetwork, table: SignalTable, most_vehicles: int
) -> Cameras:
    """Return the cameras of all signals, for worlds of at most `most_vehicles` vehicles."""
    places = np.array([place_of_signal(network, row) for row in table.arrays.row.tolist()])
    places[:, 2] += config.camera_height_m
    return Cameras(
        posts=table.posts,
        places=places,
        range_m=config.camera_range_m,
        misses=config.camera_misses,
        in_range=np.zeros(most_vehicles, dtype=IN_RANGE),
        first=np.zeros(len(places), dtype=np.int32),
    )


def loops_shape(
    config: SignalsConfig, num_worlds: int, sizes: SignalSizes
) -> tuple[int, int, int, int]:
    """Return the shape of the readings of loops; without loops, the number of lanes is 0."""
    return num_worlds, sizes.lanes if config.sensing == "loops" else 0, 2, READINGS


def make_loops(
    config: SignalsConfig, table: SignalTable, dt: float, detected: NDArray[np.int64]
) -> Loops:
    """Return the loops of all watched lanes.

    A lane that leads to a signal has a loop before the stop line, and a loop
    `signals.loop_upstream_m` before the line (on shorter lanes, at the start). A lane that only
    leads away has a loop at its start, and a loop `signals.loop_upstream_m` after the start (on
    shorter lanes, at the end).

    Args:
        config: the positions.
        table: the lanes.
        dt: length of a tick in s.
        detected: (W, N, 2, DETECTED) state of the loops.
    """
    posts, length_m = table.posts, table.arrays.length_m
    away_m = config.loop_upstream_m
    begin_m = np.where(
        posts.leads_in,
        (posts.line_m - away_m, posts.line_m - BEFORE_LINE_M - LOOP_M),
        (posts.line_m, np.minimum(away_m, length_m - LOOP_M)),
    )
    begin_m = np.ascontiguousarray(np.maximum(begin_m, 0.0).T)
    between_m = begin_m[:, 1] - begin_m[:, 0]
    clear_s = between_m / table.arrays.speed_mps + CLEAR_S
    return Loops(
        begin_m=begin_m,
        end_m=begin_m + LOOP_M,
        room=(between_m / (MIN_GAP_M + 1e-3 * CAR_MM)).astype(np.int64) + 1,
        clear_ticks=np.ceil(clear_s / dt - 1e-9).astype(np.int64),
        standing_ticks=math.ceil(STANDING_S / dt - 1e-9),
        detected=detected,
        covered=np.zeros(begin_m.shape, dtype=np.bool_),
    )


def make_unit_lanes(
    network: RoadNetwork, table: SignalTable, receivers: NDArray[np.int64]
) -> UnitLanes:
    """Return the lanes on which roadside units count vehicles.

    `receivers`: (S,) row of each signal's unit among the inboxes.
    """
    order = np.argsort(table.posts.signal, kind="stable")
    lanes = network.lanes[table.arrays.lane_row]
    return UnitLanes(
        receivers=receivers,
        first=np.searchsorted(table.posts.signal[order], np.arange(len(receivers) + 1)),
        lanes=order,
        first_point=lanes["first_point"].copy(),
        num_points=lanes["num_points"].copy(),
        half_width_m=0.5 * lanes["width_m"],
        points=network.arrays.points,
        full=np.zeros(1, dtype=np.int64),
    )
