"""Kernels for places of agents and post-encroachment times after each step.

A conflict area is the stretch that the paths of two movements over a junction share (a CONFLICT
row). Post-encroachment time is the time from the moment at which the first vehicle's rear leaves
the area to the moment at which the second vehicle's front enters it from the other path (Allen,
Shin and Cooper 1978).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays

MIN_SPEED_MPS = 1.0  # a slower vehicle counts as this fast when entry and exit are extrapolated


@kernel
def locate_agents(
    rows: NDArray[np.void], num_rows: NDArray[np.int64], out: NDArray[np.float64]
) -> None:
    """Write the places of the agents' vehicles.

    Args:
        rows: VEHICLE (W, C).
        num_rows: (W,) live rows of each world.
        out: (W, A, 2) x and y in m; values of absent agents stay unchanged.
    """
    for w in range(rows.shape[0]):
        for i in range(num_rows[w]):
            row = rows[w, i]
            if row["agent"] >= 0:
                out[w, row["agent"], 0] = row["x"]
                out[w, row["agent"], 1] = row["y"]


@kernel
def _place_on_link(roads: RoadArrays, row: np.void) -> tuple[int, float]:
    """Return a vehicle's current or last link, and its centre's distance from the stop line.

    It is (-1, 0) before the stop line, and once the vehicle is one length past the junction.
    """
    lane = roads.lanes[row["lane"]]
    if lane["internal"]:
        return lane["link"], lane["link_offset_m"] + row["s"]
    link = row["link"]
    if link >= 0 and roads.links[link]["to_lane"] == row["lane"] and row["s"] < row["length"]:
        return link, roads.links[link]["length_m"] + row["s"]
    return -1, 0.0


@kernel
def _stay(conflict: np.void, row: np.void, centre_m: float, dt: float) -> tuple[float, float]:
    """Return for how many s a vehicle has covered an area, and for how many it still will.

    If it does not cover the area now, the result is (-1, -1).

    The vehicle is assumed to keep its present speed. Times are limited to the step, because other
    steps cover the rest. The first time is not limited in the step in which the centre passes the
    stop line: in earlier steps, the front may have entered the area without being recorded.
    """
    half = 0.5 * row["length"]
    ahead = centre_m + half - conflict["enter_m"]
    behind = conflict["leave_m"] - (centre_m - half)
    if not (ahead > 0.0 and behind > 0.0):
        return -1.0, -1.0
    speed = max(row["speed"], MIN_SPEED_MPS)
    since = ahead / speed
    if centre_m > speed * dt:
        since = min(since, dt)
    return since, min(behind / speed, dt)


@kernel
def watch_encroachments(
    roads: RoadArrays,
    mirror: NDArray[np.int32],
    rows: NDArray[np.void],
    num_rows: NDArray[np.int64],
    chosen: NDArray[np.bool_],
    agent_ids: NDArray[np.int64],
    now_s: float,
    dt: float,
    seen_s: NDArray[np.float64],
    seen_id: NDArray[np.int64],
    seen_agent: NDArray[np.int32],
    least_s: NDArray[np.float64],
) -> None:
    """Update the least post-encroachment times of agents after one step.

    All vehicles first mark the areas that they cover. Then each vehicle reads the marks of the
    other paths, so the order of rows does not matter. Vehicles in an area at the same time have a
    time of 0.

    Args:
        roads: the road arrays.
        mirror: (num_conflicts,) row of the same area on the other path, -1: not watched.
        rows: VEHICLE (W, C).
        num_rows: (W,) live rows.
        chosen: (W,) worlds to watch.
        agent_ids: (W, A) id of each agent's vehicle, -1: none.
        now_s: time of this step, increasing from call to call.
        dt: time between calls in s.
        seen_s: (W, num_conflicts) time at which an area was last covered from this path; -inf:
            never.
        seen_id: (W, num_conflicts) vehicle that covered it.
        seen_agent: (W, num_conflicts) agent that drove this vehicle, -1: none.
        least_s: (W, A) updated: least time of each agent.
    """
    for w in range(rows.shape[0]):
        if not chosen[w]:
            continue
        for i in range(num_rows[w]):
            row = rows[w, i]
            link, centre_m = _place_on_link(roads, row)
            if link < 0:
                continue
            first = roads.links[link]["first_conflict"]
            for c in range(first, first + roads.links[link]["num_conflicts"]):
                _, rest_s = _stay(roads.conflicts[c], row, centre_m, dt)
                until = now_s + rest_s
                if rest_s < 0.0 or until < seen_s[w, c]:
                    continue
                if until > seen_s[w, c] or row["id"] < seen_id[w, c]:
                    seen_s[w, c] = until
                    seen_id[w, c] = row["id"]
                    seen_agent[w, c] = row["agent"]
        for i in range(num_rows[w]):
            row = rows[w, i]
            link, centre_m = _place_on_link(roads, row)
            if link < 0:
                continue
            first = roads.links[link]["first_conflict"]
            for c in range(first, first + roads.links[link]["num_conflicts"]):
                other = mirror[c]
                since_s, _ = _stay(roads.conflicts[c], row, centre_m, dt)
                if other < 0 or since_s < 0.0 or seen_s[w, other] == -math.inf:
                    continue
                passed = max(now_s - since_s - seen_s[w, other], 0.0)
                if row["agent"] >= 0:
                    least_s[w, row["agent"]] = min(least_s[w, row["agent"]], passed)
                agent = seen_agent[w, other]
                if agent >= 0 and agent_ids[w, agent] == seen_id[w, other]:
                    least_s[w, agent] = min(least_s[w, agent], passed)
