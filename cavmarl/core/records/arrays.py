"""Bundles of arrays that kernels take together, so that no kernel has twenty arguments.

W is the number of worlds stepped together, C the rows a world can hold, A the agents, L lanes, K
links, G goals. The record dtypes are described where they are made: `roads.network`,
`roads.routing`, `driving.vehicles`, `traffic.native`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.buckets import Lists
from cavmarl.core.math.walls import Walls


class RoadArrays(NamedTuple):
    """What kernels take of a `RoadNetwork`: the record arrays and nothing else."""

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
    places: NDArray[np.void]  # PLACE (num_places,) detectors that bodies on a lane can cover
    maps: NDArray[np.void]  # MAP (M,), see `roads.kernels.map_choice`


class LaneGrid(NamedTuple):
    """Which lanes lie near a place: square cells over the map, lanes of a cell in CSR form."""

    min_x: float
    min_y: float
    cell_m: float
    num_x: int
    num_y: int
    cell_start: NDArray[np.int32]  # (num_x * num_y + 1,)
    cell_lanes: NDArray[np.int32]


class Scripts(NamedTuple):
    """Where scripted vehicles and pedestrians are, by tick; see `scenarios.movement_scripts`."""

    frames: NDArray[np.void]  # FRAME (num_frames,), by VEHICLE["goal"] of a scripted row
    covers: NDArray[np.void]  # COVER (num_covers,) of lanes by bodies
    claims: NDArray[np.void]  # CLAIM (num_claims,) of links by vehicles that will be there soon
    cues: NDArray[np.void]  # CUE (T,) what scripts wait for
    room: int  # lanes that all of them can cover at the same time
    reach_m: float  # the farthest from a body to the middle of a stretch that it covers


class TripTables(NamedTuple):
    """What vehicles are and which ways there are; the same for all worlds of an environment."""

    types: NDArray[np.void]  # VTYPE (num_types,), by VEHICLE["vtype"]
    steps: NDArray[np.void]  # PLAN (num_steps,), see `lanes.route_following`
    stops: NDArray[np.void]  # STOP (num_stops,), by VEHICLE["stop"]
    first_detour: int  # PLAN row of the first goal of demand vehicles that take another way
    begin_s: float  # the clock of the demand at tick 0
    view_m: float  # how far any driver looks for others along the road, at most VIEW_M
    see_m: float  # how far before a line its centre is when a driver first asks about it
    num_fixed: int  # steps from here on are written while the world runs
    scripts: Scripts
    trip_horizon: float = 0.0  # so many times its free time a trip of an agent may take; 0: any
    tick_s: float = 0.1


class SharedState(NamedTuple):
    """What the shards of one process have in common of W worlds; see `Worlds`."""

    ticks: NDArray[np.int64]
    keys: NDArray[np.uint64]
    signal_phase: NDArray[np.int32]
    controllers: NDArray[np.void]
    detected_s: NDArray[np.float64]
    pending: NDArray[np.float64]
    cues: NDArray[np.int64]


class Worlds(NamedTuple):
    """A shard's part of W worlds: the vehicles and signals that a tick reads and writes.

    `rows` is the committed state of the tick, `next_rows` what `advance` makes of it: the same
    array, but in the ticks that put rows in order.
    """

    rows: NDArray[np.void]  # VEHICLE (W, C)
    next_rows: NDArray[np.void]  # VEHICLE (W, C)
    num_owned: NDArray[np.int64]  # (W,) rows [0, num_owned) are this shard's own
    num_rows: NDArray[np.int64]  # (W,) rows [num_owned, num_rows) are ghosts
    ticks: NDArray[np.int64]  # (W,) since reset
    keys: NDArray[np.uint64]  # (W,) the root of all random numbers of the episode
    signal_phase: NDArray[np.int32]  # (W, num_signals) PHASE row that is on
    controllers: NDArray[np.void]  # CONTROLLER (W, num_controllers) of the actuated programs
    detected_s: NDArray[np.float64]  # (W, D) when a body was last over each detector
    num_through: NDArray[np.int64]  # (W,) background vehicles that have arrived in this tick
    pending: NDArray[
        np.float64
    ]  # (W, A, D + 1, 2) agents' commands of the last D ticks of latency, by tick modulo D + 1
    num_near: NDArray[np.int64]  # (W,) the first ghosts, up to here, can touch owned vehicles
    num_touching: NDArray[np.int64]  # (W,) owned vehicles that touched another before this tick
    num_contacts: NDArray[np.int64]  # (W,) vehicles that began to touch another, since reset
    step: NDArray[
        np.void
    ]  # PLAN (W, C) of each row the step of its lane, see `route_following.own_step`
    step_at: NDArray[np.int64]  # (W, C) 1 + which of `TripTables.steps` that is, 0: none yet
    outer: NDArray[np.void]  # OUTER (W, C) owned next rows that other zones may see, rising
    num_outer: NDArray[np.int64]  # (W,) -1: not noted since rows changed
    cues: NDArray[np.int64]  # (W, T) the tick in which each cue of the script came, -1: not yet


class ZoneState(NamedTuple):
    """What all k zones have of W worlds, side by side; each shard's `Worlds` are views of it."""

    rows: NDArray[np.void]  # VEHICLE (2, k, W, C) what `rows` and `next_rows` are views of
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
    border: NDArray[np.int32]  # (k, W, C) owned rows that are noted at a border, rising
    num_border: NDArray[np.int64]  # (k, W)
    spare: NDArray[np.void]  # VEHICLE (1,)


