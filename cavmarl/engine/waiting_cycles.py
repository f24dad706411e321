"""Deadlocks: cycles of vehicles in which each one waits for the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import HOLD_SIGNAL, HOLD_YIELD
from cavmarl.roads.network import RoadNetwork

PATIENCE_S = 10.0  # a vehicle that has been stopped this long may be part of a deadlock
# largest bumper gap to the vehicle that it waits for, excluding the path over junctions
NEAR_M = 12.0
STANDING_MPS = 0.1


def find_deadlocks(
    network: RoadNetwork, steps: NDArray[np.void], rows: NDArray[np.void]
) -> tuple[tuple[int, ...], ...]:
    """Return the cycles of vehicles that wait for each other, each starting at its smallest id.

    A vehicle waits for the vehicle ahead of it on its route and, if it yields at a stop line, for
    the stopped vehicles to which it yields. A vehicle that is stopped at a red signal waits for no
    vehicle. A cycle is reported if all its vehicles have been stopped for `PATIENCE_S`.

    Args:
        network: the roads.
        steps: PLAN, the table of plans (`TripTables.steps`).
        rows: VEHICLE (n,) of one world.
    """
    stands = (np.abs(rows["speed"]) < STANDING_MPS) & (rows["wait_s"] >= PATIENCE_S)
    queues = _queues(network, rows)
    waits: dict[int, list[int]] = {}
    for i in np.flatnonzero(stands & (rows["lane"] >= 0)).tolist():
        blockers = _blockers(network, steps, rows, queues, i)
        waits[i] = [j for j in blockers if stands[j]]
    cycles = {_from_smallest(cycle, rows) for cycle in _cycles(waits)}
    return tuple(sorted(cycles))


def _queues(network: RoadNetwork, rows: NDArray[np.void]) -> dict[int, list[int]]:
    """Return the rows of the vehicles on each lane, from its start to its end."""
    order = np.lexsort((rows["id"], rows["s"], rows["lane"]))
    found: dict[int, list[int]] = {}
    for i in order.tolist():
        found.setdefault(int(rows["lane"][i]), []).append(i)
    return found


def _blockers(
    network: RoadNetwork,
    steps: NDArray[np.void],
    rows: NDArray[np.void],
    queues: Mapping[int, Sequence[int]],
    i: int,
) -> list[int]:
    """Return the rows for which row i waits."""
    row = rows[i]
    lane, way = int(row["lane"]), int(row["way"])
    queue = queues[lane]
    place = queue.index(i)
    if place + 1 < len(queue):
        ahead = rows[queue[place + 1]]
        gap_m = ahead["s"] - row["s"] - 0.5 * (ahead["length"] + row["length"])
        return [queue[place + 1]] if gap_m <= NEAR_M else []
    if row["hold"] == HOLD_SIGNAL:
        return []
    far_m = float(network.lanes["length_m"][lane] - row["s"] - 0.5 * row["length"])
    found: list[int] = []
    link = -1
    while far_m <= NEAR_M:
        lane, way, entered = _next(network, steps, lane, way)
        if lane < 0:
            break
        link = entered if entered >= 0 and link < 0 else link
        if queues.get(lane):
            last = queues[lane][0]
            if far_m + rows["s"][last] - 0.5 * rows["length"][last] <= NEAR_M:
                found.append(last)
            break
        if not network.lanes["internal"][lane]:
            far_m += float(network.lanes["length_m"][lane])
    if row["hold"] == HOLD_YIELD and link >= 0:
        found += _foes(network, steps, rows, queues, link)
    return found


def _foes(
    network: RoadNetwork,
    steps: NDArray[np.void],
    rows: NDArray[np.void],
    queues: Mapping[int, Sequence[int]],
    link: int,
) -> list[int]:
    """Return the vehicles on the links to which a link must yield.

    The result also has the next vehicle to enter each of these links.
    """
    first = int(network.links["first_conflict"][link])
    conflicts = network.conflicts[first : first + int(network.links["num_conflicts"][link])]
    found: list[int] = []
    for foe in conflicts["foe"][conflicts["must_yield"]].tolist():
        lane = int(network.links["next_lane"][foe])
        while network.lanes["internal"][lane]:
            found += queues.get(lane, ())
            lane = int(network.lanes["successor"][lane])
        before = queues.get(int(network.links["from_lane"][foe]), ())
        if before:
            front = rows[before[-1]]
            if steps["link"][int(front["way"]) + int(front["lane"])] == foe:
                found.append(before[-1])
    return found


def _next(
    network: RoadNetwork, steps: NDArray[np.void], lane: int, way: int
) -> tuple[int, int, int]:
    """Return the lane after the end of a lane, its plan, and the link that is entered."""
    if network.lanes["internal"][lane]:
        return int(network.lanes["successor"][lane]), way, -1
    step = steps[way + lane]
    return int(step["next"]), way + int(step["shift"]), int(step["link"])


def _cycles(waits: Mapping[int, Sequence[int]]) -> list[list[int]]:
    """Return cycles: one for each edge by which a depth-first search returns to its own path."""
    found: list[list[int]] = []
    done: set[int] = set()
    for start in sorted(waits):
        path: list[int] = []
        places: dict[int, int] = {}
        stack = [(start, iter(waits[start]))] if start not in done else []
        if stack:
            path.append(start)
            places[start] = 0
        while stack:
            at, rest = stack[-1]
            following = next(rest, None)
            if following is None:
                stack.pop()
                path.pop()
                del places[at]
                done.add(at)
            elif following in places:
                found.append(path[places[following] :])
            elif following in waits and following not in done:
                places[following] = len(path)
                path.append(following)
                stack.append((following, iter(waits[following])))
    return found


def _from_smallest(cycle: Sequence[int], rows: NDArray[np.void]) -> tuple[int, ...]:
    ids = rows["id"][np.array(cycle)].tolist()
    first = ids.index(min(ids))
    return (*ids[first:], *ids[:first])
