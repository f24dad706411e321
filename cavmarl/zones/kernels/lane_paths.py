"""Shortest paths along the lanes of a map, forwards or backwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.zones.kernels.visibility_scratch import VisibilityScratch


@inlined_kernel
def _num_next(roads: RoadArrays, lane: int, forwards: bool) -> int:
    """Return the number of lanes that follow a lane (forwards) or precede it (backwards)."""
    row = roads.lanes[lane]
    if not forwards:
        return int(row["num_into"])
    return 1 if row["internal"] else int(row["num_links"])


@inlined_kernel
def _next(roads: RoadArrays, lane: int, forwards: bool, k: int) -> int:
    """Return the k-th of the lanes that `_num_next` counts."""
    row = roads.lanes[lane]
    if not forwards:
        return int(roads.into[row["first_into"] + k])
    if row["internal"]:
        return int(row["successor"])
    return int(roads.links[row["first_link"] + k]["next_lane"])


@kernel
def begin_paths(
    roads: RoadArrays, lane: int, forwards: bool, way: float, ways: NDArray[np.float64]
) -> None:
    """Begin paths on a lane, `way` m before its end (forwards) or after its start."""
    for k in range(_num_next(roads, lane, forwards)):
        other = _next(roads, lane, forwards, k)
        ways[other] = min(ways[other], way)


@kernel
def extend_paths(
    roads: RoadArrays,
    # whether paths lead in the direction of driving, to the starts of lanes; if not, they lead
    # backwards to the ends of lanes
    forwards: bool,
    limit_m: float,  # limit of the length of a path
    # (L,) m, updated; finite where paths begin, inf elsewhere; values above the limit are kept
    ways: NDArray[np.float64],
    scratch: VisibilityScratch,  # only `waits` and `following` are used
) -> None:
    """Extend the shortest paths along roads to all lanes within a limit; write their lengths."""
    head = -1
    tail = -1
    for lane in range(ways.size):
        if ways[lane] > limit_m:
            continue
        scratch.waits[lane] = True
        if head < 0:
            head = lane
        else:
            scratch.following[tail] = lane
        tail = lane
    while head >= 0:
        lane = head
        head = scratch.following[lane] if lane != tail else -1
        scratch.waits[lane] = False
        way = ways[lane] + roads.lanes[lane]["length_m"]
        if way > limit_m:
            continue
        for k in range(_num_next(roads, lane, forwards)):
            other = _next(roads, lane, forwards, k)
            if way >= ways[other]:
                continue
            ways[other] = way
            if scratch.waits[other]:
                continue
            scratch.waits[other] = True
            if head < 0:
                head = other
            else:
                scratch.following[tail] = other
            tail = other
