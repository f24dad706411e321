"""Sweeps: where vehicles on two movements would touch although no conflict separates them.

Conflicts describe cars on the junction. But the body of a bus sweeps over adjacent lanes in bends,
over vehicles that wait at the next line, and over vehicles that have just left the junction. So for
each pair of sizes, two bodies are moved along their ways: the paths over the junction plus some
metres before and after it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.records.rows import SIZE_BODIES_M, SIZE_LENGTHS_M, WAIT_SLACK_M
from cavmarl.roads.kernels.swept_range import swept_range
from cavmarl.roads.network import SWEEP
from cavmarl.roads.sumo_net.conflicts import (
    CLEARANCE_M,
    LINE_MARGIN_M,
    LinkPath,
    places_on,
    sample_path,
)


class SweptBody(NamedTuple):
    """Half the size of a body in m, with a margin."""

    half_m: float
    half_width_m: float


# Bodies of the size classes: car; van or truck; bus. Lengths in between belong to the longer class.
BODIES = tuple(map(SweptBody, (0.5 * m for m in SIZE_BODIES_M), (0.95, 1.25, 1.3)))
STEP_M = 0.5
# Bodies are examined from `BEFORE_M` (front before its line) to `BEYOND_M` (rear after the
# junction), or `TURN_BEYOND_M` in a U-turn, which reaches farther over the adjacent lane.
BEFORE_M = 10.0
BEYOND_M = 4.0
TURN_BEYOND_M = 8.0
MARGIN_M = STEP_M
BEHIND_M = 1.0  # distance of a following vehicle behind the rear of its leader
LEAST_ASIDE_M = 0.5  # smallest lateral offset of a body from its way at which its rear swings
TURNAROUND = ord("t")
AHEAD_M = BEFORE_M + 2.0 * BODIES[-1][0]  # length of lane that `poses_on_rails` needs at each end
assert len(BODIES) == len(SIZE_LENGTHS_M) + 1


class Movements(NamedTuple):
    """Links of a network with their conflicts and ways (see the module), by LINK row."""

    links: NDArray[np.void]  # LINK (K,), with conflicts
    conflicts: NDArray[np.void]  # CONFLICT
    ways: Sequence[LinkPath | None]  # over the junction, with `AHEAD_M` of the lanes at its ends
    # for each U-turn: lanes beside its target lane into which no link leads (vehicles may start
    # trips there), see `unfed_beside`
    unfed: Mapping[int, Sequence[LinkPath]] = MappingProxyType({})


def unfed_beside(
    links: NDArray[np.void], lanes: NDArray[np.void], points: NDArray[np.void]
) -> dict[int, list[LinkPath]]:
    """Return, for each U-turn (LINK row), lanes beside its target lane into which no link leads.

    Positions are measured along the U-turn, so the lanes begin at the link's length.
    """
    fed = np.zeros(len(lanes), dtype=np.bool_)
    fed[links["to_lane"]] = True
    found: dict[int, list[LinkPath]] = {}
    for link in np.flatnonzero(links["direction"] == TURNAROUND).tolist():
        sides = lanes[["left", "right"]][links["to_lane"][link]].tolist()
        for row in (lanes[side] for side in sides if side >= 0 and not fed[side]):
            part = points[row["first_point"] : row["first_point"] + row["num_points"]]
            xyz = np.stack([part["x"], part["y"], part["z"]], axis=1)
            path = sample_path(links["length_m"][link] + part["s"], xyz)
            found.setdefault(link, []).append(path)
    return found


def sweep_rows(movements: Movements) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Return the SWEEP rows of all links, and each link's first row plus the end."""
    by_junction: dict[int, list[int]] = defaultdict(list)
    for link, way in enumerate(movements.ways):
        if way is not None:
            by_junction[int(movements.links["junction"][link])].append(link)
    found: list[list[tuple[float, ...]]] = [[] for _ in movements.ways]
    turns = movements.links["direction"] == TURNAROUND
    poses = {}
    for links in by_junction.values():
        beyond_m = TURN_BEYOND_M if turns[links].any() else BEYOND_M
        for link in links:
            way = movements.ways[link]
            assert way is not None
            length = float(movements.links["length_m"][link])
            poses[link] = [poses_on_rails(way, half, length, beyond_m) for half, _ in BODIES]
        for one, other in combinations(links, 2):
            if movements.links["from_lane"][one] != movements.links["from_lane"][other]:
                _find_pair(movements, one, other, poses, found)
        for turn in links:
            if turns[turn]:
                _find_behind(movements, turn, links, poses, found)
                for path in movements.unfed.get(turn, ()):
                    _find_beside(movements, turn, path, poses, found)
        poses.clear()
    counts = [len(rows) for rows in found]
    sweeps = np.zeros(sum(counts), SWEEP)
    sweeps[:] = [row for rows in found for row in sorted(rows, key=_by_own_size)]
    return sweeps, np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _by_own_size(row: tuple[float, ...]) -> tuple[float, ...]:
    """Return a sort key by the vehicle's own size, because a driver reads the rows of its size."""
    return (row[1], *row)


