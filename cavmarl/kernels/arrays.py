"""Bundles of arrays that kernels take together, so that no kernel has twenty arguments.

W is the number of worlds stepped together, C the rows a world can hold, A the agents, L lanes, K
links, G goals. The record dtypes are described where they are made: `roads.network`,
`roads.routing`, `shard.vehicles`, `traffic.native`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Demand", "Gate", "LaneGrid", "Outputs", "RoadArrays", "Scratch", "Sensors", "Worlds"]


class RoadArrays(NamedTuple):
    """What kernels take of a `RoadNetwork`: the record arrays and nothing else."""

    points: NDArray[np.void]  # POINT (num_points,)
    lanes: NDArray[np.void]  # LANE (L,)
    edges: NDArray[np.void]  # EDGE (num_edges,)
    links: NDArray[np.void]  # LINK (K,)
    conflicts: NDArray[np.void]  # CONFLICT (num_conflicts,)
    into: NDArray[np.int32]  # (num_into,) see LANE["first_into"]
    signals: NDArray[np.void]  # SIGNAL (num_signals,)
    phases: NDArray[np.void]  # PHASE (num_phases,)
    phase_states: NDArray[np.uint8]  # (num_letters,) codes: positions in SIGNAL_STATES


class LaneGrid(NamedTuple):
    """Which lanes lie near a place: square cells over the map, lanes of a cell in CSR form."""

    min_x: float
    min_y: float
    cell_m: float
    num_x: int
    num_y: int
    cell_start: NDArray[np.int32]  # (num_x * num_y + 1,)
    cell_lanes: NDArray[np.int32]


class Worlds(NamedTuple):
    """A shard's part of W worlds: the vehicles and signals that a tick reads and writes.

    `rows` is the committed state of the tick, `next_rows` the room for the one after; they swap.
    """

    rows: NDArray[np.void]  # VEHICLE (W, C)
    next_rows: NDArray[np.void]  # VEHICLE (W, C)
    num_owned: NDArray[np.int64]  # (W,) rows [0, num_owned) are this shard's own
    num_rows: NDArray[np.int64]  # (W,) rows [num_owned, num_rows) are ghosts
    ticks: NDArray[np.int64]  # (W,) since reset
    keys: NDArray[np.uint64]  # (W,) the root of all random numbers of the episode
    signal_phase: NDArray[np.int32]  # (W, num_signals) PHASE row that is on
    num_contacts: NDArray[np.int64]  # (W,) vehicles that began to touch another, since reset


class Gate(NamedTuple):
    """What one place keeps of each world, however it is divided: ids, the queue, the counts."""

    queue: NDArray[np.void]  # DEPARTURE (W, C) vehicles that wait to enter, in id order
    num_queue: NDArray[np.int64]  # (W,)
    next_id: NDArray[np.int64]  # (W,) the next vehicle's id
    num_entered: NDArray[np.int64]  # (W,) agents that have been ordered so far
    counts: NDArray[np.int64]  # (W, NUM_COUNTS) departed, arrived, removed since reset
    sums: NDArray[np.float64]  # (W, NUM_SUMS) sums over arrived vehicles


class Demand(NamedTuple):
    """What the generator draws departures from; the same for all worlds of an environment."""

    agent_trips: NDArray[np.int32]  # (P, 2) LANE and goal of the trips of agents
    start_trips: NDArray[np.int32]  # (P, 2) of background vehicles at reset, dense by lane length
    enter_trips: NDArray[np.int32]  # (P, 2) of background vehicles that enter later
    enter_at_start: bool  # whether those enter at the start of their lane (a road into the map)
    num_agents: int  # agents in the world at any one time
    num_ids: int  # agents that an episode can have
    num_background: int
    reenter: bool  # whether a vehicle that leaves orders a new one
    seats: bool  # whether the new one of an agent takes the same id
    speed_factor_spread: float
    blank: NDArray[np.void]  # VEHICLE (1,) what a new record starts from


class Scratch(NamedTuple):
    """Room that a tick works in; holds nothing between calls."""

    lane_start: NDArray[np.int32]  # (L + 2,) entries of lane l: [lane_start[l], lane_start[l + 1])
    entry_row: NDArray[np.int32]  # (2 C,) vehicle rows by (lane, s, id), side lanes included
    entry_s: NDArray[np.float64]  # (2 C,)
    link_start: NDArray[np.int32]  # (K + 2,) entries of link k, as above
    link_row: NDArray[np.int32]  # (3 C,) vehicles that approach or are on link k
    link_dist: NDArray[np.float64]  # (3 C,) centre to stop line, m; negative: inside
    pair_link: NDArray[np.int32]  # (3 C,) the same before sorting
    pair_row: NDArray[np.int32]
    pair_dist: NDArray[np.float64]
    accel: NDArray[np.float64]  # (C,) decided accelerations
    link_ahead: NDArray[np.int32]  # (C,) the link whose stop line each row is next to
    lane_change: NDArray[np.int32]  # (C,) decided lane changes: 1 left, -1 right
    blinker: NDArray[np.int32]  # (C,)
    hold: NDArray[np.int32]  # (C,)
    hit: NDArray[np.int64]  # (C,) id of the vehicle each row touches


class Sensors(NamedTuple):
    """What the agents' sensors are set to, and where each writes in an observation."""

    route_at: int
    route_points: int
    route_spacing_m: float
    neighbors_at: int
    neighbors: int
    neighbors_range_m: float
    signal_at: int
    signal_range_m: float
    signal_timing: bool
    lanes_at: int
    lanes_range_m: float
    lidar_at: int
    lidar_rays: int
    lidar_range_m: float
    lidar_speeds: bool
    rays: NDArray[np.float64]  # (lidar_rays, 2) directions in the ego frame
    near_row: NDArray[np.int32]  # (neighbors,) room
    near_squared: NDArray[np.float64]
    echoes: NDArray[np.void]  # ECHO (lidar_rays,) room


class Outputs(NamedTuple):
    """What agents get at the end of a step, at their own index; absent agents have zeros.

    T is the number of terms, D the size of a flat observation.
    """

    observations: NDArray[np.float32]  # (W, A, D)
    terms: NDArray[np.float32]  # (W, A, T)
    rewards: NDArray[np.float32]  # (W, A)
    terminated: NDArray[np.bool_]  # (W, A) the vehicle ended in this step
    present: NDArray[np.bool_]  # (W, A) had a vehicle at the end of the step
    acted: NDArray[np.bool_]  # (W, A) and had it during the whole step
    events: NDArray[np.int32]  # (W, A) EVENT_* bits of the step
    vehicle_ids: NDArray[np.int64]  # (W, A) -1 where absent
