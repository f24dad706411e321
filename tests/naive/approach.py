"""Find the vehicles on links and on the way to them, one vehicle at a time."""

from __future__ import annotations

import numpy as np

from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_SIGNAL
from cavmarl.driving.kernels.lanes.lane_index import beside_s
from cavmarl.roads.network import RoadNetwork

Entry = tuple[
    int, int, float
]  # (link, vehicle id, distance in m from the centre of the vehicle to the stop line)


def link_into(roads: RoadNetwork, row: np.void) -> int:
    """Return the link into the lane of a vehicle, or else into an adjacent lane, or -1."""
    if row["link"] >= 0 and roads.links[row["link"]]["to_lane"] == row["lane"]:
        return int(row["link"])
    own = roads.lanes[row["lane"]]
    sides = [roads.lanes[side] for side in (own["left"], own["right"]) if side >= 0]
    own = next((lane for lane in (own, *sides) if lane["num_into"]), own)
    into = roads.into[own["first_into"] :][: own["num_into"]]
    return (
        int(roads.lanes[into[0]]["link"]) if into.size and roads.lanes[into[0]]["internal"] else -1
    )


def announcements(roads: RoadNetwork, travel: TripTables, row: np.void) -> list[Entry]:
    """Return the links at which a vehicle registers."""
    lane, way, name = int(row["lane"]), int(row["way"]), int(row["id"])
    here = roads.lanes[lane]
    found: list[Entry] = []
    if here["internal"]:
        driven = max(float(here["link_offset_m"] + row["s"]), 1e-9)
        found.append((int(here["link"]), name, -driven))
    elif (came_by := link_into(roads, row)) >= 0:
        link = roads.links[came_by]
        rear = float(link["length_m"] + row["s"] - 0.5 * row["length"])
        if rear < max(link["length_m"], link["fork_m"], link["swept_m"]):
            found.append((came_by, name, -float(link["length_m"] + row["s"])))
    beside = roads.lanes[row["side_lane"]]
    if row["side_lane"] >= 0 and not here["internal"] and beside["num_links"]:
        at = beside_s(roads.arrays, lane, int(row["side_lane"]), float(row["s"]))
        if (rest := float(beside["length_m"]) - at) < 15.0:
            found.append((int(beside["first_link"]), name, max(rest, 0.0)))
    sight = min(30.0 + 8.0 * float(row["speed"]), 150.0)
    to_end = float(here["length_m"] - row["s"])
    inside = bool(here["internal"])
    idle = row["hold"] in (HOLD_SIGNAL, HOLD_EXIT_BLOCKED)
    idle |= row["hold"] == HOLD_NONE and row["wait_s"] > 3.0
    ahead: list[tuple[int, float]] = []
    while len(ahead) < 2:
        # Vehicles that merge into the lane of this vehicle see it from farther away, unless this
        # vehicle stands or may have to stop before the merge.
        may_stop = any(inside or roads.links[link]["state"] != ord("M") for link, _ in ahead)
        stands = idle and row["speed"] <= 0.5
        far = max(sight, 300.0) if here["merges"] else sight
        if to_end >= (sight if may_stop or stands else far):
            break
        if here["internal"]:
            lane = int(here["successor"])
        else:
            step = travel.steps[way + lane]
            if step["next"] < 0:
                is_minded = (
                    to_end < 15.0 or step["change"] == 0
                )  # at the line, or where the trip ends
                if not ahead and is_minded and here["num_links"]:
                    found.append((int(here["first_link"]), name, max(to_end, 0.0)))
                break
            ahead.append((int(step["link"]), to_end))
            lane, way = int(step["next"]), way + int(step["shift"])
        here = roads.lanes[lane]
        to_end += float(here["length_m"])
    for link, distance in ahead:
        if roads.links[link]["num_conflicts"] or roads.links[link]["num_sweeps"]:
            found.append((link, name, max(distance, 0.0)))
    return found
