"""Searches for routes of single vehicles: which vehicles search, costs, and storage.

A route found at run time is stored in a slot: room for the steps of one route at the end of
`TripTables.steps`. Each slot belongs to a world; a slot that no vehicle of the world uses is free.

The measured speed of each edge is sampled, smoothed, and used instead of the limit, as in SUMO's
rerouting device (Behrisch, Krajzewicz, Wang: "Comparing performance and quality of traffic
assignment techniques for microscopic road traffic simulations", DTA 2008): the mean speed of an
edge's vehicles, averaged over the last samples. Sums are integers in mm/s, so that no result
depends on the order of rows or of parts of a map.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import DRIVER_BACKGROUND, DRIVER_SCRIPTED, EVENT_ARRIVED
from cavmarl.roads.kernels.plans import change_cost
from cavmarl.roads.kernels.route_steps import follow_plan, plan_route

REACTION_S = 1.0  # s driven at the present speed before a driver brakes for a new turn
CHANGE_ROOM_M = 30.0  # m needed for each lane change before the next junction


@kernel
def find_asking(
    roads: RoadArrays,
    rows: NDArray[np.void],
    num: int,
    tick: int,
    has_rules: NDArray[np.bool_],
    looks: NDArray[np.void],
    changed_at: int,
    asking: NDArray[np.int64],
) -> int:
    """List the vehicles that search for a route in this second, by ascending id.

    These are background vehicles of the demand whose routes may change (`may_leave`), outside
    junctions and without a stop ahead. They are due for a search, have reached an edge with
    rerouters, or have not reacted to the last change of lanes.

    `has_rules`: (num_edges,) whether an edge has rerouters. `looks`: LOOK, by VEHICLE["order"];
    edges without rerouters are marked as seen. `changed_at`: tick of the last change, or -1.
    `asking`: receives the rows of the vehicles.

    Returns the number of vehicles.
    """
    found = 0
    for i in range(num):
        row = rows[i]
        if row["driver"] != DRIVER_BACKGROUND or row["order"] < 0:
            continue
        look = looks[row["order"]]
        lane = roads.lanes[row["lane"]]
        if not look["may_leave"] or lane["internal"] or row["events"] & EVENT_ARRIVED:
            continue
        if row["stop"] >= 0 and row["stop"] < row["stops_end"]:
            continue
        edge = lane["edge"]
        if not has_rules[edge]:
            look["seen"] = edge
        if tick >= look["next"] or look["seen"] != edge or look["reacted"] < changed_at:
            k = found
            while k > 0 and rows[asking[k - 1]]["id"] > row["id"]:
                asking[k] = asking[k - 1]
                k -= 1
            asking[k] = i
            found += 1
    return found


@kernel
def find_way(
    roads: RoadArrays,
    plan: NDArray[np.void],
    lane: int,
    permission: int,
    edges: NDArray[np.int32],
    steps: NDArray[np.void],
    cost: NDArray[np.float64],
) -> int:
    """Write the steps of the route from a lane along a plan.

    Args:
        roads: the road arrays, with the current speeds as limits.
        plan: PLAN (L,) of the goal, made with the same speeds.
        lane: LANE row outside junctions.
        permission: bits of the vehicle class.
        edges: scratch for EDGE rows.
        steps: PLAN, receives the steps; the steps of the lane's edge come first.
        cost: scratch, as long as `steps`.

    Returns:
        The number of steps written; 0 if there is no route or it does not fit into `steps`.
    """
    if plan[lane]["to_go"] == math.inf:
        return 0
    number = follow_plan(roads, plan, lane, edges)
    if number < 0:
        return 0
    total = 0
    for n in range(number):
        total += roads.edges[edges[n]]["num_lanes"]
    if total > steps.shape[0]:
        return 0
    return plan_route(roads, edges[:number], permission, 0, steps, cost)


@kernel
def time_left(roads: RoadArrays, steps: NDArray[np.void], way: int, lane: int) -> float:
    """Return the time in s from the start of a lane to the end of a route, with lane changes.

    `roads`: the road arrays, with the current speeds. `steps`: PLAN that contains the route. `way`:
    VEHICLE["way"].
    """
    total: float = 0.0
    while True:
        row = roads.lanes[lane]
        if row["internal"]:
            total += row["length_m"] / row["speed_mps"]
            lane = row["successor"]
            continue
        step = steps[way + lane]
        if step["to_go"] == math.inf:
            return math.inf
        if step["change"] != 0:
            total += change_cost(roads, lane, 1.0)
            lane = row["left"] if step["change"] > 0 else row["right"]
            continue
        total += row["length_m"] / row["speed_mps"]
        if step["next"] < 0:
            return total
        way += step["shift"]
        lane = step["next"]


@kernel
def has_room(
    roads: RoadArrays, travel: TripTables, row: np.void, steps: NDArray[np.void], way: int
) -> bool:
    """Return whether a vehicle can change to another route from its lane without hard braking.

    `travel`: types, and the present route. `row`: VEHICLE outside junctions. `steps`: PLAN that
    contains the other route. `way`: value of VEHICLE["way"] for that route.
    """
    step = steps[way + row["lane"]]
    present = travel.steps[row["way"] + row["lane"]]
    if step["change"] == 0 and present["change"] == 0 and step["link"] == present["link"]:
        return True
    speed = row["speed"]
    brake = speed * speed / (2.0 * travel.types[row["vtype"]]["decel"])
    left = roads.lanes[row["lane"]]["length_m"] - row["s"] - 0.5 * row["length"]
    enough: bool = left >= brake + REACTION_S * speed + CHANGE_ROOM_M * step["changes"]
    return enough


@kernel
def mark_slots(
    roads: RoadArrays,
    rows: NDArray[np.void],
    num: int,
    first_slot: int,
    slot_steps: int,
    used: NDArray[np.bool_],
) -> None:
    """Mark the slots of a world that vehicles use.

    `first_slot`: PLAN row of the world's first slot. `used`: (num_slots,), written.
    """
    used[:] = False
    for i in range(num):
        slot = slot_of(roads, rows[i], first_slot, slot_steps)
        if slot >= 0:
            used[slot] = True


@kernel
def slot_of(roads: RoadArrays, row: np.void, first_slot: int, slot_steps: int) -> int:
    """Return the slot of a vehicle's route, or -1 if the route is not in a slot."""
    lane = row["lane"]
    if roads.lanes[lane]["internal"]:
        lane = roads.links[roads.lanes[lane]["link"]]["to_lane"]
    place = row["way"] + lane - first_slot
    slot: int = place // slot_steps if place >= 0 else -1
    return slot


