"""Several maps as one network: an episode uses one map, and no road connects two maps.

Maps are placed side by side, so far apart that no search for roads reaches two maps. Each id gets
the prefix `NAME/`, with the name of its map.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.roads.network import MAP, RoadNetwork

APART_M = 1000.0  # distance between the lanes of two maps
WHOLE_M = 1000.0  # maps are moved by multiples of this length

# For each index field, the array to which the index refers. -1 ("none") does not change.
POINTERS: dict[str, dict[str, str]] = {
    "lanes": {
        "left": "lanes", "right": "lanes", "successor": "lanes", "link": "links",
        "first_link": "links", "first_point": "points", "edge": "edges", "first_into": "into",
    },
    "edges": {
        "first_lane": "lanes", "from_junction": "junctions", "to_junction": "junctions",
    },
    "links": {
        "from_lane": "lanes", "to_lane": "lanes", "first_internal": "lanes", "next_lane": "lanes",
        "junction": "junctions", "signal": "signals", "first_conflict": "conflicts",
        "first_sweep": "sweeps",
    },
    "conflicts": {"foe": "links"},
    "sweeps": {"foe": "links"},
    "junctions": {"signal": "signals"},
    "signals": {"program": "programs", "first_switch": "switches"},
    "programs": {"signal": "signals", "first_phase": "phases"},
    "phases": {
        "following": "phases", "first_state": "phase_states", "first_detector": "phase_detectors",
    },
    "switches": {"signal": "signals", "program": "programs"},
    "detectors": {"lane": "lanes"},
    "points": {},
    "into": {"": "lanes"},
    "phase_states": {},
    "phase_detectors": {"": "detectors"},
}  # fmt: skip
_IDS = ("lane_ids", "edge_ids", "junction_ids", "signal_ids")


def join(networks: Sequence[RoadNetwork]) -> RoadNetwork:
    """Join several networks to one; a single network is returned unchanged.

    Raises MapError: some maps have left-hand traffic and others right-hand traffic.
    """
    if len(networks) == 1:
        return networks[0]
    first = networks[0]
    others = [other.name for other in networks if other.left_hand != first.left_hand]
    if others:
        sides = ("right", "left")
        raise MapError(
            f"maps with {sides[not first.left_hand]}-hand traffic: {', '.join(others)}; "
            f"'{first.name}' has {sides[first.left_hand]}-hand traffic: use maps of one kind"
        )
    names = _names(networks)
    starts = {
        key: list(accumulate((len(getattr(one, key)) for one in networks), initial=0))
        for key in POINTERS
    }
    moved = [_moved(one, place) for one, place in zip(networks, _places(networks), strict=True)]
    arrays: dict[str, Any] = {
        key: np.concatenate(
            [_pointed(getattr(one, key), key, starts, n) for n, one in enumerate(moved)]
        )
        for key in POINTERS
    }
    arrays["programs"]["controller"] = _controllers(networks)
    arrays["lanes"]["map"] = np.repeat(np.arange(len(networks)), [len(n.lanes) for n in networks])
    kinds = tuple(dict.fromkeys(kind for one in networks for kind in one.junction_kinds))
    arrays["junctions"]["kind"] = np.concatenate(
        [_kind_rows(one, kinds)[one.junctions["kind"]] for one in networks]
    )
    ids: dict[str, Any] = {
        key: tuple(f"{name}/{own}" for name, one in zip(names, networks, strict=True)
                   for own in getattr(one, key))
        for key in _IDS
    }  # fmt: skip
    sources = "".join(one.source_hash for one in networks)
    return RoadNetwork(
        name=f"{len(networks)} maps",
        source_hash=hashlib.sha256(sources.encode()).hexdigest(),
        **arrays,
        **ids,
        program_ids=tuple(own for one in networks for own in one.program_ids),
        junction_kinds=kinds,
        left_hand=first.left_hand,
        notes=tuple(
            f"{name}: {note}"
            for name, one in zip(names, networks, strict=True)
            for note in one.notes
        ),
        joined=_map_rows(networks, starts),
        map_names=names,
    )


def _map_rows(networks: Sequence[RoadNetwork], starts: dict[str, list[int]]) -> NDArray[np.void]:
    rows = np.zeros(len(networks), MAP)
    for kind in ("lane", "signal", "program"):
        rows[f"first_{kind}"] = starts[f"{kind}s"][:-1]
        rows[f"num_{kind}s"] = np.diff(starts[f"{kind}s"])
    return rows


def _names(networks: Sequence[RoadNetwork]) -> tuple[str, ...]:
    """Return the names of the maps, with a number appended to repeated names."""
    names: list[str] = []
    for one in networks:
        count = sum(other.name == one.name for other in networks[: len(names)])
        names.append(one.name if count == 0 else f"{one.name}_{count + 1}")
    return tuple(names)


def _places(networks: Sequence[RoadNetwork]) -> list[tuple[float, float]]:
    """Return the offset of each map in a square grid whose cells fit the largest map."""
    extents = np.array([one.extent_m for one in networks])
    side = float((extents[:, 2:] - extents[:, :2]).max()) + APART_M
    pitch = WHOLE_M * math.ceil(side / WHOLE_M + 1.0)
    columns = math.ceil(math.sqrt(len(networks)))
    corners = WHOLE_M * np.floor(extents[:, :2] / WHOLE_M)
    return [
        (pitch * (n % columns) - corner[0], pitch * (n // columns) - corner[1])
        for n, corner in enumerate(corners.tolist())
    ]


def _moved(network: RoadNetwork, place: tuple[float, float]) -> RoadNetwork:
    x, y = place
    points, lanes, junctions = (
        array.copy() for array in (network.points, network.lanes, network.junctions)
    )
    for array, fields in (
        (points, (("x", x), ("y", y))),
        (junctions, (("x", x), ("y", y))),
        (lanes, (("min_x", x), ("min_y", y), ("max_x", x), ("max_y", y))),
    ):
        for field, by in fields:
            array[field] += by
    return replace(network, points=points, lanes=lanes, junctions=junctions)


def _pointed(
    array: NDArray[Any], key: str, starts: dict[str, list[int]], number: int
) -> NDArray[Any]:
    """Return an array of one map whose indices refer to the joined arrays."""
    found = array.copy()
    for field, target in POINTERS[key].items():
        column = found[field] if field else found
        column[column >= 0] += starts[target][number]
    return found


def _controllers(networks: Sequence[RoadNetwork]) -> NDArray[np.int32]:
    """Return the controller numbers of all actuated programs, map by map."""
    own = np.concatenate([one.programs["controller"] for one in networks])
    found: NDArray[np.int32] = np.where(own >= 0, np.cumsum(own >= 0) - 1, -1).astype(np.int32)
    return found


def _kind_rows(network: RoadNetwork, kinds: tuple[str, ...]) -> NDArray[np.int32]:
    find: Callable[[str], int] = kinds.index
    return np.array([find(kind) for kind in network.junction_kinds], dtype=np.int32)