def _find_pair(
    movements: Movements,
    one: int,
    other: int,
    poses: dict[int, list[NDArray[np.float64]]],
    found: list[list[tuple[float, ...]]],
) -> None:
    if not is_near(poses[one][0], poses[other][0]):
        return
    turns = bool((movements.links["direction"][[one, other]] == TURNAROUND).any())
    beyond_m = (TURN_BEYOND_M if turns else BEYOND_M) + STEP_M
    length_m, foe_length_m = movements.links["length_m"][[one, other]]
    for own, body in enumerate(BODIES):
        mine = poses[one][own]
        mine = mine[mine[:, 0] - body.half_m < length_m + beyond_m]
        for foe, foe_body in enumerate(BODIES):
            theirs = poses[other][foe]
            theirs = theirs[theirs[:, 0] - foe_body.half_m < foe_length_m + beyond_m]
            row = find_pair(movements, (one, other), (mine, body), (theirs, foe_body))
            if row is not None:
                here, there = row
                found[one].append((other, own, foe, *here, *there))
                found[other].append((one, foe, own, *there, *here))


Range = tuple[float, float, float, float]
Area = tuple[float, float]  # positions of an arriving front and of a leaving rear, m


def find_pair(
    movements: Movements,
    pair: tuple[int, int],  # LINK rows
    one: tuple[NDArray[np.float64], SweptBody],  # poses on the first link, and the body
    other: tuple[NDArray[np.float64], SweptBody],  # the same for the second link
) -> tuple[Area, Area] | None:
    """Return where two bodies on two links touch, on each link, if no conflict separates them."""
    a, b = (movements.links[link] for link in pair)
    (mine, body), (theirs, foe_body) = one, other
    conflicts = movements.conflicts[a["first_conflict"] :][: a["num_conflicts"]]
    area = conflicts[(conflicts["foe"] == pair[1]) & conflicts["near"]]
    foes = bool(area.size)
    mine_m = theirs_m = (0.0, 0.0)
    if foes:
        row = area[0]
        mine_m = _begin_m(a, row["enter_m"]), float(row["leave_m"])
        theirs_m = _begin_m(b, row["foe_enter_m"]), float(row["foe_leave_m"])
    extents = (*body, float(a["length_m"]), *mine_m), (*foe_body, float(b["length_m"]), *theirs_m)
    if a["to_lane"] != b["to_lane"]:
        found = swept_range(mine, theirs, *extents, CLEARANCE_M, foes)
    else:  # after the junction, one vehicle follows the other
        mine, beyond = _before_and_beyond(mine, float(a["length_m"]))
        theirs, foe_beyond = _before_and_beyond(theirs, float(b["length_m"]))
        found = swept_range(mine, theirs, *extents, CLEARANCE_M, foes)
        # A vehicle in a U-turn comes near oncoming vehicles that have just left the junction.
        if a["direction"] == TURNAROUND and body.half_m > BODIES[0].half_m:
            turns = mine[mine[:, 0] + body.half_m <= a["length_m"]]
            found = _hull(found, swept_range(turns, foe_beyond, *extents, CLEARANCE_M, foes))
        if b["direction"] == TURNAROUND and foe_body.half_m > BODIES[0].half_m:
            turns = theirs[theirs[:, 0] + foe_body.half_m <= b["length_m"]]
            found = _hull(found, swept_range(beyond, turns, *extents, CLEARANCE_M, foes))
    return _areas(found, body.half_m, foe_body.half_m)


