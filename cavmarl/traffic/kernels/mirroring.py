"""SUMO's vehicles as rows, each at the place that SUMO reports for the same tick.

SUMO reports the middle of the front bumper, its position on the lane, and degrees clockwise from
north. A row describes the centre of the body.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import atan, cosine, sine
from cavmarl.core.math.geometry import lane_pose, wrap_angle
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays, TripTables, ZoneState
from cavmarl.core.records.codes import (
    COUNT_DEPARTED,
    DRIVER_BACKGROUND,
    DRIVER_SUMO,
    EVENT_ARRIVED,
)
from cavmarl.driving.kernels.lanes.route_following import distance_left, free_speed, own_step
from cavmarl.driving.kernels.motion.motion import account, before_tick, lane_before
from cavmarl.driving.kernels.motion.tracking import side_lane

BODY_LANES = 8  # maximum number of lanes between the front and the centre of a body
BLINKS_RIGHT = 1  # bit in SUMO's vehicle signals; so is BLINKS_LEFT
BLINKS_LEFT = 2
EDGES_BEHIND = 2  # the centre is searched from this many edges before the front's edge to one after


class Paths(NamedTuple):
    """SUMO's routes as values of VEHICLE["way"], one path per route and vehicle class."""

    first: NDArray[np.int64]  # (P + 1,) path p has the rows [first[p], first[p + 1]) of:
    edges: NDArray[np.int32]  # EDGE rows; -1: not on this map
    ways: NDArray[np.int64]  # VEHICLE["way"] on that edge
    nowhere: int  # VEHICLE["way"] of a vehicle on no edge of its route


@kernel
def mirror(
    roads: RoadArrays,
    travel: TripTables,
    paths: Paths,
    seen: NDArray[np.void],
    zoned: ZoneState,
    side: int,
    w: int,
    dt: float,
) -> int:
    """Update a world's mirrored rows, in all zones, to the state that SUMO reports.

    `seen`: SEEN (n,) by ascending number; the field `route` contains paths. `zoned`: the owned rows
    in half `side` of its rows are written; vehicles that SUMO has removed are marked as arrived.

    Returns the number of arrived vehicles.
    """
    gone = 0
    for zone in range(zoned.num_owned.shape[0]):
        found = False
        for i in range(zoned.num_owned[zone, w]):
            row = zoned.rows[side, zone, w, i]
            if row["driver"] != DRIVER_SUMO:
                continue
            found = True
            before = before_tick(row)
            place = _find(seen, row["order"])
            row["events"] = 0
            if place < 0:
                row["events"] = EVENT_ARRIVED
                row["tick"] += 1
                gone += 1
                continue
            _stand_in(roads, travel, paths, seen[place], row)
            row["throttle"] = (row["speed"] - before.speed) / dt
            kind = travel.types[row["vtype"]]
            account(row, before, free_speed(roads.lanes[before.lane], kind, 1.0), dt)
        if found:
            zoned.num_outer[zone, w] = -1
    return gone


@kernel
def greet(
    roads: RoadArrays,
    travel: TripTables,
    paths: Paths,
    seen: NDArray[np.void],
    departed: NDArray[np.int64],
    speed_factors: NDArray[np.float64],
    blank: NDArray[np.void],
    departures: DepartureQueue,
    w: int,
    tick: int,
    key: np.uint64,
) -> None:
    """Add a row with a new id to `departures.passing` for each vehicle that SUMO has inserted.

    `seen`: as in `mirror`. `departed`: numbers of the inserted vehicles, ascending. `departures`:
    passing, ids and counts are written. `tick`: tick of entering. `key`: root of random numbers.
    """
    for n in range(departed.size):
        place = _find(seen, departed[n])
        row = departures.passing[w, departures.num_passing[w]]
        departures.passing[w, departures.num_passing[w]] = blank[0]
        departures.num_passing[w] += 1
        row["id"] = departures.next_id[w]
        departures.next_id[w] += 1
        departures.counts[w, COUNT_DEPARTED] += 1
        kind = travel.types[seen[place]["vtype"]]
        row["driver"] = DRIVER_SUMO
        row["order"] = departed[n]
        row["vtype"] = seen[place]["vtype"]
        row["length"] = kind["length"]
        row["width"] = kind["width"]
        row["height"] = kind["height"]
        row["speed_factor"] = speed_factors[n]
        row["goal"] = -1
        row["rng_key"] = key
        row["departed"] = tick
        row["tick"] = tick
        _stand_in(roads, travel, paths, seen[place], row)
        row["target_speed"] = row["speed"]
        row["step_to_go"] = row["to_go"]


