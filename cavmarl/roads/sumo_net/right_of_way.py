"""CONFLICT rows from the request bits of the junctions and the paths of the links."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.roads.network import CONFLICT
from cavmarl.roads.sumo_net.conflicts import LinkPath, Overlap, grazing, overlap
from cavmarl.roads.sumo_net.selection import Movement

Row = tuple[int, bool, bool, float, float, float, float]


def conflict_rows(
    movements: Sequence[Movement], paths: Sequence[LinkPath | None]
) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """All conflicts of all links, and each link's first row with the end as last entry.

    Two links are foes if either names the other: some maps set the bit on one side only, but a
    shared area is shared. Links over a bridge and below it are none, whatever the map says. Links
    from different lanes that the map calls free of each other, but that pass so narrowly that cars
    would touch, are foes too; of these a left turn gives way.

    Args:
        movements: one a LINK row.
        paths: the path of each link; None where the map has no internal lanes.

    Raises:
        MapError: a junction's request has fewer bits than the junction has links.
    """
    by_node: dict[int, list[int]] = defaultdict(list)
    for link, movement in enumerate(movements):
        by_node[id(movement.node)].append(link)
    found: list[list[Row]] = [[] for _ in movements]
    for links in by_node.values():
        for one, other in combinations(links, 2):
            a, b = movements[one], movements[other]
            merging = a.connection.getToLane() is b.connection.getToLane()
            if _bit(a, b, a.node._foes) or _bit(b, a, a.node._foes):
                shared = _shared(paths[one], paths[other], merging=merging)
                yields = _bit(a, b, a.node._prohibits), _bit(b, a, a.node._prohibits)
            elif a.connection.getFromLane() is not b.connection.getFromLane() and not merging:
                shared = _grazing(paths[one], paths[other])
                yields = _turns_left(a) and not _turns_left(b), _turns_left(b)
            else:
                continue
            if shared is None:
                continue
            mine, theirs = shared[:2], shared[2:]
            found[one].append((other, merging, yields[0], *mine, *theirs))
            found[other].append((one, merging, yields[1], *theirs, *mine))

    counts = [len(rows) for rows in found]
    conflicts = np.zeros(sum(counts), CONFLICT)
    conflicts[:] = [row for rows in found for row in sorted(rows)]
    return conflicts, np.concatenate([[0], np.cumsum(counts, dtype=np.int32)]).astype(np.int32)


def _bit(mine: Movement, foe: Movement, requests: dict[int, str]) -> bool:
    """The foe's bit in my row of the requests; SUMO writes bit 0 at the right."""
    if not requests:
        return False
    row = requests.get(mine.index, "")
    if foe.index >= len(row):
        raise MapError(
            f"junction '{mine.node.getID()}' has {len(requests)} requests, but more links: build "
            "the network again with netconvert"
        )
    return row[-1 - foe.index] == "1"


def _turns_left(movement: Movement) -> bool:
    return movement.connection.getDirection() in "lLt"


def _grazing(path: LinkPath | None, foe: LinkPath | None) -> Overlap | None:
    return None if path is None or foe is None else grazing(path, foe)


def _shared(path: LinkPath | None, foe: LinkPath | None, *, merging: bool) -> Overlap | None:
    """The shared area; without internal lanes the junction is a point."""
    if path is None or foe is None:
        return Overlap(0.0, path.s[-1] if path else 0.0, 0.0, foe.s[-1] if foe else 0.0)
    return overlap(path, foe, merging=merging)
