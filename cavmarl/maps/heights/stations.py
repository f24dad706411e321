"""Places along all lanes of a network file, at most a metre apart, where heights are computed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.maps.heights.profile_graph import ProfileGraph
from cavmarl.maps.net_document import DocumentLane, NetDocument, Points

STEP_M = 1.0
# The neighbour of a place on the lane beside it is the nearest place among those up to this many
# places before and after the same share of that lane.
_BESIDE = 40
_OFF_M = 0.01  # maximum error of written heights

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Stations:
    """Places of all lanes, one lane after another."""

    lanes: tuple[DocumentLane, ...]
    plane_m: Points  # (n, 2) x and y
    s_m: NDArray[np.float64]  # (n,) from the start of the lane
    written: NDArray[np.bool_]  # (n,) whether the place is in the file
    first: Rows  # (lanes + 1,) rows of each lane
    graph: ProfileGraph  # its nodes are the places, then the junctions
    hubs_m: Points  # (junctions, 2)
    junction_ids: tuple[str, ...]

    @property
    def lane_of(self) -> Rows:
        return np.repeat(np.arange(len(self.lanes)), np.diff(self.first))

    def rows(self, lane: int) -> slice:
        return slice(int(self.first[lane]), int(self.first[lane + 1]))


def stations_of(document: NetDocument) -> Stations:
    """Return the stations on each lane of a document.

    Raises MapError: a lane has no shape, or the map already has heights.
    """
    lanes = tuple(document.lanes)
    parts, s_parts, written = [], [], []
    for lane in lanes:
        shape = lane.points
        if len(shape) < 2:
            raise MapError(f"{document.path}: lane {lane.id} has no shape: build the map again")
        if shape.shape[1] > 2 and shape[:, 2].any():
            raise MapError(
                f"{document.path}: has heights already (lane {lane.id}): leave out --dem, or build "
                "the map again from its source, with --dem"
            )
        places, s_m, own = laid(shape[:, :2])
        parts.append(places)
        s_parts.append(s_m)
        written.append(own)
    first = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    plane = np.concatenate(parts)
    hubs, ids, links = _links(document, lanes, plane, first)
    places = np.concatenate([plane, hubs])
    lengths = hypot_all(*(places[links[:, 0]] - places[links[:, 1]]).T)
    graph = ProfileGraph(len(places), links, lengths)
    return Stations(
        lanes, plane, np.concatenate(s_parts), np.concatenate(written), first, graph, hubs, ids
    )


def laid(shape: Points) -> tuple[Points, NDArray[np.float64], NDArray[np.bool_]]:
    """Return places on a polyline, their arc lengths, and which of them are points of `shape`."""
    lengths = hypot_all(*np.diff(shape, axis=0).T)
    counts = np.maximum(np.ceil(lengths / STEP_M).astype(np.int64), 1)
    segment = np.repeat(np.arange(len(counts)), counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    share = (np.arange(starts[-1]) - starts[segment]) / counts[segment]
    at = np.concatenate([segment + share, [len(counts)]])
    s_of_point = np.concatenate([[0.0], np.cumsum(lengths)])
    numbers = np.arange(len(shape))
    places = np.stack([np.interp(at, numbers, shape[:, axis]) for axis in (0, 1)], axis=1)
    own = np.zeros(len(at), bool)
    own[starts] = True
    return places, np.interp(at, numbers, s_of_point), own


def _links(
    document: NetDocument, lanes: tuple[DocumentLane, ...], plane_m: Points, first: Rows
) -> tuple[Points, tuple[str, ...], Rows]:
    """Return positions and ids of junctions, and pairs of places between which vehicles drive."""
    row_of = {lane.id: row for row, lane in enumerate(lanes)}
    along = np.delete(np.arange(first[-1] - 1), first[1:-1] - 1)
    pairs = [np.stack([along, along + 1], axis=1)]
    joints = []
    for connection in document.root.iter("connection"):
        names = [
            f"{connection.get('from')}_{connection.get('fromLane')}",
            connection.get("via", ""),
            f"{connection.get('to')}_{connection.get('toLane')}",
        ]
        known = [row_of[name] for name in names if name in row_of]
        joints += [(first[one + 1] - 1, first[other]) for one, other in pairwise(known)]
    hubs: list[tuple[float, float]] = []
    ids: dict[str, int] = {}
    for junction in document.junctions():
        if junction.get("type") != "internal":
            ids[junction.get("id", "")] = len(hubs)
            hubs.append((float(junction.get("x", 0)), float(junction.get("y", 0))))
    base = int(first[-1])
    for row, lane in enumerate(lanes):
        if not lane.internal:
            for end, place in (("from", first[row]), ("to", first[row + 1] - 1)):
                hub = ids.get(lane.edge.get(end, ""))
                if hub is not None:
                    joints.append((place, base + hub))
    pairs += _beside(lanes, plane_m, first)
    if joints:
        pairs.append(np.array(joints, dtype=np.int64))
    return np.array(hubs).reshape(-1, 2), tuple(ids), np.concatenate(pairs)


def _beside(lanes: tuple[DocumentLane, ...], plane_m: Points, first: Rows) -> list[Rows]:
    """Return pairs of places that are side by side on neighbouring lanes of one edge."""
    pairs = []
    window = np.arange(-_BESIDE, _BESIDE + 1)
    for lane, (one, other) in enumerate(pairwise(lanes)):
        if one.edge is other.edge:
            here, there = np.arange(*first[lane : lane + 2]), np.arange(*first[lane + 1 : lane + 3])
            along = np.rint(np.linspace(0, len(there) - 1, len(here))).astype(np.int64)
            near = there[np.clip(along[:, None] + window, 0, len(there) - 1)]
            apart = plane_m[here, None] - plane_m[near]
            nearest = hypot_all(apart[..., 0], apart[..., 1]).argmin(axis=1)
            pairs.append(np.stack([here, near[np.arange(len(here)), nearest]], axis=1))
    return pairs


def kept_rows(s_m: NDArray[np.float64], z_m: NDArray[np.float64], own: NDArray[np.bool_]) -> Rows:
    """Return the rows of a lane to write: its original points, and places needed for heights."""
    kept = set(np.flatnonzero(own).tolist())
    open_parts = list(pairwise(sorted(kept)))
    while open_parts:
        start, end = open_parts.pop()
        if end - start < 2 or s_m[end] <= s_m[start]:
            continue
        inner = slice(start + 1, end)
        share = (s_m[inner] - s_m[start]) / (s_m[end] - s_m[start])
        off = np.abs(z_m[inner] - (z_m[start] + share * (z_m[end] - z_m[start])))
        worst = int(off.argmax())
        if off[worst] > _OFF_M:
            middle = start + 1 + worst
            kept.add(middle)
            open_parts += [(start, middle), (middle, end)]
    return np.array(sorted(kept), dtype=np.int64)
