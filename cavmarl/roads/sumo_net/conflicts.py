"""Computes where the paths of two movements over a junction meet.

The map says *that* two links are foes (a bit of the junction's request); this module computes
*where*: the part of each path on which a vehicle could touch a vehicle on the other path.

The results are CONFLICT rows, the common parts of movements from one lane, and the positions where
cars must stop so that no vehicle on the junction touches them. Maps put the stop line at the end of
a lane, but some paths sweep over that end.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary import cos_sin, hypot
from cavmarl.core.math.elementary_arrays import atan2_all, cos_all, sin_all
from cavmarl.core.records.rows import FORK_BEYOND_M
from cavmarl.roads.network import CONFLICT
from cavmarl.roads.sumo_net.selection import Movement

SAMPLE_M = 0.5
# Half the width of a car (2 m) on each path, plus a margin for corners that are cut in a turn.
NEAR_M = 1.0 + 1.0 + 0.6
# Half the size of a car, plus a margin.
HALF_LENGTH_M = 2.6
HALF_WIDTH_M = 1.1
# Paths with a larger difference in height are a bridge and the road below it.
CLEARANCE_M = 3.0
# Half length of the area of foes whose paths never come close in the plane.
TOUCH_M = 1.0
WAITS_BACK_M = 3.0  # maximum distance that drivers wait before netconvert's waiting position


class LinkPath(NamedTuple):
    """The path of a link over its junction: samples at most `SAMPLE_M` apart, and both ends."""

    s: NDArray[np.float64]  # (n,) distance from the stop line, m
    xyz: NDArray[np.float64]  # (n, 3) m


class Poses(NamedTuple):
    """Car boxes along a path."""

    xyz: NDArray[np.float64]  # (n, 3) centres, m
    heading: NDArray[np.float64]  # (n,) rad


class Overlap(NamedTuple):
    """The shared area of two paths, in metres from each stop line."""

    enter_m: float
    leave_m: float
    foe_enter_m: float
    foe_leave_m: float
    near: bool = True  # False: the paths stay apart, and the area is where they are closest


def sample_path(s: NDArray[np.float64], xyz: NDArray[np.float64]) -> LinkPath:
    """Sample a polyline evenly, given arc lengths `s` (n,) and points `xyz` (n, 3) in metres."""
    count = int(np.ceil((s[-1] - s[0]) / SAMPLE_M)) + 1
    at = np.linspace(s[0], s[-1], max(count, 2))
    return LinkPath(at, np.stack([np.interp(at, s, xyz[:, axis]) for axis in range(3)], axis=1))


def overlap(path: LinkPath, foe: LinkPath, *, merging: bool) -> Overlap | None:
    """Return where the paths of two foes meet, or None if one path is a bridge over the other.

    `path`: the path of one link. `foe`: the path of the other link. `merging`: both paths lead into
    the same lane, so the shared area extends to their ends.

    The area is the hull of all parts with less than `NEAR_M` between the centre lines. Without such
    parts, it extends `TOUCH_M` around the closest points.
    """
    plane = path.xyz[:, None, :2] - foe.xyz[None, :, :2]
    square = plane[..., 0] * plane[..., 0] + plane[..., 1] * plane[..., 1]
    level = np.abs(path.xyz[:, None, 2] - foe.xyz[None, :, 2]) <= CLEARANCE_M
    near = level & (square <= NEAR_M * NEAR_M)
    if near.any():
        mine, theirs = path.s[near.any(axis=1)], foe.s[near.any(axis=0)]
        half = 0.5 * SAMPLE_M
        found = Overlap(
            *_stretch(path, mine[0] - half, mine[-1] + half),
            *_stretch(foe, theirs[0] - half, theirs[-1] + half),
        )
    else:
        row, column = np.unravel_index(square.argmin(), square.shape)
        if not level[row, column]:
            return None
        mine, theirs = path.s[row], foe.s[column]
        found = Overlap(
            *_stretch(path, mine - TOUCH_M, mine + TOUCH_M),
            *_stretch(foe, theirs - TOUCH_M, theirs + TOUCH_M),
            near=False,
        )
    if merging:
        ends = {"leave_m": float(path.s[-1]), "foe_leave_m": float(foe.s[-1])}
        found = found._replace(**ends, near=True)
    return found


def grazing(
    path: LinkPath, foe: LinkPath, way: LinkPath, foe_way: LinkPath, *, forked: bool = False
) -> Overlap | None:
    """Return where cars on two paths would touch because cars are oblique in bends, or None.

    The ways are the paths plus some metres of the lanes at their ends. If the paths are `forked`,
    they leave the same lane, and only the area where they meet again counts. As for `overlap`, the
    result has the positions of an arriving front bumper and of a leaving rear bumper.
    """
    mine, theirs = poses(path, way), poses(foe, foe_way)
    apart = mine.xyz[:, None, :] - theirs.xyz[None, :, :]
    square = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]
    level = np.abs(apart[..., 2]) <= CLEARANCE_M
    reach = 2.0 * hypot(HALF_LENGTH_M, HALF_WIDTH_M)
    rows, columns = np.nonzero(level & (square < reach * reach))
    if not rows.size:
        return None
    meet = touching(apart[rows, columns, :2], mine.heading[rows], theirs.heading[columns])
    if forked:
        meet &= (rows > _first_absent(rows[meet])) & (columns > _first_absent(columns[meet]))
    if not meet.any():
        return None
    here, there = path.s[rows[meet]], foe.s[columns[meet]]
    return Overlap(*_from_centres(path, here), *_from_centres(foe, there))


def _first_absent(numbers: NDArray[np.intp]) -> int:
    return int(np.setdiff1d(np.arange(len(numbers) + 1), numbers)[0])


def poses(path: LinkPath, way: LinkPath) -> Poses:
    """Return car poses along a path, which is a part of a way; both bumpers are on the way."""
    front, rear = places_on(way, path.s + HALF_LENGTH_M), places_on(way, path.s - HALF_LENGTH_M)
    chord = front - rear
    return Poses(0.5 * (front + rear), atan2_all(chord[:, 1], chord[:, 0]))


def places_on(way: LinkPath, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 3) positions on a way, which extends straight beyond its ends."""
    ends = np.concatenate([[way.s[0] - 100.0], way.s, [way.s[-1] + 100.0]])
    first, last = way.xyz[1] - way.xyz[0], way.xyz[-1] - way.xyz[-2]
    first = first / max(hypot(float(first[0]), float(first[1])), 1e-6)
    last = last / max(hypot(float(last[0]), float(last[1])), 1e-6)
    xyz = np.concatenate([[way.xyz[0] - 100.0 * first], way.xyz, [way.xyz[-1] + 100.0 * last]])
    return np.stack([np.interp(at, ends, xyz[:, axis]) for axis in range(3)], axis=1)