@kernel
def list_others(zoned: ZoneState, side: int, w: int, out: NDArray[np.void]) -> int:
    """Copy all owned rows that SUMO does not move into `out`; return their number."""
    found = 0
    for zone in range(zoned.num_owned.shape[0]):
        for i in range(zoned.num_owned[zone, w]):
            if zoned.rows[side, zone, w, i]["driver"] != DRIVER_SUMO:
                out[found] = zoned.rows[side, zone, w, i]
                found += 1
    return found


@kernel
def send_on(
    roads: RoadArrays,
    paths: Paths,
    numbers: NDArray[np.int64],
    chosen: NDArray[np.int64],
    zoned: ZoneState,
    side: int,
    w: int,
) -> int:
    """Put vehicles of this package on the new routes that SUMO has found for them.

    A vehicle that is on no edge of its new route keeps the old route.

    `numbers`: (n,) VEHICLE["order"] of the vehicles, ascending. `chosen`: (n,) their new paths.
    `zoned`: the owned rows in half `side` of its rows are written.

    Returns the number of vehicles on a new route.
    """
    taken = 0
    for zone in range(zoned.num_owned.shape[0]):
        for i in range(zoned.num_owned[zone, w]):
            row = zoned.rows[side, zone, w, i]
            n = np.searchsorted(numbers, row["order"])
            if row["order"] < 0 or n == numbers.size or numbers[n] != row["order"]:
                continue
            if row["driver"] != DRIVER_BACKGROUND:  # `order` is the slot of the caller's vehicles
                continue
            edge = _edge_to_be(roads, row["lane"])
            for k in range(paths.first[chosen[n]], paths.first[chosen[n] + 1]):
                if paths.edges[k] == edge:
                    row["way"] = paths.ways[k]
                    row["leg"] += 1
                    taken += 1
                    break
    return taken


@kernel
def find_blocked(
    roads: RoadArrays,
    travel: TripTables,
    lanes: NDArray[np.void],
    zoned: ZoneState,
    side: int,
    w: int,
    out: NDArray[np.void],
) -> int:
    """Copy to `out` the owned rows of demand vehicles whose routes lead over a closed road.

    Rows in a junction or with a stop ahead are left out. `lanes`: LANE (L,) of the world.

    Returns the number of rows.
    """
    found = 0
    for zone in range(zoned.num_owned.shape[0]):
        for i in range(zoned.num_owned[zone, w]):
            row = zoned.rows[side, zone, w, i]
            if row["driver"] != DRIVER_BACKGROUND or row["order"] < 0:
                continue
            if row["stop"] >= 0 and row["stop"] < row["stops_end"]:
                continue
            if not roads.lanes[row["lane"]]["internal"] and _is_blocked(roads, travel, lanes, row):
                out[found] = row
                found += 1
    return found


@inlined_kernel
def _is_blocked(
    roads: RoadArrays, travel: TripTables, lanes: NDArray[np.void], row: np.void
) -> bool:
    """Return whether a road ahead on the route of a row outside junctions is closed to it."""
    permissions = travel.types[row["vtype"]]["permissions"]
    lane = row["lane"]
    edge = roads.lanes[lane]["edge"]
    way = row["way"]
    while True:
        here = roads.lanes[lane]
        if here["internal"]:
            lane = here["successor"]
            continue
        if here["edge"] != edge:
            edge = here["edge"]
            if _is_closed(roads, lanes, edge, permissions):
                return True
        step = travel.steps[way + lane]
        if step["to_go"] == math.inf:
            return False
        if step["change"] != 0:
            lane = here["left"] if step["change"] > 0 else here["right"]
            continue
        if step["next"] < 0:
            return False
        way += step["shift"]
        lane = step["next"]


