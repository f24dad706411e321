"""Who enters and who leaves: the seeded demand generator and the queue before the gates.

A departure is numbered and drawn when it is ordered, and enters when there is a safe gap at its
place; until then it waits in the queue, in the order of ids. None is dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import Demand, Gate, RoadArrays, Scratch, Worlds
from cavmarl.kernels.car_following import (
    ACCEL_MAX,
    DECEL_COMFORT,
    JAM_DISTANCE_M,
    TIME_HEADWAY_S,
)
from cavmarl.kernels.codes import (
    COUNT_ARRIVED,
    COUNT_DEPARTED,
    COUNT_REMOVED,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    EVENT_ARRIVED,
    EVENTS_THAT_END,
    SUM_DELAY_S,
    SUM_DISTANCE_M,
    SUM_TIME_S,
)
from cavmarl.kernels.following import REFERENCE_LENGTH_M
from cavmarl.kernels.lanes import index_lanes, neighbor_ahead, neighbor_behind
from cavmarl.kernels.motion import place_on_lane
from cavmarl.kernels.rng import (
    STREAM_ORIGIN,
    STREAM_PLACE,
    STREAM_ROUTE,
    STREAM_SPEED_FACTOR,
    below,
    uniform,
)

__all__ = ["choose_goals", "let_in", "populate", "take_out"]

PLACE_TRIES = 24  # places tried for a vehicle at reset before it has to queue
PLACE_GAP_M = 10.0  # m between bumpers of vehicles placed at reset
END_ROOM_M = 12.0  # nobody starts nearer than this to the end of a lane, unless it is shorter
ENTER_GAP_M = 3.0  # m between bumpers, the least with which a vehicle enters
ENTER_HEADWAY_S = 1.0  # and this time before the one behind
ENTER_DECEL = 2.0  # m/s², braking that an entering vehicle may impose, or need at the lane's end
ENTER_SHARE = 0.7  # of the speed limit
ENTER_REACH_M = 80.0
WANDER_M = 150.0  # nearer to its goal than this a vehicle of a closed world picks another
GOAL_TRIES = 8
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
    departure["lane"] = trips[trip, 0]
    departure["goal"] = trips[trip, 1]
    departure["ordered"] = worlds.ticks[w]
    spread = 2.0 * uniform(key, vehicle, 0, STREAM_SPEED_FACTOR) - 1.0
    departure["speed_factor"] = 1.0 + demand.speed_factor_spread * spread
    length = roads.lanes[departure["lane"]]["length_m"]
    half = 0.5 * demand.blank[0]["length"]
    free = max(length - 2.0 * half - END_ROOM_M, 0.0)
    departure["s"] = half + 1.0
    if agent >= 0 or not demand.enter_at_start:
        departure["s"] += free * uniform(key, vehicle, 0, STREAM_PLACE)


@kernel
def _enter(
    demand: Demand,
    roads: RoadArrays,
    plans: NDArray[np.void],
    gate: Gate,
    worlds: Worlds,
    w: int,
    departure: np.void,
    speed: float,
    row: np.void,
) -> None:
    """Write the record of a vehicle that enters; `row` already holds the blank."""
    row["id"] = departure["id"]
    row["agent"] = departure["agent"]
    row["driver"] = DRIVER_AGENT if departure["agent"] >= 0 else DRIVER_BACKGROUND
    row["goal"] = departure["goal"]
    row["lane"] = departure["lane"]
    row["target_lane"] = departure["lane"]
    row["s"] = departure["s"]
    row["speed"] = speed
    row["target_speed"] = speed
    row["speed_factor"] = departure["speed_factor"]
    row["rng_key"] = worlds.keys[w]
    row["departed"] = worlds.ticks[w]
    row["tick"] = worlds.ticks[w]
    cos, sin = place_on_lane(roads, row)
    row["heading"] = math.atan2(sin, cos)
    row["to_go"] = plans[row["goal"], row["lane"]]["to_go"] - row["s"]
    row["step_to_go"] = row["to_go"]
    gate.counts[w, COUNT_DEPARTED] += 1


@kernel
def _speed_at(roads: RoadArrays, lane: int, s: float, half: float) -> float:
    """A speed to start with at a place: below the limit, and slow before the end of the lane."""
    row = roads.lanes[lane]
    rest = max(row["length_m"] - s - half - 2.0, 0.0)
    return min(ENTER_SHARE * float(row["speed_mps"]), math.sqrt(2.0 * ENTER_DECEL * rest))


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
    plans: NDArray[np.void],
    gate: Gate,
    worlds: Worlds,
    chosen: NDArray[np.bool_],
) -> None:
    """Fill the chosen worlds at reset: agents first, then the background, each at a free place.

    A vehicle for which `PLACE_TRIES` places were taken waits in the queue.

    Args:
        demand: the generator's tables.
        roads: the road arrays.
        plans: PLAN (G, L).
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
            for attempt in range(PLACE_TRIES):
                trip = below(worlds.keys[w], vehicle, 0, STREAM_ORIGIN + attempt, trips.shape[0])
                departure["lane"] = trips[trip, 0]
                departure["goal"] = trips[trip, 1]
                length = roads.lanes[departure["lane"]]["length_m"]
                share = uniform(worlds.keys[w], vehicle, 0, STREAM_PLACE + attempt)
                departure["s"] = half + 1.0 + share * max(length - 2.0 * half - END_ROOM_M, 0.0)
                num = worlds.num_rows[w]
                if _is_free(worlds.rows[w], num, departure["lane"], departure["s"], half):
                    worlds.rows[w, num] = demand.blank[0]
                    speed = _speed_at(roads, departure["lane"], departure["s"], half)
                    row = worlds.rows[w, num]
                    _enter(demand, roads, plans, gate, worlds, w, departure, speed, row)
                    worlds.num_rows[w] = num + 1
                    worlds.num_owned[w] = num + 1
                    gate.num_queue[w] -= 1
                    break


