"""Admission of waiting departures: the departure queue assigns lanes, and shards find gaps.

In one tick at most one vehicle tries to enter each lane, in the order of the queue. Five kernels
run in this order: `rank_lanes` (in each shard: how crowded lanes are), `assign_lanes` (in the
queue), `propose` (in each shard: departures with a safe gap in its zone), `accept` (in the queue,
in its order, while the world has room) and `admit` (in each shard: add the vehicles to its rows or
ghosts).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.geometry import boxes_overlap, lane_pose
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M
from cavmarl.core.records.arrays import (
    Demand,
    DepartureQueue,
    RoadArrays,
    Scratch,
    TripTables,
    Worlds,
)
from cavmarl.core.records.codes import COUNT_DEPARTED, LANE_FIRST, LANE_GIVEN, LANE_RANDOM, POS_LAST
from cavmarl.core.records.rows import SWEPT_BEYOND_M
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.junctions.swept_areas import foe_would_sweep_over
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.lanes.route_following import fed_lane, next_step
from cavmarl.roads.kernels.lanes_now import roads_in, shares_lanes
from cavmarl.traffic.kernels.demand_generator import enter
from cavmarl.traffic.kernels.entering import (
    crowd,
    entry_lane,
    entry_place,
    entry_speed,
    follower_brakes,
)
from cavmarl.zones.kernels.zone_lookup import Halo, ZoneArrays, is_seen, squared_distance, zone_of

ENTER_ROOM_M = 0.3  # m; free space on all sides of an entering vehicle


@kernel
def _zone_on(roads: RoadArrays, zones: ZoneArrays, lane: int, s: float) -> int:
    row = roads.lanes[lane]
    x, y, _, _, _, _ = lane_pose(roads.points, row["first_point"], row["num_points"], s)
    return zone_of(zones, x, y)


@kernel
def rank_lanes(
    roads: RoadArrays,
    travel: TripTables,
    zones: ZoneArrays,
    zone: int,
    departures: DepartureQueue,
    worlds: Worlds,
    scratch: Scratch,
) -> None:
    """Count vehicles around entry places in this zone, for departures that choose their lane.

    For a departure that enters behind the last vehicle of a lane, the zone where the lane ends
    determines the place: only this zone sees all vehicles in view of the end.

    `zone`: zone of this shard. `departures`: `ranks` is written for places in this zone, `last_s`
    for lanes that end in this zone. `worlds`: `next_rows` is read.
    """
    for w in range(worlds.ticks.shape[0]):
        indexed = False
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        for q in range(departures.num_queue[w]):
            departure = departures.queue[w, q]
            code = departure["lane_code"]
            chooses = not (code == LANE_GIVEN or code == LANE_FIRST or code == LANE_RANDOM)
            last = departure["pos_code"] == POS_LAST
            if not (chooses or last):
                continue
            edge = here.edges[here.lanes[departure["lane"]]["edge"]]
            first = edge["first_lane"]
            s = max(departure["pos"], 0.0)
            for lane in range(first, first + edge["num_lanes"]):
                length = here.lanes[lane]["length_m"]
                on_lane = length if last else min(s, length)
                ranked = chooses and _zone_on(here, zones, lane, on_lane) == zone
                placed = last and _zone_on(here, zones, lane, length) == zone
                if (ranked or placed) and not indexed:
                    rows = worlds.next_rows[w]
                    index_lanes(here, travel, rows, worlds.num_rows[w], scratch)
                    indexed = True
                if ranked:
                    departures.ranks[w, q, lane - first] = crowd(
                        scratch, lane, on_lane, travel.view_m
                    )
                if placed:
                    kind = travel.types[departure["vtype"]]
                    departures.last_s[w, q, lane - first] = entry_place(
                        here,
                        travel,
                        worlds.keys[w],
                        departure,
                        kind,
                        lane,
                        worlds.ticks[w],
                        scratch,
                    )


@kernel
def assign_lanes(
    roads: RoadArrays,
    travel: TripTables,
    departures: DepartureQueue,
    keys: NDArray[np.uint64],
    lanes: NDArray[np.void],
) -> None:
    """Assign each queued departure the lane on which it tries to enter, or -1.

    A lane is assigned to the departure that has waited longest, even if there is no gap for it.

    `departures`: `tries` and `lane_taken` are written. `lanes`: LANE (V, L), see `Worlds`.
    """
    for w in range(keys.size):
        if departures.num_queue[w] == 0:
            continue
        departures.lane_taken[:] = False
        here = roads if shares_lanes(lanes) else roads_in(roads, lanes, w)
        for q in range(departures.num_queue[w]):
            departure = departures.queue[w, q]
            lane = entry_lane(
                here, travel, keys[w], departure, departures.ranks[w, q], departures.lane_taken
            )
            departures.tries[w, q] = lane
            if lane >= 0:
                departures.lane_taken[lane] = True


@kernel
def _touches(own: np.void, other: np.void) -> bool:
    """Return whether an entering vehicle, enlarged by a margin, would touch another vehicle."""
    half_length = 0.5 * own["length"] + ENTER_ROOM_M
    half_width = 0.5 * own["width"] + ENTER_ROOM_M
    dx = other["x"] - own["x"]
    dy = other["y"] - own["y"]
    reach = half_length + half_width + 0.5 * (other["length"] + other["width"])
    if dx * dx + dy * dy > reach * reach or abs(other["z"] - own["z"]) > LEVEL_HEIGHT_M:
        return False
    return boxes_overlap(
        own["x"],
        own["y"],
        cosine(own["heading"]),
        sine(own["heading"]),
        half_length,
        half_width,
        other["x"],
        other["y"],
        cosine(other["heading"]),
        sine(other["heading"]),
        0.5 * other["length"],
        0.5 * other["width"],
    )


@kernel
def _touches_any(rows: NDArray[np.void], num: int, own: np.void) -> bool:
    for j in range(num):
        if _touches(own, rows[j]):
            return True
    return False


@kernel
def _link_ahead(roads: RoadArrays, travel: TripTables, row: np.void) -> int:
    """Return the link that an entrant takes from its lane, or the lane's first link; -1: none."""
    _, _, link = next_step(roads, travel, row["lane"], row["way"])
    here = roads.lanes[row["lane"]]
    return here["first_link"] if link < 0 and here["num_links"] > 0 else link