@kernel
def take_slot(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    found: NDArray[np.void],
    first_slot: int,
    slot_steps: int,
    used: NDArray[np.bool_],
) -> bool:
    """Store the steps of a new route in a slot, and put the vehicle on that route.

    `travel`: steps in the slots are written. `row`: VEHICLE, written. `found`: PLAN, the steps; the
    steps of the vehicle's edge come first. `first_slot`: PLAN row of the world's first slot.
    `used`: (num_slots,) occupied slots, written.

    Returns whether a slot was free.
    """
    slot = slot_of(roads, row, first_slot, slot_steps)
    if slot < 0:
        slot = 0
        while slot < used.shape[0] and used[slot]:
            slot += 1
        if slot == used.shape[0]:
            return False
        used[slot] = True
    begin = first_slot + slot * slot_steps
    for n in range(found.shape[0]):
        travel.steps[begin + n] = found[n]
    put_on_way(travel, row, begin - roads.edges[roads.lanes[row["lane"]]["edge"]]["first_lane"])
    return True


@kernel
def put_on_way(travel: TripTables, row: np.void, way: int) -> None:
    """Put a vehicle outside junctions on another route that starts from its lane."""
    row["way"] = way
    row["leg"] += 1
    row["to_go"] = travel.steps[way + row["lane"]]["to_go"] - row["s"]


