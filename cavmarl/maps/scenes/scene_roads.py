"""Makes a SUMO network from the lanes of a logged scene.

Each lane keeps its centre line. Parallel lanes become one edge, so that vehicles can change lanes.
A lane that crosses, leaves or joins other lanes becomes an internal lane of a junction, if it is
between two other lanes. Scenes state neither widths nor rights of way: these are guessed, and
counted.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary import atan2, cos_sin
from cavmarl.maps.scenes.logged_scene import LoggedScene, Numbers, SceneLane

WIDTH_M = 3.5
STREET_MPS, FREEWAY_MPS = 15.65, 29.06  # 35 and 65 mph
_SHORTEST_M = 0.5  # shorter lanes are left out
_SAME_M = 0.01  # closer points are one point
_JOIN_M = 1.0  # distance between the end of a lane and the start of its successor
_JOIN_COS = 0.7  # 45°
_PARALLEL_COS = 0.966  # 15°
_BESIDE_M = (2.0, 6.0)  # lateral distance between the centre lines of neighbours
_LEVEL_M = 3.0  # longitudinal distance between the ends of neighbours
_INNER_M = 200.0  # the longest path over a junction
_NEAR_M = 2.0  # closer paths are in conflict
_SAMPLE_M = 1.0
_BLOCK = 256  # samples that are compared at once
_MOST_M = 1e6  # length of all lanes together
_STRAIGHT_RAD, _BACK_RAD = 0.52, 2.62  # 30° and 150°
_HEIGHT_M = 3.0  # a larger difference in height is a bridge


class SceneNetwork(NamedTuple):
    """A SUMO network: its text, and its guesses and omissions, with counts."""

    text: str
    notes: tuple[str, ...]


@dataclass
class _Lane:
    """A lane with its ends and its connections."""

    lane: SceneLane
    points: Numbers  # (n, 3)
    length_m: float
    samples: Numbers  # (k, 3), at most `_SAMPLE_M` apart
    start: tuple[float, float]  # direction, a unit vector
    end: tuple[float, float]
    before: list[int]
    after: list[int]

    @property
    def box(self) -> tuple[float, float, float, float]:
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


class _Movement(NamedTuple):
    """A connection from a lane to the next one; `inner`: the lane between them, -1: none."""

    source: int
    inner: int
    target: int


def scene_network(scene: LoggedScene) -> SceneNetwork:
    """Return the SUMO network of a scene.

    Raises MapError: no lane is long enough to drive on, or the lanes are too long.
    """
    lanes, short = _lanes_of(scene)
    if not lanes:
        raise MapError(f"no lane is longer than {_SHORTEST_M} m: export the scene with its lanes")
    _connect(lanes)
    near = _near_pairs(lanes)
    inner = _inner_lanes(lanes, near)
    drawn = _Drawing(lanes, inner, near)
    unstated = sum(lane.lane.speed_mps is None for lane in lanes)
    told = (
        (short, f"lanes shorter than {_SHORTEST_M} m ignored"),
        (unstated, f"lanes without speed limit: {STREET_MPS} m/s, on freeways {FREEWAY_MPS} m/s"),
        (len(lanes), f"lanes without width: {WIDTH_M} m"),
        (drawn.num_ruled, "junctions without right of way: vehicles from the right go first, and "
         "turning vehicles yield"),
    )  # fmt: skip
    return SceneNetwork(drawn.text(), tuple(f"{count} {what}" for count, what in told if count))


def _lanes_of(scene: LoggedScene) -> tuple[list[_Lane], int]:
    lanes, short, total = [], 0, 0.0
    for lane in scene.lanes:
        points = _without_repeats(lane.points)
        along = _arc_lengths(points)
        if along[-1] < _SHORTEST_M:
            short += 1
            continue
        total += float(along[-1])
        if total > _MOST_M:
            raise MapError(
                f"the lanes are longer than {_MOST_M:g} m together: a lane has wrong points, or "
                "the scene has to be cut into parts"
            )
        count = int(along[-1] / _SAMPLE_M) + 2
        at = np.arange(count) * (along[-1] / (count - 1))
        samples = np.stack([np.interp(at, along, points[:, k]) for k in range(3)], axis=1)
        start, end = _direction(points[0], points[1]), _direction(points[-2], points[-1])
        lanes.append(_Lane(lane, points, float(along[-1]), samples, start, end, [], []))
    return lanes, short


def _without_repeats(points: Numbers) -> Numbers:
    kept = [points[0]]
    for point in points[1:]:
        east, north = point[0] - kept[-1][0], point[1] - kept[-1][1]
        if east * east + north * north > _SAME_M * _SAME_M:
            kept.append(point)
    return np.array(kept)


def _arc_lengths(points: Numbers) -> Numbers:
    steps = np.diff(points[:, :2], axis=0)
    lengths = np.sqrt(steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1])
    return np.concatenate([[0.0], np.cumsum(lengths)])


def _direction(before: Numbers, after: Numbers) -> tuple[float, float]:
    cos, sin = cos_sin(atan2(float(after[1] - before[1]), float(after[0] - before[0])))
    return cos, sin


def _connect(lanes: Sequence[_Lane]) -> None:
    """Fill `before` and `after`, from the file or, if it states no exit, from the ends."""
    number = {lane.lane.name: k for k, lane in enumerate(lanes)}
    if any(lane.lane.exits for lane in lanes):
        pairs = [
            (k, number[name])
            for k, lane in enumerate(lanes)
            for name in dict.fromkeys(lane.lane.exits or ())
            if name in number and number[name] != k
        ]
    else:
        starts = np.array([lane.points[0] for lane in lanes])
        pairs = []
        for k, lane in enumerate(lanes):
            apart = starts - lane.points[-1]
            close = apart[:, 0] * apart[:, 0] + apart[:, 1] * apart[:, 1] < _JOIN_M * _JOIN_M
            close &= np.abs(apart[:, 2]) < _HEIGHT_M
            for other in np.flatnonzero(close).tolist():
                if other != k and _dot(lane.end, lanes[other].start) > _JOIN_COS:
                    pairs.append((k, other))
    for one, other in pairs:
        lanes[one].after.append(other)
        lanes[other].before.append(one)


def _dot(one: tuple[float, float], other: tuple[float, float]) -> float:
    return one[0] * other[0] + one[1] * other[1]


def _near_pairs(lanes: Sequence[_Lane]) -> dict[int, set[int]]:
    """Return pairs of lanes whose centre lines come close, except lanes that follow each other."""
    near: dict[int, set[int]] = defaultdict(set)
    boxes = np.array([lane.box for lane in lanes])
    for k, lane in enumerate(lanes):
        beside = (boxes[:, 0] <= boxes[k, 2] + _NEAR_M) & (boxes[k, 0] <= boxes[:, 2] + _NEAR_M)
        beside &= (boxes[:, 1] <= boxes[k, 3] + _NEAR_M) & (boxes[k, 1] <= boxes[:, 3] + _NEAR_M)
        for other in np.flatnonzero(beside).tolist():
            if other <= k or other in lane.after or other in lane.before:
                continue
            if _is_near(lane.samples, lanes[other].samples):
                near[k].add(other)
                near[other].add(k)
    return near


def _is_near(one: Numbers, other: Numbers) -> bool:
    for start in range(0, len(one), _BLOCK):
        part = one[start : start + _BLOCK]
        low, high = part.min(axis=0) - _HEIGHT_M, part.max(axis=0) + _HEIGHT_M
        near = other[((other >= low) & (other <= high)).all(axis=1)]
        east = part[:, None, 0] - near[None, :, 0]
        north = part[:, None, 1] - near[None, :, 1]
        level = np.abs(part[:, None, 2] - near[None, :, 2]) < _HEIGHT_M
        if (level & (east * east + north * north < _NEAR_M * _NEAR_M)).any():
            return True
    return False


def _inner_lanes(lanes: Sequence[_Lane], near: dict[int, set[int]]) -> set[int]:
    """Choose lanes as paths over junctions, one by one; those with most conflicts go first."""
    candidates = [
        k
        for k, lane in enumerate(lanes)
        if lane.before
        and lane.after
        and lane.length_m <= _INNER_M
        and (
            near[k]
            or any(len(lanes[other].after) > 1 for other in lane.before)
            or any(len(lanes[other].before) > 1 for other in lane.after)
        )
    ]
    candidates.sort(key=lambda k: (-len(near[k]), k))
    inner: set[int] = set()
    for k in candidates:
        ends = {*lanes[k].before, *lanes[k].after}
        if not ends & inner and k not in ends:
            inner.add(k)
    return inner


class _Sets:
    """Disjoint sets of numbers."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))

    def find(self, number: int) -> int:
        while self._parent[number] != number:
            self._parent[number] = self._parent[self._parent[number]]
            number = self._parent[number]
        return number

    def join(self, one: int, other: int) -> None:
        low, high = sorted((self.find(one), self.find(other)))
        self._parent[high] = low