def _before_and_beyond(
    poses: NDArray[np.float64], length_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split poses by whether their centres are before the end of a junction."""
    before = poses[:, 0] <= length_m
    return poses[before], poses[~before]


def _hull(one: Range, other: Range) -> Range:
    """Return the range that contains both ranges of `swept_range`."""
    return (
        min(one[0], other[0]), max(one[1], other[1]), min(one[2], other[2]), max(one[3], other[3]),
    )  # fmt: skip


def _areas(found: Range, half_m: float, foe_half_m: float) -> tuple[Area, Area] | None:
    """Return the areas on both ways, given the result of `swept_range`, or None without contact."""
    first, last, foe_first, foe_last = found
    if first == np.inf:
        return None
    here = (first + half_m - MARGIN_M, last - half_m + MARGIN_M)
    return here, (foe_first + foe_half_m - MARGIN_M, foe_last - foe_half_m + MARGIN_M)


def _begin_m(link: np.void, enter_m: float) -> float:
    """Return the start of a conflict's area; it is ahead of a front at the waiting position."""
    waits = enter_m >= link["wait_m"] - LINE_MARGIN_M
    return float(max(enter_m, link["wait_m"] + WAIT_SLACK_M + STEP_M if waits else 0.0))


def _find_behind(
    movements: Movements,
    turn: int,
    links: Sequence[int],
    poses: dict[int, list[NDArray[np.float64]]],
    found: list[list[tuple[float, ...]]],
) -> None:
    """Find contacts of a vehicle in a U-turn, and of its swinging rear, with vehicles behind it."""
    way = movements.ways[turn]
    assert way is not None
    length = float(movements.links["length_m"][turn])
    for foe, (foe_half, foe_wide) in enumerate(BODIES[1:], 1):
        theirs = poses[turn][foe]
        theirs = theirs[theirs[:, 0] + foe_half >= 0.0]
        aside = theirs[:, 1:3] - places_on(way, theirs[:, 0])[:, :2]
        bends = hypot_all(aside[:, 0], aside[:, 1]) > LEAST_ASIDE_M
        has_left = theirs[:, 0] >= foe_half
        other = (foe_half, foe_wide, length, 0.0, 0.0)
        for own, (half, wide) in enumerate(BODIES):
            mine = poses[turn][own]
            mine = mine[mine[:, 0] <= -half]
            body = (half, wide, 0.0, 0.0, 0.0)
            range_m = swept_range(mine, theirs[has_left], body, other, CLEARANCE_M, False)
            for pose in theirs[bends & ~has_left]:
                behind = mine[mine[:, 0] + half + BEHIND_M <= pose[0] - foe_half]
                comes_back = swept_range(behind, pose[None], body, other, CLEARANCE_M, False)
                range_m = _hull(range_m, comes_back)
            areas = _areas(range_m, half, foe_half)
            if areas is None:
                continue
            here, there = areas
            for link in links:
                if movements.links["from_lane"][link] == movements.links["from_lane"][turn]:
                    found[link].append((turn, own, foe, *here, *there))


def _find_beside(
    movements: Movements,
    turn: int,
    path: LinkPath,  # path of an adjacent lane into which no link leads
    poses: dict[int, list[NDArray[np.float64]]],
    found: list[list[tuple[float, ...]]],
) -> None:
    """Find where a U-turn sweeps over vehicles that have started their trip on an adjacent lane.

    The rows have the U-turn's link as link and as foe, as if these vehicles came from that link.
    """
    length = float(movements.links["length_m"][turn])
    for foe, (foe_half, foe_wide) in enumerate(BODIES):
        theirs = poses_on_rails(path, foe_half, length, TURN_BEYOND_M)
        theirs = theirs[theirs[:, 0] - foe_half >= length]
        other = (foe_half, foe_wide, length, 0.0, 0.0)
        for own, (half, wide) in enumerate(BODIES):
            body = (half, wide, length, 0.0, 0.0)
            range_m = swept_range(poses[turn][own], theirs, body, other, CLEARANCE_M, False)
            areas = _areas(range_m, half, foe_half)
            if areas is None:
                continue
            here, there = areas
            found[turn].append((turn, own, foe, *here, *there))
            found[turn].append((turn, foe, own, *there, *here))


def is_near(mine: NDArray[np.float64], theirs: NDArray[np.float64]) -> bool:
    """Return whether two ways are so close that bodies of any size might touch."""
    apart = mine[::2, None, 1:3] - theirs[None, ::2, 1:3]
    square = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]
    return bool(square.min() < 6.0 * 6.0)


def poses_on_rails(
    way: LinkPath, half_m: float, length_m: float, beyond_m: float = BEYOND_M
) -> NDArray[np.float64]:
    """Return (n, 6) position, x, y, z, cos, sin of the centres of bodies with bumpers on a way."""
    at = np.arange(-(BEFORE_M + half_m), length_m + beyond_m + half_m + STEP_M, STEP_M)
    front, rear = places_on(way, at + half_m), places_on(way, at - half_m)
    chord = front - rear
    size = np.maximum(hypot_all(chord[:, 0], chord[:, 1]), 1e-6)
    middle = 0.5 * (front + rear)
    return np.column_stack([at, middle, chord[:, 0] / size, chord[:, 1] / size])
