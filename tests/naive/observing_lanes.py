"""Compute the `lanes` sensor by sorting all vehicles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

HALF_M, LANES_AHEAD, SLOWEST_MPS = 10.0, 8, 1.0


def way_ahead(
    plans: NDArray[np.void], goal: int, lane: int, roads: RoadNetwork
) -> dict[int, float]:
    """Return the lanes of the path from the start of `lane`, and the distance to each start."""
    found: dict[int, float] = {}
    way = 0.0
    while lane >= 0 and len(found) < LANES_AHEAD and lane not in found:
        found[lane] = way
        way += roads.lanes[lane]["length_m"]
        lane = int(plans[goal, lane]["next"])
    return found


def next_link(
    plans: NDArray[np.void], vehicle: np.void, roads: RoadNetwork, range_m: float
) -> tuple[int, float] | None:
    """Return the link that a vehicle is on or reaches next, and the distance to its stop line."""
    here = roads.lanes[vehicle["lane"]]
    if here["internal"]:
        return int(here["link"]), -float(here["link_offset_m"] + vehicle["s"])
    for lane, start in way_ahead(plans, vehicle["goal"], vehicle["lane"], roads).items():
        distance = start + roads.lanes[lane]["length_m"] - vehicle["s"]
        if distance > range_m or plans[vehicle["goal"], lane]["next"] < 0:
            return None
        if plans[vehicle["goal"], lane]["link"] >= 0:
            return int(plans[vehicle["goal"], lane]["link"]), float(distance)
    return None


def lanes(
    roads: RoadNetwork,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    held: set[int],
    range_m: float,
) -> list[float]:
    """Return the features of the sensor; `held` are the links with a red signal."""
    ego = rows[i]
    near = [
        other
        for k, other in enumerate(rows)
        if k != i
        and math.hypot(other["x"] - ego["x"], other["y"] - ego["y"]) <= range_m
        and abs(other["z"] - ego["z"]) <= 4.0
    ]
    here = roads.lanes[ego["lane"]]
    numbers = slots(roads, plans, ego, near, ego["lane"], range_m)[:2]
    for side in (here["left"], here["right"]):
        numbers += slots(roads, plans, ego, near, side, range_m) if side >= 0 else [0.0] * 4
    return numbers + crossing(roads, plans, ego, near, held, range_m)


def slots(
    roads: RoadNetwork,
    plans: NDArray[np.void],
    ego: np.void,
    near: list[np.void],
    lane: int,
    range_m: float,
) -> list[float]:
    """Return closeness and relative speed of the vehicles ahead and behind on a lane."""
    s = ego["s"] * roads.lanes[lane]["length_m"] / roads.lanes[ego["lane"]]["length_m"]
    mine = way_ahead(plans, ego["goal"], lane, roads)
    ahead, behind = [], []
    for other in near:
        half = 0.5 * (ego["length"] + other["length"])
        gaps = [
            mine[on] + other["s"] - s - half
            for on in (other["lane"], other["side_lane"])
            if on in mine and mine[on] + other["s"] - s >= 0.0
        ]
        if gaps and min(gaps) < range_m:
            ahead.append((min(gaps), other["speed"] - ego["speed"]))
            continue
        theirs = way_ahead(plans, other["goal"], other["lane"], roads)
        if lane in theirs:
            gap = theirs[lane] + s - other["s"] - half
            if gap > -half and gap < range_m:
                behind.append((gap, other["speed"] - ego["speed"]))
    numbers = []
    for found in (ahead, behind):
        best = min(((-closeness(gap), speed) for gap, speed in found), default=(0.0, 0.0))
        numbers += [-best[0], scaled(best[1])]
    return numbers


def crossing(
    roads: RoadNetwork,
    plans: NDArray[np.void],
    ego: np.void,
    near: list[np.void],
    held: set[int],
    range_m: float,
) -> list[float]:
    """Return the features of the first vehicle that reaches a conflict area with the next link."""
    own = next_link(plans, ego, roads, range_m)
    found = []
    for other in near:
        foe = next_link(plans, other, roads, range_m)
        if own is None or foe is None:
            continue
        link = roads.links[own[0]]
        first = link["first_conflict"]
        for conflict in roads.conflicts[first : first + link["num_conflicts"]]:
            goes_first = conflict["must_yield"] and foe[0] not in held
            foe_left = foe[1] + conflict["foe_leave_m"] + 0.5 * other["length"]
            left = own[1] + conflict["leave_m"] + 0.5 * ego["length"]
            if conflict["foe"] != foe[0] or (foe[1] > 0.0 and not goes_first):
                continue
            if foe_left < 0.0 or left < 0.0:
                continue
            way = foe[1] + conflict["foe_enter_m"] - 0.5 * other["length"]
            mine = own[1] + conflict["enter_m"] - 0.5 * ego["length"]
            time = way / max(other["speed"], SLOWEST_MPS)
            found.append((time, closeness(mine), closeness(way), scaled(other["speed"])))
    if not found:
        return [0.0] * 4
    return [1.0, *min(found)[1:]]


def closeness(way: float) -> float:
    """Return a closeness: 1 at contact, 0.5 at a distance of `HALF_M`."""
    return float(np.float32(HALF_M / (HALF_M + max(way, 0.0))))


def scaled(speed: float) -> float:
    """Return a speed in units of 40 m/s."""
    return float(np.float32(min(max(speed / 40.0, -1.0), 1.0)))