@kernel
def _needs_goal(demand: Demand, plans: NDArray[np.void], row: np.void) -> bool:
    """Whether a background vehicle picks another goal: near it in a closed world, or stuck.

    Stuck is who has stood for `GIVE_UP_S` at the end of a lane that its way does not follow.
    """
    if not demand.reenter and row["to_go"] <= WANDER_M:
        return True
    step = plans[row["goal"], row["lane"]]
    stuck: bool = row["wait_s"] > GIVE_UP_S and step["next"] < 0 and step["change"] != 0
    return stuck


@kernel
def choose_goals(
    demand: Demand, roads: RoadArrays, plans: NDArray[np.void], worlds: Worlds
) -> None:
    """Give the background vehicles of `next_rows` that need it another goal, if one is in reach."""
    for w in range(worlds.ticks.shape[0]):
        for i in range(worlds.num_owned[w]):
            row = worlds.next_rows[w, i]
            if row["driver"] != DRIVER_BACKGROUND or not _needs_goal(demand, plans, row):
                continue
            for attempt in range(GOAL_TRIES):
                goal = below(
                    row["rng_key"], row["id"], row["tick"], STREAM_ROUTE + attempt, plans.shape[0]
                )
                step = plans[goal, row["lane"]]
                to_go = step["to_go"] - row["s"]
                if to_go < math.inf and to_go > WANDER_M and step["change"] == 0:
                    row["goal"] = goal
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
        while True:
            i = _next_through(rows[w], worlds.num_owned[w], driver, ticks_per_step)
            if i < 0:
                break
            row = rows[w, i]
            agent = row["agent"]
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
            if not demand.reenter:
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
def _speed_behind(gap: float, leader_speed: float) -> float:
    """The speed at which `gap` m between bumpers is just what IDM wants behind a leader.

    The positive root of jam + v·T + v·(v - leader) / (2·sqrt(a·b)) = gap, or 0.
    """
    scale = 2.0 * math.sqrt(ACCEL_MAX * DECEL_COMFORT)
    linear = TIME_HEADWAY_S - leader_speed / scale
    room = gap + REFERENCE_LENGTH_M - JAM_DISTANCE_M
    root = linear * linear + 4.0 * room / scale
    return max(0.5 * scale * (math.sqrt(max(root, 0.0)) - linear), 0.0) if room > 0.0 else 0.0


@kernel
def _gap_speed(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    lane: int,
    s: float,
    speed: float,
    scratch: Scratch,
) -> float:
    """The speed, at most `speed`, at which row i can enter safely; negative if it can not."""
    half = 0.5 * rows[i]["length"]
    j, ahead_s = neighbor_ahead(rows, i, lane, s, scratch)
    if j >= 0:
        gap = ahead_s - s - half - 0.5 * rows[j]["length"]
        if gap < ENTER_GAP_M:
            return -1.0
        speed = min(speed, _speed_behind(gap, rows[j]["speed"]))
    k, behind = neighbor_behind(roads, rows, i, lane, s, ENTER_REACH_M, scratch)
    if k >= 0:
        follower = rows[k]["speed"]
        braking = max(follower * follower - speed * speed, 0.0) / (2.0 * ENTER_DECEL)
        needed = ENTER_GAP_M + follower * ENTER_HEADWAY_S + braking
        if behind - half - 0.5 * rows[k]["length"] < needed:
            return -1.0
    return speed


@kernel
def let_in(
    demand: Demand,
    roads: RoadArrays,
    plans: NDArray[np.void],
    gate: Gate,
    worlds: Worlds,
    scratch: Scratch,
) -> None:
    """Let the first waiting departure of each world that finds a safe gap enter `next_rows`.

    One a tick: the next one sees it among the rows.
    """
    for w in range(worlds.ticks.shape[0]):
        waiting = gate.num_queue[w]
        if waiting == 0:
            continue
        rows = worlds.next_rows[w]
        i = worlds.num_owned[w]
        rows[i] = demand.blank[0]
        index_lanes(roads.lanes, rows, worlds.num_rows[w], scratch)
        for q in range(waiting):
            departure = gate.queue[w, q]
            row = rows[i]
            row["id"] = departure["id"]
            lane = departure["lane"]
            free = _speed_at(roads, lane, departure["s"], 0.5 * row["length"])
            speed = _gap_speed(roads, rows, i, lane, departure["s"], free, scratch)
            if speed < 0.0:
                continue
            _enter(demand, roads, plans, gate, worlds, w, departure, speed, row)
            worlds.num_owned[w] = i + 1
            worlds.num_rows[w] += 1
            for rest in range(q + 1, waiting):
                gate.queue[w, rest - 1] = gate.queue[w, rest]
            gate.num_queue[w] = waiting - 1
            break