class DepartureQueue(NamedTuple):
    """What one place keeps of each world, however it is divided: ids, the queue, the counts."""

    orders: NDArray[np.void]  # DEPARTURE (W, D) what a demand file orders, in order of `due`
    num_orders: NDArray[np.int64]  # (W,)
    next_order: NDArray[np.int64]  # (W,) the first one that is not due yet
    queue: NDArray[np.void]  # DEPARTURE (W, C + D) vehicles that wait to enter, in id order
    num_queue: NDArray[np.int64]  # (W,)
    next_id: NDArray[np.int64]  # (W,) the next vehicle's id
    num_entered: NDArray[np.int64]  # (W,) agents that have been ordered so far
    counts: NDArray[np.int64]  # (W, NUM_COUNTS) departed, arrived, removed since reset
    sums: NDArray[np.float64]  # (W, NUM_SUMS) sums over arrived vehicles
    passing: NDArray[np.void]  # VEHICLE (W, C + D) that leave or may enter in this tick
    num_passing: NDArray[np.int64]  # (W,)
    places: NDArray[np.int64]  # (W, C + D) where in the queue those stand that are about to enter
    tries: NDArray[np.int32]  # (W, C + D) LANE on which each of the queue tries to enter, or -1
    ranks: NDArray[np.int64]  # (W, C + D, E) how crowded the lanes of its edge are, at most E
    last_s: NDArray[np.float64]  # (W, C + D, E) where on them one enters that is to be the last, m
    lane_taken: NDArray[np.bool_]  # (L,) a vehicle tries to enter there in this tick
    spare: NDArray[np.void]  # VEHICLE (1,) room


class TripTable(NamedTuple):
    """Trips to draw from, map by map."""

    pairs: NDArray[np.int32]  # (P, 2) LANE and goal
    first: NDArray[np.int64]  # (M + 1,) trips of map m: pairs[first[m] : first[m + 1]]


