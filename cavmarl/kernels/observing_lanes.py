"""What the `lanes` sensor writes: who drives ahead and behind on the lanes around, and who crosses.

The nearest vehicles in the plane (`neighbors`) leave it to the policy to find out which of them are
in its way; here places are told along lanes, as car-following models take them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays, Sensors
from cavmarl.kernels.codes import SIGNAL_RED, SIGNAL_RED_YELLOW
from cavmarl.kernels.junctions import link_signal
from cavmarl.kernels.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.kernels.scalars import clamp

__all__ = ["GAPS", "LANES_FEATURES", "observe_lanes"]

GAPS = 5  # own lane ahead; left ahead, behind; right ahead, behind
CROSSING = 2 * GAPS  # where the features of the crossing vehicle begin
LANES_FEATURES = CROSSING + 4
SPEED_SCALE = 40.0  # m/s
LANES_AHEAD = 8  # that a way is followed over, at most
HALF_M = 10.0
SLOWEST_MPS = 1.0  # that a vehicle is taken to cross with


@kernel
def _way_between(
    roads: RoadArrays,
    plans: NDArray[np.void],
    goal: int,
    lane: int,
    s: float,
    target: int,
    target_s: float,
    range_m: float,
) -> float:
    """Way in m along the plan from `s` of `lane` to `target_s` of lane `target`; inf: not on it."""
    way = -s
    for _ in range(LANES_AHEAD):
        if lane == target:
            return way + target_s
        way += roads.lanes[lane]["length_m"]
        lane = plans[goal, lane]["next"]
        if lane < 0 or way > range_m:
            return math.inf
    return math.inf


@kernel
def _closeness(way: float) -> float:
    """1 where two touch, 0.5 at `HALF_M`, 0 far away: metres count where they are few."""
    return HALF_M / (HALF_M + max(way, 0.0))


@kernel
def _note_gap(out: NDArray[np.float32], slot: int, gap: float, speed: float) -> None:
    """Keep the nearest vehicle of a slot."""
    closeness = _closeness(gap)
    if closeness > out[2 * slot]:
        out[2 * slot] = closeness
        out[2 * slot + 1] = clamp(speed / SPEED_SCALE, -1.0, 1.0)


@kernel
def _observe_gaps(
    roads: RoadArrays,
    plans: NDArray[np.void],
    row: np.void,
    other: np.void,
    lane: int,
    slot: int,
    range_m: float,
    out: NDArray[np.float32],
) -> None:
    """Note `other` in `slot`, if it is ahead on the way from `lane`, or behind in `slot` + 1."""
    s = row["s"] * roads.lanes[lane]["length_m"] / roads.lanes[row["lane"]]["length_m"]
    half = 0.5 * (row["length"] + other["length"])
    faster = other["speed"] - row["speed"]
    ahead = math.inf
    for k in range(2):
        on = other["lane"] if k == 0 else other["side_lane"]
        if on >= 0:
            way = _way_between(
                roads, plans, row["goal"], lane, s, on, other["s"], range_m + half
            )
            ahead = min(ahead, way)
    if ahead >= 0.0 and ahead < range_m + half:
        _note_gap(out, slot, ahead - half, faster)
        return
    if slot == 0:
        return
    behind = _way_between(
        roads, plans, other["goal"], other["lane"], other["s"], lane, s, range_m + half
    )
    if behind >= 0.0 and behind < range_m + half:
        _note_gap(out, slot + 1, behind - half, faster)


@kernel
def _next_link(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, range_m: float
) -> tuple[int, float]:
    """The link that a vehicle is on or comes to next, -1: none, and the way to its stop line."""
    lane = row["lane"]
    here = roads.lanes[lane]
    if here["internal"]:
        return here["link"], -(here["link_offset_m"] + row["s"])
    distance = -row["s"]
    for _ in range(LANES_AHEAD):
        distance += roads.lanes[lane]["length_m"]
        step = plans[row["goal"], lane]
        if step["next"] < 0 or distance > range_m:
            break
        if step["link"] >= 0:
            return step["link"], distance
        lane = step["next"]
    return -1, 0.0


@kernel
def _observe_crossing(
    roads: RoadArrays,
    plans: NDArray[np.void],
    row: np.void,
    other: np.void,
    link: int,
    distance: float,
    phase: NDArray[np.int32],
    range_m: float,
    soonest: float,
    out: NDArray[np.float32],
) -> float:
    """Note `other` if it reaches a place that `link` shares sooner than all before, `soonest` s."""
    foe_link, foe_distance = _next_link(roads, plans, other, range_m)
    if foe_link < 0:
        return soonest
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        if conflict["foe"] != foe_link:
            continue
        if foe_distance > 0.0:
            signal = link_signal(roads, foe_link, phase)
            if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW or not conflict["must_yield"]:
                continue
        half = 0.5 * other["length"]
        if foe_distance + conflict["foe_leave_m"] + half < 0.0:
            continue
        own = distance + conflict["enter_m"] - 0.5 * row["length"]
        if distance + conflict["leave_m"] + 0.5 * row["length"] < 0.0:
            continue
        way = foe_distance + conflict["foe_enter_m"] - half
        time = way / max(other["speed"], SLOWEST_MPS)
        if time < soonest:
            soonest = time
            out[CROSSING] = 1.0
            out[CROSSING + 1] = _closeness(own)
            out[CROSSING + 2] = _closeness(way)
            out[CROSSING + 3] = clamp(other["speed"] / SPEED_SCALE, -1.0, 1.0)
    return soonest


@kernel
def observe_lanes(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    phase: NDArray[np.int32],
    sensors: Sensors,
    observation: NDArray[np.float32],
) -> None:
    """Gaps and relative speeds on the lanes around, and who comes first where ways cross.

    Args:
        roads: the road arrays.
        plans: PLAN (G, L).
        rows: VEHICLE (C,).
        i: row of the agent's vehicle.
        grid: filled from these rows.
        phase: (num_signals,) PHASE rows that are on.
        sensors: where to write.
        observation: (D,) `LANES_FEATURES` numbers are written.
    """
    range_m = sensors.lanes_range_m
    if range_m == 0.0:
        return
    out = observation[sensors.lanes_at : sensors.lanes_at + LANES_FEATURES]
    row = rows[i]
    here = roads.lanes[row["lane"]]
    link, distance = _next_link(roads, plans, row, range_m)
    soonest = math.inf
    first_column, last_column = cell_columns(grid, row["x"], range_m)
    first_row, last_row = cell_rows(grid, row["y"], range_m)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            if body["row"] == i or abs(body["z"] - row["z"]) > LEVEL_HEIGHT_M:
                continue
            other = rows[body["row"]]
            _observe_gaps(roads, plans, row, other, row["lane"], 0, range_m, out)
            if here["left"] >= 0:
                _observe_gaps(roads, plans, row, other, here["left"], 1, range_m, out)
            if here["right"] >= 0:
                _observe_gaps(roads, plans, row, other, here["right"], 3, range_m, out)
            if link >= 0:
                soonest = _observe_crossing(
                    roads, plans, row, other, link, distance, phase, range_m, soonest, out
                )
