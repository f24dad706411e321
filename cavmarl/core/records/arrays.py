"""Bundles of arrays for kernels, so that no kernel has twenty arguments.

W is the number of worlds that are stepped together, C the number of rows of a world, A agents, L
lanes, K links, G goals. The record dtypes are described where they are defined: `roads.network`,
`roads.routing`, `driving.vehicles`, `traffic.native`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.buckets import Lists
from cavmarl.core.math.walls import Walls


class RoadArrays(NamedTuple):
    """The record arrays of a `RoadNetwork`."""

    points: NDArray[np.void]  # POINT (num_points,)
    lanes: NDArray[np.void]  # LANE (L,)
    edges: NDArray[np.void]  # EDGE (num_edges,)
    links: NDArray[np.void]  # LINK (K,)
    conflicts: NDArray[np.void]  # CONFLICT (num_conflicts,)
    sweeps: NDArray[np.void]  # SWEEP (num_sweeps,)
    into: NDArray[np.int32]  # (num_into,) see LANE["first_into"]
    signals: NDArray[np.void]  # SIGNAL (num_signals,)
    programs: NDArray[np.void]  # PROGRAM (num_programs,)
    phases: NDArray[np.void]  # PHASE (num_phases,)
    phase_states: NDArray[np.uint8]  # (num_letters,) codes: positions in SIGNAL_STATES
    switches: NDArray[np.void]  # SWITCH (num_switches,)
    detectors: NDArray[np.void]  # DETECTOR (D,)
    phase_detectors: NDArray[np.int32]  # see PHASE["first_detector"]
    lane_place: NDArray[np.int32]  # (L,) the first PLACE of each lane, or -1
    places: NDArray[np.void]  # PLACE (num_places,) detectors that vehicles on a lane can cover
    maps: NDArray[np.void]  # MAP (M,), see `roads.kernels.map_choice`


class LaneGrid(NamedTuple):
    """The lanes near a point: square cells over the map, with each cell's lanes in CSR form."""

    min_x: float
    min_y: float
    cell_m: float
    num_x: int
    num_y: int
    cell_start: NDArray[np.int32]  # (num_x * num_y + 1,)
    cell_lanes: NDArray[np.int32]


class Scripts(NamedTuple):
    """Positions of scripted vehicles and pedestrians by tick; see `scenarios.movement_scripts`."""

    frames: NDArray[np.void]  # FRAME (num_frames,), indexed by VEHICLE["goal"] of a scripted row
    covers: NDArray[np.void]  # COVER (num_covers,) stretches of lanes that bodies cover
    claims: NDArray[np.void]  # CLAIM (num_claims,) links claimed by vehicles that arrive soon
    cues: NDArray[np.void]  # CUE (T,) conditions that scripts wait for
    room: int  # maximum number of lanes covered at the same time
    reach_m: float  # largest distance of a body from the middle of a stretch that it covers


class TripTables(NamedTuple):
    """Vehicle types and routes; the same for all worlds of an environment."""

    types: NDArray[np.void]  # VTYPE (num_types,), by VEHICLE["vtype"]
    steps: NDArray[np.void]  # PLAN (num_steps,), see `lanes.route_following`
    stops: NDArray[np.void]  # STOP (num_stops,), by VEHICLE["stop"]
    first_detour: int  # PLAN row of the first goal of demand vehicles that are rerouted
    begin_s: float  # time of the demand at tick 0
    view_m: float  # how far any driver looks for vehicles along the road, at most VIEW_M
    see_m: float  # distance before a stop line from which drivers check it
    num_fixed: int  # the world writes steps from this index on while it runs
    scripts: Scripts
    shifts: NDArray[np.int64]  # (W,) row of a world's own plan minus row of the map's plan
    trip_horizon: float = 0.0  # limit of agents' trips, in free-flow times; 0: no limit
    tick_s: float = 0.1


class SharedState(NamedTuple):
    """State of W worlds that the shards of one process share; see `Worlds`."""

    ticks: NDArray[np.int64]
    keys: NDArray[np.uint64]
    signal_phase: NDArray[np.int32]
    controllers: NDArray[np.void]
    detected_s: NDArray[np.float64]
    pending: NDArray[np.float64]
    cues: NDArray[np.int64]
    lanes: NDArray[np.void]