class Demand(NamedTuple):
    """What the generator draws departures from; the same for all worlds of an environment."""

    agent_trips: TripTable
    start_trips: TripTable  # of background vehicles at reset, dense by lane length
    enter_trips: TripTable  # of background vehicles that enter later
    # (M,) whether those enter at the start of their lane (a road into the map)
    enter_at_start: NDArray[np.bool_]
    num_agents: int  # agents in the world at any one time
    num_ids: int  # agents that an episode can have
    num_background: int
    reenter: bool  # whether a vehicle that leaves orders a new one
    endless: bool  # whether agents get another goal before they reach theirs
    seats: bool  # whether the new one of an agent takes the same id
    speed_factor_spread: float
    blank: NDArray[np.void]  # VEHICLE (1,) what a new record starts from
    agent_types: NDArray[np.int32]  # VTYPE rows that agents have in turn, by their number


class Scratch(NamedTuple):
    """Room that a tick works in; between calls it knows nothing but which lists to clear."""

    lanes: Lists  # by lane, lists of entries
    lane_start: NDArray[np.int32]  # entries of lane l: [lane_start[l], lane_end[l]); at L: of all.
    lane_end: NDArray[np.int32]  # Both are views of `lanes.bounds`: one access to memory
    entries: NDArray[np.void]  # ENTRY (2 C + Scripts.room,) by (lane, s, id), with side lanes
    links: Lists  # by link, lists of approach
    link_start: NDArray[np.int32]  # approach of link k: [link_start[k], link_end[k])
    link_end: NDArray[np.int32]
    approach: NDArray[np.void]  # APPROACH (4 C,) vehicles on or before links, by link
    largest: NDArray[np.int8]  # (J,) the largest size class of those, by the links' junctions
    pairs: NDArray[np.void]  # APPROACH (4 C,) the same before sorting
    order: NDArray[np.int32]  # (C,) the owned rows as they lie along the lanes
    accel: NDArray[np.float64]  # (C,) decided accelerations
    link_ahead: NDArray[np.int32]  # (C,) the link whose stop line each row is next to
    lane_change: NDArray[np.int32]  # (C,) decided lane changes: 1 left, -1 right, or STAYS_ASIDE
    blinker: NDArray[np.int32]  # (C,)
    hold: NDArray[np.int32]  # (C,)
    hit: NDArray[np.int64]  # (C,) id of the vehicle each row touches


class Sensors(NamedTuple):
    """What the agents' sensors are set to, and where each writes in a frame."""

    stack: int  # frames in an observation
    ego: bool  # whether it is on; it writes at 0
    ego_size: bool  # whether it tells of the vehicle's type
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
    lanes_at: int
    lanes_range_m: float
    lidar_at: int
    lidar_rays: int
    lidar_range_m: float
    lidar_speeds: bool
    rays: NDArray[np.float64]  # (lidar_rays, 2) directions in the ego frame
    walls: Walls  # that hide neighbours; none: they are seen through walls
    near_body: NDArray[np.int32]  # (neighbors,) room; with walls, for those that they hide, too
    near_squared: NDArray[np.float64]
    echoes: NDArray[np.void]  # ECHO (lidar_rays,) room
    history_at: int
    history: int  # numbers of the frame before that stay in the next one


class Outputs(NamedTuple):
    """What agents get at the end of a step, at their own index; absent agents have zeros.

    T is the number of terms, D the size of a flat observation. What an agent saw before is kept
    here and nowhere else: the frames of a stack move up within `observations`.
    """

    observations: NDArray[np.float32]  # (W, A, D) the stacked frames, oldest first
    terms: NDArray[np.float32]  # (W, A, T)
    rewards: NDArray[np.float32]  # (W, A)
    terminated: NDArray[np.bool_]  # (W, A) the vehicle ended in this step
    present: NDArray[np.bool_]  # (W, A) had a vehicle at the end of the step
    acted: NDArray[np.bool_]  # (W, A) and had it during the whole step
    events: NDArray[np.int32]  # (W, A) EVENT_* bits of the step
    vehicle_ids: NDArray[np.int64]  # (W, A) -1 where absent
    places: NDArray[np.float64]  # (W, A, 2) x and y of the vehicle, m; left over where absent
