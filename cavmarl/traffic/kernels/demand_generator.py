"""The seeded demand generator, the departure queue, and the replacement of leaving vehicles.

A departure gets its vehicle id and random draws when it is ordered. It waits in the queue, which is
sorted by id, until there is a safe gap at its place. No departure is dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import (
    STREAM_MODEL,
    STREAM_ORIGIN,
    STREAM_PLACE,
    STREAM_ROUTE,
    STREAM_SPEED_FACTOR,
    below,
    uniform,
)
from cavmarl.core.records.arrays import (
    Demand,
    DepartureQueue,
    RoadArrays,
    TripTable,
    TripTables,
    Worlds,
)
from cavmarl.core.records.codes import (
    COUNT_ARRIVED,
    COUNT_DEPARTED,
    COUNT_REMOVED,
    COUNT_REROUTED,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_LEARNED,
    EVENT_ARRIVED,
    INSERT_NONE,
    LANE_GIVEN,
    POS_GIVEN,
    SPEED_MAX,
    SUM_DELAY_S,
    SUM_DISTANCE_M,
    SUM_TIME_S,
)
from cavmarl.core.records.rows import is_steered
from cavmarl.driving.kernels.lanes.route_following import distance_left, own_step, route_time_s
from cavmarl.driving.kernels.motion.motion import place_on_lane
from cavmarl.roads.kernels.lanes_now import roads_in, shares_lanes
from cavmarl.roads.kernels.map_choice import map_of
from cavmarl.traffic.kernels.entering import speed_at
from cavmarl.traffic.kernels.own_plans import follows_plan, take_plan

PLACE_TRIES = 24  # number of places tried for a vehicle at reset; then the vehicle is queued
PLACE_GAP_M = 10.0  # m between bumpers of vehicles placed at reset
END_ROOM_M = 12.0  # m between a new vehicle and the end of its lane, if the lane is long enough
PLACE_SHARE = 0.7  # initial speed of vehicles placed at reset, as a share of the speed limit
WANDER_M = 150.0  # m; in a closed world, a vehicle this near to its goal picks another goal
GOAL_TRIES = 8
REROUTE_S = 45.0  # s; a stuck vehicle with a route takes a detour after this wait
GIVE_UP_S = 10.0  # s; a stuck vehicle without a route chooses another goal after this wait


@kernel
def _order(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    departures: DepartureQueue,
    ticks: NDArray[np.int64],
    keys: NDArray[np.uint64],
    w: int,
    agent: int,
    trips: TripTable,
) -> None:
    """Append a departure with a new id and a random trip to the queue."""
    key = keys[w]
    own_map = map_of(key, roads.maps.shape[0])
    departure = departures.queue[w, _number(demand, departures, ticks[w], key, w)]
    vehicle = departure["id"]
    trip = _draw(trips, own_map, key, vehicle, 0)
    departure["agent"] = agent
    if agent >= 0:
        departure["vtype"] = demand.agent_types[agent % demand.agent_types.shape[0]]
    _send(roads, departure, trips.pairs[trip, 0], trips.pairs[trip, 1])
    length = roads.lanes[departure["lane"]]["length_m"]
    body = travel.types[departure["vtype"]]["length"]
    departure["pos"] = body + 1.0
    if agent >= 0 or not demand.enter_at_start[own_map]:
        free = max(length - body - END_ROOM_M, 0.0)
        departure["pos"] += free * uniform(key, vehicle, 0, STREAM_PLACE)


@kernel
def _number(demand: Demand, departures: DepartureQueue, tick: int, key: np.uint64, w: int) -> int:
    """Append a departure with a new id, but without a trip, to the queue; return its place."""
    vehicle = departures.next_id[w]
    departures.next_id[w] = vehicle + 1
    place: int = departures.num_queue[w]
    departure = departures.queue[w, place]
    departures.num_queue[w] = place + 1
    departure["id"] = vehicle
    departure["agent"] = -1
    departure["order"] = -1
    departure["vtype"] = _drawn_type(demand, key, vehicle)
    departure["stop"] = -1
    departure["stops_end"] = -1
    departure["lane_code"] = LANE_GIVEN
    departure["pos_code"] = POS_GIVEN
    departure["speed_code"] = SPEED_MAX
    departure["due"] = tick
    spread = 2.0 * uniform(key, vehicle, 0, STREAM_SPEED_FACTOR) - 1.0
    departure["speed_factor"] = 1.0 + demand.speed_factor_spread * spread
    return place


@inlined_kernel
def _drawn_type(demand: Demand, key: np.uint64, vehicle: int) -> int:
    """Draw the VTYPE row, and so the driver, of a vehicle of the generator."""
    last = demand.drawn_types.shape[0] - 1
    share = uniform(key, vehicle, 0, STREAM_MODEL) if last > 0 else 0.0
    k = 0
    while k < last and share >= demand.drawn_ends[k]:
        k += 1
    return int(demand.drawn_types[k])


@kernel
def insert(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    num_goals: int,
    inserted: NDArray[np.float64],  # as in `Commands`
    departures: DepartureQueue,
    ticks: NDArray[np.int64],
    keys: NDArray[np.uint64],
) -> None:
    """Append the vehicles that the caller inserts to the queue.

    Goals are tried in order, starting from a random goal; the vehicle drives to the first goal
    farther than `WANDER_M`. If its lane leads to no goal, it stops at the lane's end.
    """
    lanes = roads.lanes.shape[0]
    for w in range(ticks.size):
        for n in range(inserted.shape[1]):
            lane = int(inserted[w, n, 1])
            if (
                inserted[w, n, 0] == INSERT_NONE
                or departures.num_queue[w] >= departures.queue.shape[1]
            ):
                continue
            departure = departures.queue[w, _number(demand, departures, ticks[w], keys[w], w)]
            first = below(keys[w], departure["id"], 0, STREAM_ROUTE, num_goals)
            _send(roads, departure, lane, first)
            for k in range(num_goals):
                goal = (first + k) % num_goals
                to_go = travel.steps[goal * lanes + lane]["to_go"]
                if to_go < math.inf and to_go > WANDER_M:
                    _send(roads, departure, lane, goal)
                    break
            departure["pos"] = inserted[w, n, 2]


@kernel
def _draw(trips: TripTable, own_map: int, key: np.uint64, vehicle: int, attempt: int) -> int:
    """Draw the trip of a vehicle from the trips of its map."""
    first = trips.first[own_map]
    count = trips.first[own_map + 1] - first
    drawn: int = first + np.int64(below(key, vehicle, 0, STREAM_ORIGIN + attempt, count))
    return drawn


@kernel
def _send(roads: RoadArrays, departure: np.void, lane: int, goal: int) -> None:
    """Set the start and the goal of a generated departure."""
    departure["lane"] = lane
    departure["goal"] = goal
    departure["way"] = goal * roads.lanes.shape[0]


@kernel
def enter(
    roads: RoadArrays,
    travel: TripTables,
    worlds: Worlds,
    w: int,
    departure: np.void,
    lane: int,
    s: float,
    speed: float,
    row: np.void,
) -> None:
    """Write the record of an entering vehicle; `row` already holds the blank record."""
    kind = travel.types[departure["vtype"]]
    row["id"] = departure["id"]
    row["agent"] = departure["agent"]
    row["driver"] = DRIVER_BACKGROUND
    if kind["network"] > 0:
        row["driver"] = DRIVER_LEARNED
    if departure["agent"] >= 0:
        row["driver"] = DRIVER_AGENT
        worlds.pending[w, departure["agent"]] = 0.0
    row["order"] = departure["order"]
    row["vtype"] = departure["vtype"]
    row["length"] = kind["length"]
    row["width"] = kind["width"]
    row["height"] = kind["height"]
    row["goal"] = departure["goal"]
    row["way"] = departure["way"]
    if departure["order"] < 0:
        row["way"] += travel.shifts[w]
    row["stop"] = departure["stop"]
    row["stops_end"] = departure["stops_end"]
    row["lane"] = lane
    row["target_lane"] = lane
    row["s"] = s
    row["speed"] = speed
    row["target_speed"] = speed
    row["speed_factor"] = departure["speed_factor"]
    row["rng_key"] = worlds.keys[w]
    row["departed"] = worlds.ticks[w]
    row["tick"] = worlds.ticks[w]
    row["heading"] = place_on_lane(roads, travel, row)
    row["to_go"] = distance_left(roads, row, travel.steps[own_step(roads, row)])
    row["step_to_go"] = row["to_go"]
    if is_steered(row) and travel.trip_horizon > 0.0:
        most_s = route_time_s(roads, travel, row, worlds.ticks[w] * travel.tick_s)
        row["due"] = worlds.ticks[w] + math.ceil(most_s / travel.tick_s)


@kernel
def _is_free(rows: NDArray[np.void], num: int, lane: int, s: float, half: float) -> bool:
    for j in range(num):
        if rows[j]["lane"] == lane:
            if abs(rows[j]["s"] - s) < half + 0.5 * rows[j]["length"] + PLACE_GAP_M:
                return False
    return True


@kernel
def populate(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    departures: DepartureQueue,
    worlds: Worlds,
    chosen: NDArray[np.bool_],
) -> None:
    """Fill the chosen worlds at reset: place agents, then background vehicles, at free places.

    A vehicle waits in the queue if all `PLACE_TRIES` places that were tried are occupied.

    `demand`: the generator's tables. `worlds`: chosen worlds are written; ticks and keys must
    already belong to the new episode.
    """
    for w in range(worlds.ticks.shape[0]):
        if not chosen[w]:
            continue
        worlds.num_owned[w] = 0
        worlds.num_rows[w] = 0
        worlds.num_contacts[w] = 0
        departures.num_queue[w] = 0
        departures.next_order[w] = 0
        departures.next_id[w] = 0
        departures.counts[w, :] = 0
        departures.sums[w, :] = 0.0
        departures.num_entered[w] = demand.num_agents
        own_map = map_of(worlds.keys[w], roads.maps.shape[0])
        for n in range(demand.num_agents + demand.num_background):
            agent = n if n < demand.num_agents else -1
            trips = demand.agent_trips if agent >= 0 else demand.start_trips
            _order(demand, roads, travel, departures, worlds.ticks, worlds.keys, w, agent, trips)
            departure = departures.queue[w, departures.num_queue[w] - 1]
            vehicle = departure["id"]
            kind = travel.types[departure["vtype"]]
            half = 0.5 * kind["length"]
            for attempt in range(PLACE_TRIES):
                trip = _draw(trips, own_map, worlds.keys[w], vehicle, attempt)
                lane = trips.pairs[trip, 0]
                _send(roads, departure, lane, trips.pairs[trip, 1])
                length = roads.lanes[lane]["length_m"]
                share = uniform(worlds.keys[w], vehicle, 0, STREAM_PLACE + attempt)
                s = half + 1.0 + share * max(length - 2.0 * half - END_ROOM_M, 0.0)
                departure["pos"] = s + half
                num = worlds.num_rows[w]
                if _is_free(worlds.rows[w], num, lane, s, half):
                    worlds.rows[w, num] = demand.blank[0]
                    limit = PLACE_SHARE * roads.lanes[lane]["speed_mps"]
                    speed = speed_at(roads, kind, lane, s, limit)
                    row = worlds.rows[w, num]
                    enter(roads, travel, worlds, w, departure, lane, s, speed, row)
                    departures.counts[w, COUNT_DEPARTED] += 1
                    worlds.num_rows[w] = num + 1
                    worlds.num_owned[w] = num + 1
                    departures.num_queue[w] -= 1
                    break


@kernel
def _needs_goal(demand: Demand, roads: RoadArrays, travel: TripTables, row: np.void) -> bool:
    """Return whether a vehicle needs another goal: it is stuck, or near the end of an endless trip.

    A background vehicle is stuck if it has waited for `GIVE_UP_S` at the end of a lane that its
    route does not follow, or if a network has driven it to a lane without a route. Agents are never
    stuck.
    """
    if row["driver"] == DRIVER_AGENT:
        return demand.endless and row["to_go"] <= WANDER_M
    if row["driver"] != DRIVER_BACKGROUND and row["driver"] != DRIVER_LEARNED:
        return False
    if row["driver"] == DRIVER_LEARNED and row["to_go"] == math.inf:
        return True  # it has taken a turn from which no route leads to its goal
    if row["order"] >= 0:
        return row["goal"] >= 0 and _is_stuck(roads, travel, row, REROUTE_S)
    if not demand.reenter and row["to_go"] <= WANDER_M:
        return True
    return _is_stuck(roads, travel, row, GIVE_UP_S)


@kernel
def _is_stuck(roads: RoadArrays, travel: TripTables, row: np.void, patience_s: float) -> bool:
    if row["wait_s"] <= patience_s or roads.lanes[row["lane"]]["internal"]:
        return False
    step = travel.steps[row["way"] + row["lane"]]
    stuck: bool = step["next"] < 0 and step["change"] != 0
    return stuck


@kernel
def _take_detour(roads: RoadArrays, travel: TripTables, row: np.void) -> bool:
    """Put a vehicle of the demand file on a route to its goal without the missed lane change."""
    way = travel.first_detour + row["goal"] * roads.lanes.shape[0]
    step = travel.steps[way + row["lane"]]
    if step["next"] < 0 or way == row["way"]:
        return False
    row["way"] = way
    row["leg"] += 1
    row["to_go"] = step["to_go"] - row["s"]
    return True


@kernel
def choose_goals(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    num_goals: int,
    departures: DepartureQueue,
    worlds: Worlds,
    dt: float,
) -> None:
    """Give a reachable goal, if any, to each vehicle of `next_rows` that needs another goal.

    Call once a second. A more distant goal does not count as lost progress of an agent.
    """
    turns = max(1, round(1.0 / dt))
    for w in range(worlds.ticks.shape[0]):
        if worlds.ticks[w] % turns != 0:
            continue
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        for i in range(worlds.num_owned[w]):
            row = worlds.next_rows[w, i]
            if follows_plan(row):
                departures.counts[w, COUNT_REROUTED] += take_plan(here, travel, row, w)
            if not _needs_goal(demand, roads, travel, row):
                continue
            lane = row["lane"]
            if row["order"] >= 0:
                departures.counts[w, COUNT_REROUTED] += _take_detour(roads, travel, row)
                continue
            if roads.lanes[lane]["internal"]:
                continue
            for attempt in range(GOAL_TRIES):
                goal = below(
                    row["rng_key"], row["id"], row["tick"], STREAM_ROUTE + attempt, num_goals
                )
                way = goal * roads.lanes.shape[0] + travel.shifts[w]
                step = travel.steps[way + lane]
                to_go = step["to_go"] - row["s"]
                if to_go < math.inf and to_go > WANDER_M and step["change"] == 0:
                    row["goal"] = goal
                    row["way"] = way
                    row["leg"] += 1
                    if row["driver"] == DRIVER_AGENT:
                        row["step_to_go"] += to_go - row["to_go"]
                    row["to_go"] = to_go
                    row["events"] &= ~EVENT_ARRIVED
                    break


@kernel
def _next_leaving(departures: DepartureQueue, w: int, first: int) -> int:
    """Return the index of the smallest id in `departures.passing`, from `first` on."""
    found = first
    for n in range(first + 1, departures.num_passing[w]):
        if departures.passing[w, n]["id"] < departures.passing[w, found]["id"]:
            found = n
    return found


@kernel
def settle(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    departures: DepartureQueue,
    ticks: NDArray[np.int64],
    keys: NDArray[np.uint64],
    dt: float,
) -> None:
    """Count the vehicles that have left, and order departures that replace them.

    Vehicles are handled in the order of their ids, so that their replacements get the same ids
    wherever the rows were stored.

    `demand`: the generator's tables. `departures`: counts, sums and queue are written; `passing`
    contains the vehicles that left, and is emptied.
    """
    for w in range(ticks.size):
        for n in range(departures.num_passing[w]):
            # Rows before n are not read again.
            found = _next_leaving(departures, w, n)
            row = departures.passing[w, found]
            agent = row["agent"]
            ordered = row["order"] >= 0
            if row["events"] & EVENT_ARRIVED:
                time = (row["tick"] - row["departed"]) * dt
                departures.counts[w, COUNT_ARRIVED] += 1
                departures.sums[w, SUM_DISTANCE_M] += row["distance_m"]
                departures.sums[w, SUM_TIME_S] += time
                departures.sums[w, SUM_DELAY_S] += max(time - row["free_s"], 0.0)
            else:
                departures.counts[w, COUNT_REMOVED] += 1
            departures.passing[w, found] = departures.passing[w, n]
            if not demand.reenter or ordered:
                continue
            if agent < 0:
                _order(demand, roads, travel, departures, ticks, keys, w, -1, demand.enter_trips)
            elif demand.seats:
                _order(demand, roads, travel, departures, ticks, keys, w, agent, demand.agent_trips)
            elif departures.num_entered[w] < demand.num_ids:
                follower = departures.num_entered[w]
                departures.num_entered[w] = follower + 1
                trips = demand.agent_trips
                _order(demand, roads, travel, departures, ticks, keys, w, follower, trips)
        departures.num_passing[w] = 0


@kernel
def call_orders(departures: DepartureQueue, ticks: NDArray[np.int64]) -> None:
    """Append the ordered departures that are due by the coming tick to the queue."""
    for w in range(ticks.size):
        n = departures.next_order[w]
        while n < departures.num_orders[w] and departures.orders[w, n]["due"] <= ticks[w] + 1:
            departure = departures.queue[w, departures.num_queue[w]]
            departures.queue[w, departures.num_queue[w]] = departures.orders[w, n]
            departure["id"] = departures.next_id[w]
            departures.next_id[w] += 1
            departures.num_queue[w] += 1
            n += 1
        departures.next_order[w] = n
