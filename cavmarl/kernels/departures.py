"""Who enters and who leaves: the seeded demand generator and the queue before the gates.

A departure is numbered and drawn when it is ordered, and enters when there is a safe gap at its
place; until then it waits in the queue, in the order of ids. None is dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import Demand, Gate, RoadArrays, Scratch, Travel, Worlds
from cavmarl.kernels.codes import (
    COUNT_ARRIVED,
    COUNT_DEPARTED,
    COUNT_REMOVED,
    COUNT_REROUTED,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    EVENT_ARRIVED,
    EVENTS_THAT_END,
    LANE_GIVEN,
    POS_GIVEN,
    SPEED_MAX,
    SUM_DELAY_S,
    SUM_DISTANCE_M,
    SUM_TIME_S,
)
from cavmarl.kernels.entering import (
    entry_lane,
    entry_place,
    entry_speed,
    follower_brakes,
    speed_at,
)
from cavmarl.kernels.geometry import boxes_overlap
from cavmarl.kernels.lanes import index_lanes
from cavmarl.kernels.motion import place_on_lane
from cavmarl.kernels.neighbors import LEVEL_HEIGHT_M
from cavmarl.kernels.rng import (
    STREAM_ORIGIN,
    STREAM_PLACE,
    STREAM_ROUTE,
    STREAM_SPEED_FACTOR,
    below,
    uniform,
)
from cavmarl.kernels.ways import own_step, way_left

__all__ = ["call_orders", "choose_goals", "let_in", "populate", "take_out"]

PLACE_TRIES = 24  # places tried for a vehicle at reset before it has to queue
PLACE_GAP_M = 10.0  # m between bumpers of vehicles placed at reset
END_ROOM_M = 12.0  # nobody starts nearer than this to the end of a lane, unless it is shorter
PLACE_SHARE = 0.7  # of the speed limit, with which vehicles drive that are placed at reset
ENTER_ROOM_M = 0.3  # free on all sides of a vehicle that enters
WANDER_M = 150.0  # nearer to its goal than this a vehicle of a closed world picks another
GOAL_TRIES = 8
REROUTE_S = 45.0  # one on a route so long
GIVE_UP_S = 10.0  # a driver that waits longer than this to change lanes takes another way


@kernel
def _order(
    demand: Demand,
    roads: RoadArrays,
    gate: Gate,
    worlds: Worlds,
    w: int,
    agent: int,
    trips: NDArray[np.int32],
) -> None:
    """Number and draw one departure and put it at the end of the queue."""
    vehicle = gate.next_id[w]
    gate.next_id[w] = vehicle + 1
    key = worlds.keys[w]
    trip = below(key, vehicle, 0, STREAM_ORIGIN, trips.shape[0])
    departure = gate.queue[w, gate.num_queue[w]]
    gate.num_queue[w] += 1
    departure["id"] = vehicle
    departure["agent"] = agent
    departure["order"] = -1
    departure["vtype"] = demand.blank[0]["vtype"]
    departure["stop"] = -1
    departure["stops_end"] = -1
    departure["lane_code"] = LANE_GIVEN
    departure["pos_code"] = POS_GIVEN
    departure["speed_code"] = SPEED_MAX
    departure["due"] = worlds.ticks[w]
    _send(roads, departure, trips[trip, 0], trips[trip, 1])
    spread = 2.0 * uniform(key, vehicle, 0, STREAM_SPEED_FACTOR) - 1.0
    departure["speed_factor"] = 1.0 + demand.speed_factor_spread * spread
    length = roads.lanes[departure["lane"]]["length_m"]
    body = demand.blank[0]["length"]
    departure["pos"] = body + 1.0
    if agent >= 0 or not demand.enter_at_start:
        free = max(length - body - END_ROOM_M, 0.0)
        departure["pos"] += free * uniform(key, vehicle, 0, STREAM_PLACE)


@kernel
def _send(roads: RoadArrays, departure: np.void, lane: int, goal: int) -> None:
    """Set where a departure of the generator starts and where it goes."""
    departure["lane"] = lane
    departure["goal"] = goal
    departure["way"] = goal * roads.lanes.shape[0]


@kernel
def _enter(
    roads: RoadArrays,
    travel: Travel,
    worlds: Worlds,
    w: int,
    departure: np.void,
    lane: int,
    s: float,
    speed: float,
    row: np.void,
) -> None:
    """Write the record of a vehicle that enters; `row` already holds the blank."""
    kind = travel.types[departure["vtype"]]
    row["id"] = departure["id"]
    row["agent"] = departure["agent"]
    row["driver"] = DRIVER_BACKGROUND
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
    row["to_go"] = way_left(roads, row, travel.steps[own_step(roads, row)])
    row["step_to_go"] = row["to_go"]


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
    travel: Travel,
    gate: Gate,
    worlds: Worlds,
    chosen: NDArray[np.bool_],
) -> None:
    """Fill the chosen worlds at reset: agents first, then the background, each at a free place.

    A vehicle for which `PLACE_TRIES` places were taken waits in the queue.

    Args:
        demand: the generator's tables.
        roads: the road arrays.
        travel: types and ways.
        gate: written where chosen.
        worlds: written where chosen; ticks and keys are already those of the new episode.
        chosen: (W,) which worlds.
    """
    half = 0.5 * demand.blank[0]["length"]
    for w in range(worlds.ticks.shape[0]):
        if not chosen[w]:
            continue
        worlds.num_owned[w] = 0
        worlds.num_rows[w] = 0
        worlds.num_contacts[w] = 0
        gate.num_queue[w] = 0
        gate.next_order[w] = 0
        gate.next_id[w] = 0
        gate.counts[w, :] = 0
        gate.sums[w, :] = 0.0
        gate.num_entered[w] = demand.num_agents
        for n in range(demand.num_agents + demand.num_background):
            agent = n if n < demand.num_agents else -1
            trips = demand.agent_trips if agent >= 0 else demand.start_trips
            _order(demand, roads, gate, worlds, w, agent, trips)
            departure = gate.queue[w, gate.num_queue[w] - 1]
            vehicle = departure["id"]
            kind = travel.types[departure["vtype"]]
            for attempt in range(PLACE_TRIES):
                trip = below(worlds.keys[w], vehicle, 0, STREAM_ORIGIN + attempt, trips.shape[0])
                lane = trips[trip, 0]
                _send(roads, departure, lane, trips[trip, 1])
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
                    _enter(roads, travel, worlds, w, departure, lane, s, speed, row)
                    gate.counts[w, COUNT_DEPARTED] += 1
                    worlds.num_rows[w] = num + 1
                    worlds.num_owned[w] = num + 1
                    gate.num_queue[w] -= 1
                    break


@kernel
def _needs_goal(demand: Demand, roads: RoadArrays, travel: Travel, row: np.void) -> bool:
    """Whether a background vehicle picks another goal: near it in a closed world, or stuck.

    Stuck is who has stood for `GIVE_UP_S` at the end of a lane that its way does not follow.
    """
    if row["driver"] != DRIVER_BACKGROUND:
        return False
    if row["order"] >= 0:
        return row["goal"] >= 0 and _is_stuck(roads, travel, row, REROUTE_S)
    if not demand.reenter and row["to_go"] <= WANDER_M:
        return True
    return _is_stuck(roads, travel, row, GIVE_UP_S)


@kernel
def _is_stuck(roads: RoadArrays, travel: Travel, row: np.void, patience_s: float) -> bool:
    if row["wait_s"] <= patience_s or roads.lanes[row["lane"]]["internal"]:
        return False
    step = travel.steps[row["way"] + row["lane"]]
    stuck: bool = step["next"] < 0 and step["change"] != 0
    return stuck


@kernel
def _take_detour(roads: RoadArrays, travel: Travel, row: np.void) -> bool:
    """Send a vehicle of the demand file on to its goal without the lane change it waits for."""
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
    travel: Travel,
    num_goals: int,
    gate: Gate,
    worlds: Worlds,
    dt: float,
) -> None:
    """Give the background vehicles of `next_rows` that need it another goal, if one is in reach.

    Asked about once a second.
    """
    turns = max(1, round(1.0 / dt))
    for w in range(worlds.ticks.shape[0]):
        if worlds.ticks[w] % turns != 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.next_rows[w, i]
            if not _needs_goal(demand, roads, travel, row):
                continue
            lane = row["lane"]
            if row["order"] >= 0:
                gate.counts[w, COUNT_REROUTED] += _take_detour(roads, travel, row)
                continue
            if roads.lanes[lane]["internal"]:
                continue
            for attempt in range(GOAL_TRIES):
                goal = below(
                    row["rng_key"], row["id"], row["tick"], STREAM_ROUTE + attempt, num_goals
                )
                way = goal * roads.lanes.shape[0]
                step = travel.steps[way + lane]
                to_go = step["to_go"] - row["s"]
                if to_go < math.inf and to_go > WANDER_M and step["change"] == 0:
                    row["goal"] = goal
                    row["way"] = way
                    row["leg"] += 1
                    row["to_go"] = to_go
                    row["events"] &= ~EVENT_ARRIVED
                    break


@kernel
def _next_through(rows: NDArray[np.void], num: int, driver: int, ticks_per_step: int) -> int:
    """Row of the smallest id among the vehicles of one kind of driver that are through, or -1."""
    ending = EVENTS_THAT_END if driver == DRIVER_AGENT else EVENT_ARRIVED
    first = -1
    for i in range(num):
        row = rows[i]
        if row["driver"] != driver or not row["events"] & ending:
            continue
        if driver == DRIVER_AGENT and row["departed"] > row["tick"] - ticks_per_step:
            continue
        if first < 0 or row["id"] < rows[first]["id"]:
            first = i
    return first


@kernel
def take_out(
    demand: Demand,
    roads: RoadArrays,
    gate: Gate,
    worlds: Worlds,
    rows: NDArray[np.void],
    driver: int,
    dt: float,
    ticks_per_step: int,
) -> None:
    """Take out the vehicles of one kind of driver that are through, and order those that follow.

    They go in the order of their ids, so that who follows gets the same number wherever the rows
    lie. Background vehicles are through when they have arrived; agents that have acted also after a
    collision or off the road.

    Args:
        demand: the generator's tables.
        roads: the road arrays.
        gate: counts, sums and queue are written.
        worlds: how many rows there are is written.
        rows: VEHICLE (W, C), the rows to take from.
        driver: DRIVER_*.
        dt: seconds of a tick.
        ticks_per_step: ticks a step; agents that entered within the last of them have not acted.
    """
    for w in range(worlds.ticks.shape[0]):
        if driver == DRIVER_BACKGROUND and worlds.num_through[w] == 0:
            continue
        while True:
            i = _next_through(rows[w], worlds.num_owned[w], driver, ticks_per_step)
            if i < 0:
                break
            row = rows[w, i]
            agent = row["agent"]
            ordered = row["order"] >= 0
            if row["events"] & EVENT_ARRIVED:
                time = (row["tick"] - row["departed"]) * dt
                gate.counts[w, COUNT_ARRIVED] += 1
                gate.sums[w, SUM_DISTANCE_M] += row["distance_m"]
                gate.sums[w, SUM_TIME_S] += time
                gate.sums[w, SUM_DELAY_S] += max(time - row["free_s"], 0.0)
            else:
                gate.counts[w, COUNT_REMOVED] += 1
            last = worlds.num_owned[w] - 1
            rows[w, i] = rows[w, last]
            worlds.num_owned[w] = last
            worlds.num_rows[w] -= 1
            if not demand.reenter or ordered:
                continue
            if agent < 0:
                _order(demand, roads, gate, worlds, w, -1, demand.enter_trips)
            elif demand.seats:
                _order(demand, roads, gate, worlds, w, agent, demand.agent_trips)
            elif gate.num_entered[w] < demand.num_ids:
                follower = gate.num_entered[w]
                gate.num_entered[w] = follower + 1
                _order(demand, roads, gate, worlds, w, follower, demand.agent_trips)


@kernel
def call_orders(gate: Gate, worlds: Worlds) -> None:
    """Put the ordered departures that are due by the coming tick at the end of the queue."""
    for w in range(worlds.ticks.shape[0]):
        n = gate.next_order[w]
        while n < gate.num_orders[w] and gate.orders[w, n]["due"] <= worlds.ticks[w] + 1:
            departure = gate.queue[w, gate.num_queue[w]]
            gate.queue[w, gate.num_queue[w]] = gate.orders[w, n]
            departure["id"] = gate.next_id[w]
            gate.next_id[w] += 1
            gate.num_queue[w] += 1
            n += 1
        gate.next_order[w] = n


@kernel
def _touches(rows: NDArray[np.void], i: int) -> bool:
    """Whether row i, with some room around it, touches one of the rows before it."""
    own = rows[i]
    cos = math.cos(own["heading"])
    sin = math.sin(own["heading"])
    half_length = 0.5 * own["length"] + ENTER_ROOM_M
    half_width = 0.5 * own["width"] + ENTER_ROOM_M
    for j in range(i):
        other = rows[j]
        dx = other["x"] - own["x"]
        dy = other["y"] - own["y"]
        reach = half_length + half_width + 0.5 * (other["length"] + other["width"])
        if dx * dx + dy * dy > reach * reach or abs(other["z"] - own["z"]) > LEVEL_HEIGHT_M:
            continue
        if boxes_overlap(
            own["x"],
            own["y"],
            cos,
            sin,
            half_length,
            half_width,
            other["x"],
            other["y"],
            math.cos(other["heading"]),
            math.sin(other["heading"]),
            0.5 * other["length"],
            0.5 * other["width"],
        ):
            return True
    return False


@kernel
def _try_to_enter(
    demand: Demand,
    roads: RoadArrays,
    travel: Travel,
    gate: Gate,
    worlds: Worlds,
    w: int,
    departure: np.void,
    scratch: Scratch,
) -> bool:
    """Let one departure enter `next_rows` if it finds a safe gap on its lane."""
    key = worlds.keys[w]
    lane = entry_lane(roads, travel, key, departure, scratch)
    if lane < 0:
        return False
    # The lane is taken whether or not there is room: who waits longer goes first.
    scratch.lane_taken[lane] = True
    rows = worlds.next_rows[w]
    kind = travel.types[departure["vtype"]]
    s = entry_place(roads, key, departure, kind, lane, worlds.ticks[w], scratch)
    speed = entry_speed(roads, travel, key, departure, kind, lane, s, scratch)
    if speed < 0.0:
        return False
    if follower_brakes(roads, travel, rows, departure, kind, lane, s, speed, scratch):
        return False
    i = worlds.num_rows[w]
    rows[i] = demand.blank[0]
    _enter(roads, travel, worlds, w, departure, lane, s, speed, rows[i])
    if _touches(rows, i):
        return False
    gate.counts[w, COUNT_DEPARTED] += 1
    worlds.num_owned[w] += 1
    worlds.num_rows[w] += 1
    return True


@kernel
def let_in(
    demand: Demand,
    roads: RoadArrays,
    travel: Travel,
    gate: Gate,
    worlds: Worlds,
    scratch: Scratch,
) -> None:
    """Let the waiting departures that find a safe gap enter `next_rows`, at most one a lane."""
    for w in range(worlds.ticks.shape[0]):
        waiting = gate.num_queue[w]
        if waiting == 0:
            continue
        index_lanes(roads, travel, worlds.next_rows[w], worlds.num_rows[w], scratch)
        scratch.lane_taken[:] = False
        kept = 0
        for q in range(waiting):
            departure = gate.queue[w, q]
            full = worlds.num_rows[w] == worlds.rows.shape[1]
            if not full and _try_to_enter(
                demand, roads, travel, gate, worlds, w, departure, scratch
            ):
                continue
            if kept < q:
                gate.queue[w, kept] = departure
            kept += 1
        gate.num_queue[w] = kept