@inlined_kernel
def _num_behind(roads: RoadArrays, row: np.void) -> int:
    """Count the lanes that lead to `fed_lane` of an entrant's lane; 0 far from the lane's start."""
    far = row["s"] - 0.5 * row["length"] > SWEPT_BEYOND_M
    return 0 if far else int(roads.lanes[fed_lane(roads, row["lane"])]["num_into"])


@inlined_kernel
def _link_behind(roads: RoadArrays, row: np.void, n: int) -> int:
    """Return the link that contains the n-th lane counted by `_num_behind`, or -1."""
    here = roads.lanes[fed_lane(roads, row["lane"])]
    before = roads.lanes[roads.into[here["first_into"] + n]]
    return int(before["link"]) if before["internal"] else -1


@kernel
def may_entry_be_swept(
    roads: RoadArrays, travel: TripTables, row: np.void, scratch: Scratch
) -> bool:
    """Return whether an entrant would be near swept areas ahead, or occupied swept areas behind."""
    to_line = roads.lanes[row["lane"]]["length_m"] - row["s"]
    ahead = _link_ahead(roads, travel, row) if to_line <= travel.see_m else -1
    if ahead >= 0 and roads.links[ahead]["num_sweeps"] > 0:
        return True
    for n in range(_num_behind(roads, row)):
        link = _link_behind(roads, row, n)
        if link < 0:
            continue
        first = roads.links[link]["first_sweep"]
        for k in range(first, first + roads.links[link]["num_sweeps"]):
            foe = roads.links[roads.sweeps[k]["foe"]]
            inside = foe["next_lane"]
            while roads.lanes[inside]["internal"]:
                if scratch.lane_start[inside] < scratch.lane_end[inside]:
                    return True
                inside = roads.lanes[inside]["successor"]
            last = scratch.lane_end[foe["from_lane"]] - 1
            if last >= scratch.lane_start[foe["from_lane"]]:
                to_end = roads.lanes[foe["from_lane"]]["length_m"] - scratch.entries[last]["s"]
                if to_end < scratch.entries[last]["half"]:
                    return True
    return False


@kernel
def is_entry_swept(roads: RoadArrays, travel: TripTables, row: np.void, scratch: Scratch) -> bool:
    """Return whether a vehicle would enter an area swept by a vehicle ahead or behind."""
    here = roads.lanes[row["lane"]]
    half = 0.5 * row["length"]
    to_line = here["length_m"] - row["s"]
    ahead = _link_ahead(roads, travel, row) if to_line <= travel.see_m else -1
    if ahead >= 0 and foe_would_sweep_over(roads, row, ahead, half - to_line, scratch):
        return True
    for n in range(_num_behind(roads, row)):
        link = _link_behind(roads, row, n)
        if link >= 0:
            place = roads.links[link]["length_m"] + row["s"] + half
            if foe_would_sweep_over(roads, row, link, place, scratch):
                return True
    return False