class Worlds(NamedTuple):
    """A shard's part of W worlds: the vehicles and signals that a tick reads and writes.

    `rows` is the committed state of the tick, `next_rows` the result of `advance`. Both are the
    same array, except in ticks that sort the rows.
    """

    rows: NDArray[np.void]  # VEHICLE (W, C)
    next_rows: NDArray[np.void]  # VEHICLE (W, C)
    num_owned: NDArray[np.int64]  # (W,) rows [0, num_owned) belong to this shard
    num_rows: NDArray[np.int64]  # (W,) rows [num_owned, num_rows) are ghosts
    ticks: NDArray[np.int64]  # (W,) ticks since reset
    keys: NDArray[np.uint64]  # (W,) the root of all random numbers of the episode
    # (W, num_signals) active PHASE rows; then one column per link, see `signal_overrides`, or none
    signal_phase: NDArray[np.int32]
    controllers: NDArray[np.void]  # CONTROLLER (W, num_controllers) of actuated programs
    detected_s: NDArray[np.float64]  # (W, D) time when a body was last over each detector
    num_through: NDArray[np.int64]  # (W,) background vehicles that have arrived in this tick
    pending: NDArray[
        np.float64
    ]  # (W, A, D + 1, 2) agents' commands of the last D ticks of latency, by tick modulo D + 1
    num_near: NDArray[np.int64]  # (W,) ghosts from this row on cannot touch owned vehicles
    num_touching: NDArray[np.int64]  # (W,) owned vehicles that touched another before this tick
    num_contacts: NDArray[np.int64]  # (W,) vehicles that began to touch another, since the reset
    step: NDArray[
        np.void
    ]  # PLAN (W, C) the step of each row's lane, see `route_following.own_step`
    step_at: NDArray[np.int64]  # (W, C) 1 + its index in `TripTables.steps`, 0: none yet
    outer: NDArray[np.void]  # OUTER (W, C) owned next rows that other zones may see, ascending
    num_outer: NDArray[np.int64]  # (W,) length of these lists; -1: outdated
    cues: NDArray[np.int64]  # (W, T) tick of each cue of the script, -1: not yet
    # LANE (V, L) the lanes as they are now, see `lanes_now`; V is 1 if no world may change lanes,
    # else 1 + W
    lanes: NDArray[np.void]


class ZoneState(NamedTuple):
    """State of all k zones of W worlds; the `Worlds` of each shard are views of it."""

    rows: NDArray[np.void]  # VEHICLE (2, k, W, C) memory of `rows` and `next_rows`
    num_owned: NDArray[np.int64]  # (k, W)
    num_rows: NDArray[np.int64]  # (k, W)
    num_near: NDArray[np.int64]  # (k, W)
    num_through: NDArray[np.int64]  # (k, W)
    num_touching: NDArray[np.int64]  # (k, W)
    num_contacts: NDArray[np.int64]  # (k, W)
    step: NDArray[np.void]  # PLAN (k, W, C)
    step_at: NDArray[np.int64]  # (k, W, C)
    outer: NDArray[np.void]  # OUTER (k, W, C)
    num_outer: NDArray[np.int64]  # (k, W)
    border: NDArray[np.int32]  # (k, W, C) owned rows at a border, ascending
    num_border: NDArray[np.int64]  # (k, W)
    spare: NDArray[np.void]  # VEHICLE (1,)


class DepartureQueue(NamedTuple):
    """Per-world data that is never divided: ids, the queue of departures, counts.

    D is the number of departures of a demand file, E the largest number of lanes of an edge.
    """

    orders: NDArray[np.void]  # DEPARTURE (W, D) departures of a demand file, in order of `due`
    num_orders: NDArray[np.int64]  # (W,)
    next_order: NDArray[np.int64]  # (W,) the first departure that is not due yet
    queue: NDArray[np.void]  # DEPARTURE (W, C + D) vehicles that wait to enter, in order of id
    num_queue: NDArray[np.int64]  # (W,)
    next_id: NDArray[np.int64]  # (W,) id of the next vehicle
    num_entered: NDArray[np.int64]  # (W,) agents that have departed so far
    counts: NDArray[np.int64]  # (W, NUM_COUNTS) departed, arrived, removed since reset
    sums: NDArray[np.float64]  # (W, NUM_SUMS) sums over arrived vehicles
    passing: NDArray[np.void]  # VEHICLE (W, C + D) vehicles that leave or may enter in this tick
    num_passing: NDArray[np.int64]  # (W,)
    places: NDArray[np.int64]  # (W, C + D) positions in the queue of vehicles that may enter
    tries: NDArray[np.int32]  # (W, C + D) LANE on which each queued vehicle tries to enter, or -1
    ranks: NDArray[np.int64]  # (W, C + D, E) crowding of each lane of the departure's edge
    last_s: NDArray[np.float64]  # (W, C + D, E) position behind the last vehicle of these lanes, m
    lane_taken: NDArray[np.bool_]  # (L,) whether a vehicle tries to enter there in this tick
    spare: NDArray[np.void]  # VEHICLE (1,) scratch


class TripTable(NamedTuple):
    """Trips to draw from, by map."""

    pairs: NDArray[np.int32]  # (P, 2) LANE and goal
    first: NDArray[np.int64]  # (M + 1,) trips of map m: pairs[first[m] : first[m + 1]]