class _Drawing:
    """The network's elements."""

    def __init__(self, lanes: Sequence[_Lane], inner: set[int], near: dict[int, set[int]]) -> None:
        self._lanes = lanes
        self._outer = [k for k in range(len(lanes)) if k not in inner]
        self._edges = _edges_of(lanes, self._outer)
        self._edge_of = {k: n for n, edge in enumerate(self._edges) for k in edge}
        self._movements = _movements_of(lanes, inner)
        self._nodes = self._nodes_of(near)
        self._leaving: dict[int, list[_Movement]] = defaultdict(list)
        for movement in self._movements:
            self._leaving[movement.source].append(movement)
        self.num_ruled = 0
        self._name = {k: f"{self._edge_id(n)}_{i}" for n, edge in enumerate(self._edges)
                      for i, k in enumerate(edge)}  # fmt: skip

    def text(self) -> str:
        """Return the file's content."""
        internals, edges, junctions, connections = [], [], [], []
        for n, edge in enumerate(self._edges):
            ends = f'from="J{self._node(n, 0)}" to="J{self._node(n, 1)}"'
            edges.append(f'<edge id="{self._edge_id(n)}" {ends} priority="1">')
            edges += [self._lane_text(self._name[k], i, k) for i, k in enumerate(edge)]
            edges.append("</edge>")
        for node, sources in self._sources().items():
            moves = [move for k in sources for move in self._leaving[k]]
            paths = {}
            for number, move in enumerate(moves):
                if move.inner < 0:
                    continue
                paths[number] = f":J{node}_{number}"
                internals += [
                    f'<edge id="{paths[number]}" function="internal">',
                    self._lane_text(f"{paths[number]}_0", 0, move.inner),
                    "</edge>",
                ]
            yields, foes = self._rights(moves)
            self.num_ruled += bool(yields.any())
            junctions += self._junction_text(node, sources, paths.values(), yields, foes)
            for number, move in enumerate(moves):
                state = "m" if yields[number].any() else "M"
                connections += self._connection_text(move, paths.get(number), state)
        body = "\n".join([*internals, *edges, *junctions, *connections])
        corners = np.concatenate([lane.points for lane in self._lanes])
        low, high = corners.min(axis=0), corners.max(axis=0)
        box = f"{low[0]:.2f},{low[1]:.2f},{high[0]:.2f},{high[1]:.2f}"
        return (
            '<net version="1.20">\n'
            f'<location netOffset="0.00,0.00" convBoundary="{box}" origBoundary="{box}" '
            f'projParameter="!"/>\n{body}\n</net>\n'
        )

    def _edge_id(self, number: int) -> str:
        return f"E{number}"

    def _lane_text(self, name: str, index: int, k: int) -> str:
        lane = self._lanes[k]
        speed = lane.lane.speed_mps or (FREEWAY_MPS if lane.lane.is_freeway else STREET_MPS)
        shape = " ".join(f"{x:.3f},{y:.3f},{z:.3f}" for x, y, z in lane.points.tolist())
        return (
            f'<lane id="{name}" index="{index}" speed="{speed:.2f}" length="{lane.length_m:.3f}" '
            f'width="{WIDTH_M}" shape="{shape}"><param key="origId" '
            f"value={quoteattr(lane.lane.name)}/></lane>"
        )

    def _nodes_of(self, near: dict[int, set[int]]) -> _Sets:
        """Join the ends of edges that meet; end 2 n is the start of edge n, 2 n + 1 its end."""
        nodes = _Sets(2 * len(self._edges))
        at: dict[int, int] = {}
        for move in self._movements:
            end = 2 * self._edge_of[move.source] + 1
            nodes.join(end, 2 * self._edge_of[move.target])
            if move.inner >= 0:
                at[move.inner] = end
        for k, end in at.items():
            for other in near[k]:
                if other in at:
                    nodes.join(end, at[other])
        return nodes

    def _node(self, edge: int, end: int) -> int:
        return self._nodes.find(2 * edge + end)

    def _sources(self) -> dict[int, list[int]]:
        """Return the lanes that end at each node."""
        found: dict[int, list[int]] = {}
        for n, edge in enumerate(self._edges):
            found.setdefault(self._node(n, 0), [])
            found.setdefault(self._node(n, 1), []).extend(edge)
        return found

    def _rights(self, moves: Sequence[_Movement]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return (n, n) whether a movement yields to another, and whether two are in conflict."""
        count = len(moves)
        yields = np.zeros((count, count), dtype=np.bool_)
        foes = np.zeros((count, count), dtype=np.bool_)
        ranks = ["srlt".index(self._turn(move)) for move in moves]
        for i in range(count):
            for j in range(i + 1, count):
                if moves[i].source == moves[j].source or not self._meet(moves[i], moves[j]):
                    continue
                foes[i, j] = foes[j, i] = True
                if ranks[i] != ranks[j]:
                    first = ranks[i] > ranks[j]
                else:
                    mine, theirs = (self._lanes[moves[k].source].end for k in (i, j))
                    first = mine[0] * theirs[1] - mine[1] * theirs[0] > 0.0
                yields[(i, j) if first else (j, i)] = True
        return yields, foes

    def _meet(self, one: _Movement, other: _Movement) -> bool:
        if one.target == other.target:
            return True
        if one.inner < 0 or other.inner < 0:
            return False
        return _is_near(self._lanes[one.inner].samples, self._lanes[other.inner].samples)

    def _turn(self, move: _Movement) -> str:
        """Return SUMO's letter of the direction: s, r, l or t."""
        before, after = self._lanes[move.source].end, self._lanes[move.target].start
        cross = before[0] * after[1] - before[1] * after[0]
        angle = atan2(cross, _dot(before, after))
        if abs(angle) < _STRAIGHT_RAD:
            return "s"
        if abs(angle) > _BACK_RAD:
            return "t"
        return "l" if angle > 0.0 else "r"

    def _junction_text(
        self,
        node: int,
        sources: Sequence[int],
        paths: Iterable[str],
        yields: NDArray[np.bool_],
        foes: NDArray[np.bool_],
    ) -> list[str]:
        ends = [self._lanes[k].points[-1] for k in sources] + [
            self._lanes[k].points[0] for k in self._outer if self._node(self._edge_of[k], 0) == node
        ]
        x, y, _ = (sum(axis) / len(ends) for axis in zip(*np.array(ends).tolist(), strict=True))
        kind = "priority" if len(yields) else "dead_end"
        lines = [
            f'<junction id="J{node}" type="{kind}" x="{x:.3f}" y="{y:.3f}" '
            f'incLanes="{" ".join(self._name[k] for k in sources)}" '
            f'intLanes="{" ".join(f"{path}_0" for path in paths)}">'
        ]
        for number in range(len(yields)):  # the lowest bit of a request is its last letter
            response, foe = (
                "".join("01"[int(bit)] for bit in reversed(row[number].tolist()))
                for row in (yields, foes)
            )
            lines.append(f'<request index="{number}" response="{response}" foes="{foe}" cont="0"/>')
        return [*lines, "</junction>"]

    def _connection_text(self, move: _Movement, path: str | None, state: str) -> list[str]:
        source, target = self._name[move.source], self._name[move.target]
        one, _, one_lane = source.rpartition("_")
        other, _, other_lane = target.rpartition("_")
        turn = self._turn(move)
        via = "" if path is None else f'via="{path}_0" '
        lines = [
            f'<connection from="{one}" to="{other}" fromLane="{one_lane}" toLane="{other_lane}" '
            f'{via}dir="{turn}" state="{state}"/>'
        ]
        if path is not None:
            lines.append(
                f'<connection from="{path}" to="{other}" fromLane="0" toLane="{other_lane}" '
                f'dir="{turn}" state="M"/>'
            )
        return lines


def _movements_of(lanes: Sequence[_Lane], inner: set[int]) -> list[_Movement]:
    """Return the connections between lanes that are not paths over junctions."""
    found: dict[tuple[int, int], _Movement] = {}
    for k, lane in enumerate(lanes):
        if k in inner:
            continue
        for other in lane.after:
            over = [(other, target) for target in lanes[other].after] if other in inner else []
            for path, target in over or [(-1, other)]:
                found.setdefault((k, target), _Movement(k, path, target))
    return list(found.values())


def _edges_of(lanes: Sequence[_Lane], outer: Sequence[int]) -> list[list[int]]:
    """Return the lanes of each edge, from the right to the left."""
    sets = _Sets(len(lanes))
    for place, one in enumerate(outer):
        for other in outer[place + 1 :]:
            if _are_beside(lanes[one], lanes[other]):
                sets.join(one, other)
    groups: dict[int, list[int]] = defaultdict(list)
    for k in outer:
        groups[sets.find(k)].append(k)
    return [_from_the_right(lanes, group) for group in groups.values()]


def _from_the_right(lanes: Sequence[_Lane], group: Sequence[int]) -> list[int]:
    return sorted(group, key=lambda k: _offset(lanes[group[0]], lanes[k], 0)[1])


def _are_beside(one: _Lane, other: _Lane) -> bool:
    if _dot(one.start, other.start) < _PARALLEL_COS or _dot(one.end, other.end) < _PARALLEL_COS:
        return False
    sides = [_offset(one, other, end) for end in (0, -1)]
    if sides[0][1] * sides[1][1] < 0.0:
        return False
    return all(
        abs(along) < _LEVEL_M and _BESIDE_M[0] < abs(across) < _BESIDE_M[1]
        for along, across in sides
    )


def _offset(one: _Lane, other: _Lane, end: int) -> tuple[float, float]:
    """Return how far another lane's end is ahead and to the left of a lane's end, in m."""
    cos, sin = one.start if end == 0 else one.end
    east, north = (other.points[end] - one.points[end])[:2].tolist()
    return east * cos + north * sin, north * cos - east * sin
