"""Shortest ways along the lanes of a map, ahead or back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.zones.kernels.visibility_scratch import VisibilityScratch


@inlined_kernel
def _num_next(roads: RoadArrays, lane: int, forwards: bool) -> int:
    """How many lanes follow a lane, or lead to it."""
    row = roads.lanes[lane]
    if not forwards:
        return int(row["num_into"])
    return 1 if row["internal"] else int(row["num_links"])


@inlined_kernel
def _next(roads: RoadArrays, lane: int, forwards: bool, k: int) -> int:
    """One of them."""
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
    """Let ways begin on a lane, `way` m before its end, or behind its start."""
    for k in range(_num_next(roads, lane, forwards)):
        other = _next(roads, lane, forwards, k)
        ways[other] = min(ways[other], way)


@kernel
def extend_paths(
    roads: RoadArrays,
    # in the direction of driving, to the starts of lanes; if not, back to their ends
    forwards: bool,
    limit_m: float,  # of a way
    # (L,) m, finite where ways begin, inf elsewhere; those that are longer are left as they are
    ways: NDArray[np.float64],
    scratch: VisibilityScratch,  # `waits` and `following` are used
) -> None:
    """Shortest ways along the roads, from where they begin to all lanes within a limit."""
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
