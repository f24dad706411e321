"""What is known of each lane, and of each link, while a zone's looks are found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class VisibilityScratch(NamedTuple):
    """What is known of each lane, and of each link, on the way."""

    first: NDArray[np.float64]  # (L,) the zone's own part of a lane, m; inf: it has none
    last: NDArray[np.float64]  # (L,)
    ahead: NDArray[np.float64]  # (L,) way from a driver of the zone to the start of a lane, m
    behind: NDArray[np.float64]  # (L,) way from the end of a lane to a vehicle with followers, m
    to_line: NDArray[np.float64]  # (L,) way from the end of a lane to the line of a foe, m
    to_room: NDArray[np.float64]  # (L,) the same, of one that is left room for
    beyond: NDArray[np.float64]  # (L,) way from a junction that is asked about to a lane, m
    asked: NDArray[np.bool_]  # (K,) links that a driver of the zone may want to enter
    foe: NDArray[np.bool_]  # (K,) their foes
    swept: NDArray[np.bool_]  # (K,) of these those that vehicles leave room for
    waits: NDArray[np.bool_]  # (L,) to be looked at
    following: NDArray[np.int32]  # (L,) which lane is to be looked at then


def make_scratch(num_lanes: int, num_links: int) -> VisibilityScratch:
    first, last, ahead, behind, to_line, to_room, beyond = np.full((7, num_lanes), np.inf)
    asked, foe, swept = np.zeros((3, num_links), dtype=np.bool_)
    waits, following = np.zeros(num_lanes, dtype=np.bool_), np.zeros(num_lanes, dtype=np.int32)
    return VisibilityScratch(
        first, last, ahead, behind, to_line, to_room, beyond, asked, foe, swept, waits, following
    )