def touching(
    apart: NDArray[np.float64], mine: NDArray[np.float64], theirs: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which pairs of car boxes have no separating axis.

    `apart`: (n, 2) vector between the centres, m. `mine`, `theirs`: (n,) headings, rad.
    """
    across = np.abs(sin_all(mine - theirs))
    along = np.abs(cos_all(mine - theirs))
    separated = np.zeros(len(apart), dtype=np.bool_)
    for heading in (mine, theirs):
        cos, sin = cos_all(heading), sin_all(heading)
        forward = np.abs(apart[:, 0] * cos + apart[:, 1] * sin)
        sideways = np.abs(apart[:, 1] * cos - apart[:, 0] * sin)
        separated |= forward > HALF_LENGTH_M * (1.0 + along) + HALF_WIDTH_M * across
        separated |= sideways > HALF_WIDTH_M * (1.0 + along) + HALF_LENGTH_M * across
    return ~separated


def _from_centres(path: LinkPath, centres: NDArray[np.float64]) -> tuple[float, float]:
    """Return the part of the shared area that a car covers, from the positions of its centre."""
    enter, leave = centres.min() + HALF_LENGTH_M, centres.max() - HALF_LENGTH_M
    middle = 0.5 * (enter + leave)
    return _stretch(path, min(enter, middle), max(leave, middle))


def _stretch(path: LinkPath, start: float, end: float) -> tuple[float, float]:
    return max(0.0, float(start)), min(float(path.s[-1]), float(end))


def fork_lengths(from_lane: Sequence[int], paths: Sequence[LinkPath | None]) -> NDArray[np.float64]:
    """Return how much of each link's path is near another path from the same lane, in m.

    Args:
        from_lane: (K,) LANE row that each link leaves.
        paths: (K,) the path of each link, None if the map has none.
    """
    lengths = np.zeros(len(paths))
    leaving: dict[int, list[int]] = defaultdict(list)
    for link, lane in enumerate(from_lane):
        leaving[lane].append(link)
    for links in leaving.values():
        for link in links:
            path = paths[link]
            others = [other for k in links if k != link and (other := paths[k]) is not None]
            if path is not None and others:
                lengths[link] = max(_shared_m(path, other) for other in others)
    return lengths


def _shared_m(path: LinkPath, other: LinkPath) -> float:
    apart = path.xyz[:, None, :2] - other.xyz[None, :, :2]
    nearest = (apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]).min(axis=1)
    parted = np.flatnonzero(nearest > NEAR_M * NEAR_M)
    return float(path.s[parted[0]]) if parted.size else float(path.s[-1]) + FORK_BEYOND_M


LINE_MARGIN_M = 1.0  # drivers stop at this distance before a line, see `car_following_model`
STEP_M = 0.5
MOST_M = 8.0
BODY_M = 5.0


def stop_back(
    ends: NDArray[np.float64],
    edge: NDArray[np.int32],
    from_lane: Sequence[int],
    junction: Sequence[int],
    paths: Sequence[LinkPath | None],
    approaches: Sequence[LinkPath | None],
    ways: Sequence[LinkPath | None],
) -> NDArray[np.float64]:
    """Return the distance in m between the stop line and the end of each lane.

    Args:
        ends: (L, 4) x, y, z of each lane's end in m, and the lane's direction there in rad.
        edge: (L,) EDGE row of each lane.
        from_lane: (K,) LANE row that each link leaves.
        junction: (K,) JUNCTION row of each link.
        paths: (K,) the path of each link, None if the map has none.
        approaches: (K,) the paths plus the last metres before the junction, where waiting vehicles
            must also keep clear of vehicles from another road.
        ways: (K,) the paths plus some metres of the lanes at both ends.

    Returns:
        (L,), 0 if no path from another lane comes near, or if a line would have to move back more
        than `MOST_M`.
    """
    back = np.zeros(len(ends))
    at: dict[int, list[int]] = defaultdict(list)
    for link, row in enumerate(junction):
        if paths[link] is not None:
            at[row].append(link)
    for links in at.values():
        inside = {link: _poses(paths[link], ways[link]) for link in links}
        coming = {link: _poses(approaches[link], ways[link]) for link in links}
        for lane in {from_lane[link] for link in links}:
            others = [
                (inside if edge[from_lane[link]] == edge[lane] else coming)[link]
                for link in links
                if from_lane[link] != lane
            ]
            if others:
                back[lane] = _first_free(ends[lane], others)
    return back


def _poses(path: LinkPath | None, way: LinkPath | None) -> Poses:
    assert path is not None
    assert way is not None
    return poses(path, way)


def _first_free(end: NDArray[np.float64], others: Sequence[Poses]) -> float:
    x, y, z, heading = end
    cos, sin = cos_sin(heading)
    for step in range(int(MOST_M / STEP_M) + 1):
        back = step * STEP_M
        centre = LINE_MARGIN_M + back + 0.5 * BODY_M
        body = Poses(
            np.array([[x - centre * cos, y - centre * sin, z]]),
            np.array([heading]),
        )
        if not any(_meets(body, other) for other in others):
            return back
    return 0.0


def _meets(body: Poses, other: Poses) -> bool:
    level = np.abs(other.xyz[:, 2] - body.xyz[0, 2]) <= CLEARANCE_M
    apart = other.xyz[level, :2] - body.xyz[0, :2]
    own = np.broadcast_to(body.heading, (int(level.sum()),))
    return bool(touching(apart, own, other.heading[level]).any())


Row = tuple[int, bool, bool, bool, float, float, float, float]


def conflict_rows(
    movements: Sequence[Movement],
    paths: Sequence[LinkPath | None],
    ways: Sequence[LinkPath | None],
    left_hand: bool,
) -> tuple[NDArray[np.void], NDArray[np.int32], list[int]]:
    """Return all CONFLICT rows, each link's first row plus the end, and the unruled links.

    Two links are foes if the map sets the bit of either link, because some maps set only one of the
    two bits. A link over a bridge and a link below it are never foes. Links from different lanes
    that are not foes in the map are also foes if cars would touch; then the turn across the road
    yields. Links from one lane are foes where their paths meet again beyond the fork; neither has
    the right of way. A link is unruled if it ends in the same lane as another link, and the map has
    no rule for the pair.

    Args:
        movements: one per LINK row.
        paths: the path of each link; None if the map has no internal lanes.
        ways: the paths plus some metres of the lanes at both ends.
        left_hand: whether the map has left-hand traffic; then turns to the right cross the road.

    Raises:
        MapError: a junction's request has fewer bits than the junction has links.
    """
    by_node: dict[int, list[int]] = defaultdict(list)
    for link, movement in enumerate(movements):
        by_node[id(movement.node)].append(link)
    found: list[list[Row]] = [[] for _ in movements]
    unruled: list[int] = []
    for links in by_node.values():
        for one, other in combinations(links, 2):
            a, b = movements[one], movements[other]
            merging = a.connection.getToLane() is b.connection.getToLane()
            if _bit(a, b, a.node._foes) or _bit(b, a, a.node._foes):
                shared = _shared(paths[one], paths[other], merging=merging)
                yields = _bit(a, b, a.node._prohibits), _bit(b, a, a.node._prohibits)
            elif a.connection.getFromLane() is not b.connection.getFromLane():
                if merging:
                    unruled.append(one)
                    shared = _shared(paths[one], paths[other], merging=True)
                else:
                    shared = _grazing(paths, ways, one, other)
                crosses = _turns_across(a, left_hand), _turns_across(b, left_hand)
                yields = crosses[0] and not crosses[1], crosses[1]
                if merging and not any(yields):
                    yields = not _is_straight(a) and _is_straight(b), _is_straight(a)
            else:
                shared = _grazing(paths, ways, one, other, forked=True)
                yields = False, False
            if shared is None:
                continue
            mine, theirs = shared[:2], shared[2:4]
            found[one].append((other, merging, yields[0], shared.near, *mine, *theirs))
            found[other].append((one, merging, yields[1], shared.near, *theirs, *mine))

    counts = [len(rows) for rows in found]
    conflicts = np.zeros(sum(counts), CONFLICT)
    conflicts[:] = [row for rows in found for row in sorted(rows)]
    first = np.concatenate([[0], np.cumsum(counts, dtype=np.int32)]).astype(np.int32)
    return conflicts, first, unruled


def fill_conflicts(
    lanes: NDArray[np.void],
    links: NDArray[np.void],
    conflicts: NDArray[np.void],
    first_conflict: NDArray[np.int32],
) -> None:
    """Write the conflicts of each LINK, and its waiting position in the junction, into `links`.

    Also set `merges` of lanes whose vehicles have the right of way over vehicles that merge with
    them without a signal, except at all-way stops.
    """
    links["first_conflict"] = first_conflict[:-1]
    links["num_conflicts"] = np.diff(first_conflict)
    owner = np.repeat(np.arange(len(links)), links["num_conflicts"])
    links["wait_m"] = _wait_places(links["wait_m"], owner, conflicts)
    asks = (links["signal"][owner] < 0) & conflicts["merging"] & conflicts["must_yield"]
    asks &= links["state"][conflicts["foe"]] != ord("w")
    watched = links["from_lane"][conflicts["foe"][asks]]
    lanes["merges"][watched] = True


def _wait_places(
    wait_m: NDArray[np.float64], owner: NDArray[np.intp], conflicts: NDArray[np.void]
) -> NDArray[np.float64]:
    """Return waiting positions in junctions, in m from the stop line, clear of other vehicles.

    netconvert's positions suit SUMO's margins. If a position is at most `WAITS_BACK_M` inside the
    area of a conflict in which the foe has priority, drivers wait before that area.

    Args:
        wait_m: (K,) netconvert's positions; inf: none.
        owner: (num_conflicts,) LINK row of each conflict.
        conflicts: CONFLICT (num_conflicts,).
    """
    place = conflicts["enter_m"] + LINE_MARGIN_M
    back = wait_m[owner] - place
    # Rows are sorted by link, then foe. Sorting by foe, then link, gives the opposite rows.
    mirror = np.argsort(np.lexsort((owner, conflicts["foe"])))
    drives_on = conflicts["must_yield"] & ~conflicts["must_yield"][mirror]
    moved = drives_on & (back > 0.0) & (back <= WAITS_BACK_M)
    places = wait_m.copy()
    np.minimum.at(places, owner[moved], place[moved])
    return places


def _bit(mine: Movement, foe: Movement, requests: dict[int, str]) -> bool:
    """Return the foe's bit in a movement's row of requests; in SUMO, bit 0 is at the right."""
    if not requests:
        return False
    row = requests.get(mine.index, "")
    if foe.index >= len(row):
        raise MapError(
            f"junction '{mine.node.getID()}' has more links than its {len(requests)} requests: "
            "build the network again with netconvert"
        )
    return row[-1 - foe.index] == "1"


def _is_straight(movement: Movement) -> bool:
    return str(movement.connection.getDirection()) == "s"


def _turns_across(movement: Movement, left_hand: bool) -> bool:
    across = "rRT" if left_hand else "lLt"
    return str(movement.connection.getDirection()) in across


def _grazing(
    paths: Sequence[LinkPath | None],
    ways: Sequence[LinkPath | None],
    one: int,
    other: int,
    *,
    forked: bool = False,
) -> Overlap | None:
    path, foe, way, foe_way = paths[one], paths[other], ways[one], ways[other]
    if path is None or foe is None or way is None or foe_way is None:
        return None
    return grazing(path, foe, way, foe_way, forked=forked)


def _shared(path: LinkPath | None, foe: LinkPath | None, *, merging: bool) -> Overlap | None:
    """Return the shared area; without internal lanes, the junction counts as a point."""
    if path is None or foe is None:
        return Overlap(0.0, path.s[-1] if path else 0.0, 0.0, foe.s[-1] if foe else 0.0)
    return overlap(path, foe, merging=merging)