@inlined_kernel
def _is_closed(
    roads: RoadArrays, lanes: NDArray[np.void], edge: int, permissions: np.uint32
) -> bool:
    """Return whether all lanes of an edge that a vehicle may use on the map are now closed."""
    first = roads.edges[edge]["first_lane"]
    is_open = False
    was_open = False
    for lane in range(first, first + roads.edges[edge]["num_lanes"]):
        is_open = is_open or lanes[lane]["permissions"] & permissions != 0
        was_open = was_open or roads.lanes[lane]["permissions"] & permissions != 0
    return was_open and not is_open


@inlined_kernel
def _find(seen: NDArray[np.void], number: int) -> int:
    """Return the index of a number in ascending numbers, or -1."""
    low = 0
    high = seen.shape[0]
    while low < high:
        middle = (low + high) // 2
        if seen[middle]["number"] < number:
            low = middle + 1
        else:
            high = middle
    if low < seen.shape[0] and seen[low]["number"] == number:
        return low
    return -1


@inlined_kernel
def _stand_in(
    roads: RoadArrays, travel: TripTables, paths: Paths, seen: np.void, row: np.void
) -> None:
    half = 0.5 * row["length"]
    heading = wrap_angle(0.5 * math.pi - math.radians(seen["angle"]))
    row["heading"] = heading
    row["x"] = seen["x"] - half * cosine(heading)
    row["y"] = seen["y"] - half * sine(heading)
    row["speed"] = seen["speed"]
    _place_centre(roads, seen, row)
    lane = roads.lanes[row["lane"]]
    _, _, _, _, _, slope = lane_pose(
        roads.points, lane["first_point"], lane["num_points"], row["s"]
    )
    row["z"] = seen["z"] - half * slope
    row["pitch"] = atan(slope)
    row["side_lane"] = side_lane(roads, row)
    row["target_lane"] = row["lane"]
    signals = seen["signals"]
    row["blinker"] = 0
    if signals & BLINKS_LEFT:
        row["blinker"] = 1
    elif signals & BLINKS_RIGHT:
        row["blinker"] = -1
    row["way"] = _way_at(roads, paths, seen["route"], seen["at"], row["lane"])
    row["to_go"] = distance_left(roads, row, travel.steps[own_step(roads, row)])


@inlined_kernel
def _place_centre(roads: RoadArrays, seen: np.void, row: np.void) -> None:
    """Set lane, s and d of the centre, which may be on a lane before the front's lane."""
    lane = seen["lane"]
    here = roads.lanes[lane]
    if here["internal"]:
        row["link"] = here["link"]
    # The length attribute of SUMO's lanes may differ from the length of their polyline.
    s = seen["pos"] * here["length_m"] / roads.edges[here["edge"]]["length_m"]
    s -= 0.5 * row["length"]
    for _ in range(BODY_LANES):
        if s >= 0.0:
            break
        before = lane_before(roads, lane, row["link"])
        if before < 0:
            break
        lane = before
        s += roads.lanes[lane]["length_m"]
    row["lane"] = lane
    row["s"] = min(max(s, 0.0), roads.lanes[lane]["length_m"])
    row["d"] = seen["lat"]


@inlined_kernel
def _edge_to_be(roads: RoadArrays, lane: int) -> int:
    """Return the edge of a lane; inside a junction, the edge that the lane leads to."""
    if roads.lanes[lane]["internal"]:
        lane = roads.links[roads.lanes[lane]["link"]]["to_lane"]
    return int(roads.lanes[lane]["edge"])


@inlined_kernel
def _way_at(roads: RoadArrays, paths: Paths, path: int, at: int, lane: int) -> int:
    """Return VEHICLE["way"] of a vehicle whose front is on the `at`-th edge of its route."""
    edge = _edge_to_be(roads, lane)
    first = paths.first[path]
    num = paths.first[path + 1] - first
    for k in range(max(at - EDGES_BEHIND, 0), min(at + 2, num)):
        if paths.edges[first + k] == edge:
            return int(paths.ways[first + k])
    return paths.nowhere
