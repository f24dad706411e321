"""Scratch memory of the visibility tests, per lane and per link."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class VisibilityScratch(NamedTuple):
    """Distances and marks of each lane and each link."""

    first: NDArray[np.float64]  # (L,) start of the zone's part of a lane, m; inf: it has none
    last: NDArray[np.float64]  # (L,) end of the zone's part of a lane, m
    ahead: NDArray[np.float64]  # (L,) distance from a driver of the zone to a lane's start, m
    behind: NDArray[np.float64]  # (L,) distance from a lane's end to a vehicle with followers, m
    to_line: NDArray[np.float64]  # (L,) distance from a lane's end to the stop line of a foe, m
    to_room: NDArray[np.float64]  # (L,) distance from a lane's end to the line of a foe in `swept`
    beyond: NDArray[np.float64]  # (L,) distance from the junction of a link in `asked` to a lane, m
    asked: NDArray[np.bool_]  # (K,) links that a driver of the zone may want to enter
    foe: NDArray[np.bool_]  # (K,) foes of the links in `asked`
    swept: NDArray[np.bool_]  # (K,) foes for which vehicles leave room
    waits: NDArray[np.bool_]  # (L,) lanes in the queue of a search
    following: NDArray[np.int32]  # (L,) the next lane in the queue


def make_scratch(num_lanes: int, num_links: int) -> VisibilityScratch:
    first, last, ahead, behind, to_line, to_room, beyond = np.full((7, num_lanes), np.inf)
    asked, foe, swept = np.zeros((3, num_links), dtype=np.bool_)
    waits, following = np.zeros(num_lanes, dtype=np.bool_), np.zeros(num_lanes, dtype=np.int32)
    return VisibilityScratch(
        first, last, ahead, behind, to_line, to_room, beyond, asked, foe, swept, waits, following
    )