@kernel
def propose(
    demand: Demand,
    roads: RoadArrays,
    travel: TripTables,
    zones: ZoneArrays,
    zone: int,
    departures: DepartureQueue,
    worlds: Worlds,
    scratch: Scratch,
) -> None:
    """Write the departures with a safe gap in this zone to `departures.passing`.

    `demand`: the generator's tables. `zone`: zone of this shard. `departures`: `passing` and
    `places` are written. `worlds`: `next_rows` is read.
    """
    for w in range(worlds.ticks.shape[0]):
        if departures.num_queue[w] == 0:
            continue
        rows = worlds.next_rows[w]
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        num = worlds.num_rows[w]
        key = worlds.keys[w]
        indexed = announced = False
        for q in range(departures.num_queue[w]):
            lane = departures.tries[w, q]
            if lane < 0:
                continue
            departure = departures.queue[w, q]
            kind = travel.types[departure["vtype"]]
            if departure["pos_code"] == POS_LAST:
                edge = here.edges[here.lanes[lane]["edge"]]
                s = departures.last_s[w, q, lane - edge["first_lane"]]
            else:
                s = entry_place(here, travel, key, departure, kind, lane, worlds.ticks[w], scratch)
            if _zone_on(here, zones, lane, s) != zone:
                continue
            if not indexed:
                index_lanes(here, travel, rows, num, scratch)
                indexed = True
            speed = entry_speed(here, travel, rows, key, departure, kind, lane, s, scratch)
            if speed < 0.0:
                continue
            if follower_brakes(here, travel, rows, departure, kind, lane, s, speed, scratch):
                continue
            n = departures.num_passing[w]
            row = departures.passing[w, n]
            departures.passing[w, n] = demand.blank[0]
            enter(here, travel, worlds, w, departure, lane, s, speed, row)
            if _touches_any(rows, num, row):
                continue
            if may_entry_be_swept(here, travel, row, scratch):
                if not announced:
                    step, step_at = worlds.step[w], worlds.step_at[w]
                    register_links(here, travel, rows, num, step, step_at, scratch)
                    announced = True
                if is_entry_swept(here, travel, row, scratch):
                    continue
            departures.places[w, n] = q
            departures.num_passing[w] = n + 1


@kernel
def accept(departures: DepartureQueue, running: NDArray[np.int64], capacity: int) -> None:
    """Accept proposals in the order of the queue; a vehicle that would touch another one waits.

    `departures`: the accepted proposals remain in `passing`; queue and counts are written.
    `running`: (W,) vehicles of each world in all zones. `capacity`: maximum number of vehicles per
    world.
    """
    for w in range(running.size):
        proposed = departures.num_passing[w]
        taken = 0
        for n in range(proposed):
            found = n
            for m in range(n + 1, proposed):
                if departures.places[w, m] < departures.places[w, found]:
                    found = m
            q = departures.places[w, found]
            departures.spare[0] = departures.passing[w, found]
            departures.places[w, found] = departures.places[w, n]
            departures.passing[w, found] = departures.passing[w, n]
            row = departures.spare[0]
            if running[w] + taken == capacity or _touches_any(departures.passing[w], taken, row):
                continue
            departures.passing[w, taken] = row
            departures.places[w, taken] = q
            taken += 1
        departures.num_passing[w] = taken
        departures.counts[w, COUNT_DEPARTED] += taken
        _take_from_queue(departures, w, taken)


@kernel
def _take_from_queue(departures: DepartureQueue, w: int, taken: int) -> None:
    """Remove the accepted departures, given by ascending places, from the queue."""
    if taken == 0:
        return
    kept = departures.places[w, 0]
    n = 0
    for q in range(kept, departures.num_queue[w]):
        if n < taken and departures.places[w, n] == q:
            n += 1
            continue
        departures.queue[w, kept] = departures.queue[w, q]
        kept += 1
    departures.num_queue[w] = kept


@kernel
def admit(
    zones: ZoneArrays, halo: Halo, zone: int, departures: DepartureQueue, worlds: Worlds
) -> None:
    """Write accepted departures to `next_rows`: owned rows in their zone, ghosts near the zone.

    `halo`: region that this zone sees. `zone`: zone of this shard. `departures`: `passing` is read.
    `worlds`: `next_rows` and the numbers of rows are written.
    """
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.next_rows[w]
        for n in range(departures.num_passing[w]):
            row = departures.passing[w, n]
            num = worlds.num_rows[w]
            if zone_of(zones, row["x"], row["y"]) == zone:
                owned = worlds.num_owned[w]
                rows[num] = rows[owned]  # move the first ghost to the end
                rows[owned] = row
                rows[owned]["owner"] = zone
                worlds.num_owned[w] = owned + 1
            elif is_seen(halo, zone, row, squared_distance(zones.rects, zone, row["x"], row["y"])):
                rows[num] = row
            else:
                continue
            worlds.num_rows[w] = num + 1