CLOSED_S = 1e9  # s to drive along a closed lane; any detour is faster
LEAST_MPS = 0.001  # minimum speed, so that a jam has a finite travel time


@kernel
def _millimetres(speed: float) -> int:
    return int(max(speed, 0.0) * 1000.0 + 0.5)


@kernel
def limit_speeds(roads: RoadArrays, past: NDArray[np.int32], speed_sums: NDArray[np.int64]) -> None:
    """Set all samples to the speed limits, as on an empty map.

    `past`: (N, num_edges) mm/s, written. `speed_sums`: (num_edges,) mm/s, written: the sums over
    the N samples.
    """
    for edge in range(roads.edges.shape[0]):
        row = roads.edges[edge]
        total = 0
        for lane in range(row["first_lane"], row["first_lane"] + row["num_lanes"]):
            total += _millimetres(roads.lanes[lane]["speed_mps"])
        mean = total // row["num_lanes"]
        past[:, edge] = mean
        speed_sums[edge] = mean * past.shape[0]


@kernel
def sample_speeds(
    roads: RoadArrays,
    rows: NDArray[np.void],
    num: int,
    number: int,
    past: NDArray[np.int32],
    speed_sums: NDArray[np.int64],
    lane_counts: NDArray[np.int64],
    lane_sums: NDArray[np.int64],
) -> None:
    """Sample the mean speed of every edge; the sample replaces the oldest sample.

    A lane without vehicles counts as one vehicle at the speed limit; vehicles at a stop and
    scripted vehicles do not count.

    `number`: samples since the reset. `past`: (N, num_edges) the last samples in mm/s.
    `speed_sums`: (num_edges,) sums of these samples. `lane_counts`: (L,) scratch. `lane_sums`: (L,)
    scratch.
    """
    lane_counts[:] = 0
    lane_sums[:] = 0
    for i in range(num):
        if rows[i]["stopped_s"] > 0.0 or rows[i]["driver"] == DRIVER_SCRIPTED:
            continue
        lane_counts[rows[i]["lane"]] += 1
        lane_sums[rows[i]["lane"]] += _millimetres(rows[i]["speed"])
    oldest = number % past.shape[0]
    for edge in range(roads.edges.shape[0]):
        row = roads.edges[edge]
        total = 0
        count = 0
        for lane in range(row["first_lane"], row["first_lane"] + row["num_lanes"]):
            if lane_counts[lane] == 0:
                total += _millimetres(roads.lanes[lane]["speed_mps"])
                count += 1
            else:
                total += lane_sums[lane]
                count += lane_counts[lane]
        mean = total // count
        speed_sums[edge] += mean - past[oldest, edge]
        past[oldest, edge] = mean


@kernel
def slow_lanes(
    roads: RoadArrays,
    speed_sums: NDArray[np.int64],
    samples: int,
    closed: NDArray[np.int64],
    now: NDArray[np.void],
    permission: int,
    lanes: NDArray[np.void],
) -> None:
    """Write the current speeds to a copy of the lanes, for plans that consider traffic.

    Args:
        roads: the road arrays.
        speed_sums: (num_edges,) mm/s, see `sample_speeds`.
        samples: number of samples in each sum; 0: use the limits.
        closed: (num_edges,) bits of the classes that may not use an edge.
        now: LANE (L,) of the world.
        permission: bits of the vehicle class.
        lanes: LANE (L,); "speed_mps" is written.
    """
    for lane in range(lanes.shape[0]):
        row = roads.lanes[lane]
        edge = row["edge"]
        speed = now[lane]["speed_mps"]
        if samples > 0:
            speed = min(speed, max(speed_sums[edge] / (1000.0 * samples), LEAST_MPS))
        is_shut = (
            row["permissions"] & permission != 0 and now[lane]["permissions"] & permission == 0
        )
        if is_shut or closed[edge] & permission == permission:
            speed = row["length_m"] / CLOSED_S
        lanes[lane]["speed_mps"] = speed
