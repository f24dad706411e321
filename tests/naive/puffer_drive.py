"""pufferlib's observation of `drive`, in the order of its description; places from the corner."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Line = tuple[NDArray[np.float32], int]


def around(side: int) -> list[tuple[int, int]]:
    """The cells of a square, ring by ring, each from its lower right corner upwards."""
    cells = [(0, 0)]
    for r in range(1, side // 2 + 1):
        cells += [(r, j) for j in range(1 - r, r + 1)]
        cells += [(i, r) for i in range(r - 1, -r - 1, -1)]
        cells += [(-r, j) for j in range(r - 1, -r - 1, -1)]
        cells += [(i, -r) for i in range(1 - r, r + 1)]
    return cells


def segments_seen(lines: Sequence[Line], x: float, y: float, most: int) -> list[tuple[int, int]]:
    """(line, segment) of what is seen from a place."""
    far_x = max(float(line[:, 0].max()) for line, _ in lines)
    far_y = max(float(line[:, 1].max()) for line, _ in lines)
    cells = defaultdict(list)
    for number, (line, _) in enumerate(lines):
        for k in range(len(line) - 1):
            middle = (line[k] + line[k + 1]) / np.float32(2.0)
            cell = (int(middle[0] / np.float32(5.0)), int(middle[1] / np.float32(5.0)))
            inside = cell[0] < math.ceil(far_x / 5.0) and cell[1] < math.ceil(far_y / 5.0)
            if inside and len(cells[cell]) < 10:
                cells[cell].append((number, k))
    own = (math.floor(np.float32(x) / np.float32(5.0)), math.floor(np.float32(y) / np.float32(5.0)))
    if not (0 <= own[0] < math.ceil(far_x / 5.0) and 0 <= own[1] < math.ceil(far_y / 5.0)):
        return []
    seen = [segment for i, j in around(21) for segment in cells.get((own[0] + i, own[1] + j), ())]
    return seen[:most]


def partners_seen(rows: NDArray[np.void], i: int, most: int) -> list[int]:
    """Rows of the others within 50 m on the level, by id."""
    near = [
        k
        for k, other in enumerate(rows)
        if k != i
        and (other["x"] - rows[i]["x"]) * (other["x"] - rows[i]["x"])
        + (other["y"] - rows[i]["y"]) * (other["y"] - rows[i]["y"])
        <= 2500.0
        and abs(other["z"] - rows[i]["z"]) <= 4.0
    ]
    return sorted(near, key=lambda k: int(rows[k]["id"]))[:most]


def observe(
    rows: NDArray[np.void],
    i: int,
    goal: tuple[float, float],
    lines: Sequence[Line],
    corner: tuple[float, float],
    partners: int,
    segments: int,
) -> list[float]:
    """All numbers of one vehicle."""
    me = rows[i]

    def ahead(x: float, y: float) -> tuple[float, float]:
        distance, angle = math.hypot(x, y), math.atan2(y, x) - me["heading"]
        return distance * math.cos(angle), distance * math.sin(angle)

    goal_x, goal_y = ahead(goal[0] - me["x"], goal[1] - me["y"])
    collided = float(me["events"] & 1)
    out = [goal_x / 200.0, goal_y / 200.0, abs(me["speed"]) / 100.0]
    out += [me["width"] / 15.0, me["length"] / 30.0, collided]
    shown = partners_seen(rows, i, partners)
    for k in shown:
        other = rows[k]
        x, y = ahead(other["x"] - me["x"], other["y"] - me["y"])
        turn = other["heading"] - me["heading"]
        out += [x / 50.0, y / 50.0, other["width"] / 15.0, other["length"] / 30.0]
        out += [math.cos(turn), math.sin(turn), abs(other["speed"]) / 100.0]
    out += [0.0] * 7 * (partners - len(shown))
    seen = segments_seen(lines, me["x"] - corner[0], me["y"] - corner[1], segments)
    for number, k in seen:
        line, kind = lines[number]
        middle_x, middle_y = ((line[k] + line[k + 1]) / np.float32(2.0)).tolist()
        end_x, end_y = line[k + 1].tolist()
        x, y = ahead(middle_x + corner[0] - me["x"], middle_y + corner[1] - me["y"])
        half = math.hypot(end_x - middle_x, end_y - middle_y)
        dir_x, dir_y = ahead((end_x - middle_x) / half, (end_y - middle_y) / half)
        out += [x / 50.0, y / 50.0, half / 100.0, 0.001, dir_x, dir_y, float(kind)]
    return out + [0.0] * 7 * (segments - len(seen))