class Demand(NamedTuple):
    """The generator's distributions of departures; the same for all worlds of an environment."""

    agent_trips: TripTable
    start_trips: TripTable  # trips of background vehicles at reset, by lane length
    enter_trips: TripTable  # trips of background vehicles that enter later
    # (M,) whether background vehicles enter at the start of their lane (a road into the map)
    enter_at_start: NDArray[np.bool_]
    num_agents: int  # agents in the world at the same time
    num_ids: int  # agents of an episode
    num_background: int
    reenter: bool  # whether a vehicle that leaves is replaced by a new one
    endless: bool  # whether agents get another goal before they reach their goal
    seats: bool  # whether an agent's new vehicle keeps the agent's id
    speed_factor_spread: float
    blank: NDArray[np.void]  # VEHICLE (1,) initial value of a new record
    agent_types: NDArray[np.int32]  # VTYPE rows, which agents use in turn by their number
    # (T,) VTYPE rows of background vehicles, which define their drivers
    drawn_types: NDArray[np.int32]
    drawn_ends: NDArray[np.float64]  # (T,) ends of their shares in [0, 1], rising


class Scratch(NamedTuple):
    """Working memory of a tick; between calls, only the lists to clear have a meaning."""

    lanes: Lists  # by lane, lists of entries
    # entries of lane l: [lane_start[l], lane_end[l]); at index L, the entries of all lanes. Both
    # arrays are views of `lanes.bounds`, so one access to memory reads both
    lane_start: NDArray[np.int32]
    lane_end: NDArray[np.int32]
    entries: NDArray[np.void]  # ENTRY (2 C + Scripts.room,) by (lane, s, id), with side lanes
    links: Lists  # by link, lists of approach
    link_start: NDArray[np.int32]  # approach of link k: [link_start[k], link_end[k])
    link_end: NDArray[np.int32]
    approach: NDArray[np.void]  # APPROACH (4 C,) vehicles on or before links, by link
    largest: NDArray[np.int8]  # (J,) the largest size class in `approach`, by junction
    pairs: NDArray[np.void]  # APPROACH (4 C,) `approach` before sorting
    order: NDArray[np.int32]  # (C,) the owned rows in order along the lanes
    accel: NDArray[np.float64]  # (C,) decided accelerations
    link_ahead: NDArray[np.int32]  # (C,) the link at the next stop line of each row
    lane_change: NDArray[np.int32]  # (C,) decided lane changes: 1 left, -1 right, or STAYS_ASIDE
    blinker: NDArray[np.int32]  # (C,) new values of VEHICLE["blinker"]
    hold: NDArray[np.int32]  # (C,) new values of VEHICLE["hold"]
    hit: NDArray[np.int64]  # (C,) id of the vehicle that each row touches


class Sensors(NamedTuple):
    """Settings of the agents' sensors, and the offset of each sensor in a frame."""

    stack: int  # frames in an observation
    ego: bool  # whether the sensor is on; its offset is 0
    ego_size: bool  # whether it includes the vehicle's type
    route_at: int
    route_points: int
    route_spacing_m: float
    neighbors_at: int
    neighbors: int
    neighbors_range_m: float
    signal: bool
    signal_at: int
    signal_range_m: float
    signal_timing: bool
    signal_stop_signs: bool
    lanes_at: int
    lanes_range_m: float
    lidar_at: int
    lidar_rays: int
    lidar_range_m: float
    lidar_speeds: bool
    rays: NDArray[np.float64]  # (lidar_rays, 2) directions in the ego frame
    walls: Walls  # walls that hide neighbours; empty: neighbours are seen through walls
    near_body: NDArray[np.int32]  # (neighbors,) scratch; larger if walls hide neighbours
    near_squared: NDArray[np.float64]
    echoes: NDArray[np.void]  # ECHO (lidar_rays,) scratch
    history_at: int
    history: int  # numbers of a frame that the next frame repeats


class Outputs(NamedTuple):
    """Outputs for the agents at the end of a step, by agent index; zeros for absent agents.

    T is the number of terms, D the length of a flat observation. Earlier observations are only
    stored here: the frames of a stack move up within `observations`.
    """

    observations: NDArray[np.float32]  # (W, A, D) the stacked frames, oldest first
    terms: NDArray[np.float32]  # (W, A, T)
    rewards: NDArray[np.float32]  # (W, A)
    terminated: NDArray[np.bool_]  # (W, A) the vehicle ended in this step
    present: NDArray[np.bool_]  # (W, A) the agent had a vehicle at the end of the step
    acted: NDArray[np.bool_]  # (W, A) the agent had a vehicle during the whole step
    events: NDArray[np.int32]  # (W, A) EVENT_* bits of the step
    vehicle_ids: NDArray[np.int64]  # (W, A) -1 where absent
    places: NDArray[np.float64]  # (W, A, 2) x and y of the vehicle, m; outdated if absent
