"""`sensors.neighbors.through_walls`: a house on the line of sight hides a vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import cavmarl
from cavmarl.engine.spaces import observation_parts

COUNT, RANGE_M = 6, 80.0
# Extents of the houses of blind_junction in m, in x and in y.
HOUSES_X, HOUSES_Y = [(-60.0, -5.0), (5.0, 60.0)], [(-60.0, -4.0), (4.0, 60.0)]


def seen_from(through_walls: bool, steps: int, **keywords: Any) -> Any:
    vec = cavmarl.make_vec(
        "blind_junction",
        overrides={
            "sensors.neighbors.count": COUNT,
            "sensors.neighbors.range_m": RANGE_M,
            "sensors.neighbors.through_walls": through_walls,
            "observation.kind": "flat",
        },
        **keywords,
    )
    vec.reset(seed=5)
    for _ in range(steps):
        observations, *_ = vec.step(vec.suggest_actions())
        yield observations, vec


def blocked(x: float, y: float, to_x: float, to_y: float) -> bool:
    """Return whether one of 401 points of the line of sight is inside a house."""
    share = np.linspace(0.0, 1.0, 401)
    px, py = x + share * (to_x - x), y + share * (to_y - y)
    inside = np.zeros(len(share), dtype=bool)
    for left, right in HOUSES_X:
        for low, high in HOUSES_Y:
            inside |= (px > left) & (px < right) & (py > low) & (py < high)
    return bool(inside.any())


def expected(rows: NDArray[np.void], me: np.void) -> list[tuple[float, float]]:
    apart = np.hypot(rows["x"] - me["x"], rows["y"] - me["y"])
    order = sorted(range(len(rows)), key=lambda i: (apart[i] ** 2, int(rows["id"][i])))
    seen = [
        (float(rows["x"][i]), float(rows["y"][i]))
        for i in order
        if rows["id"][i] != me["id"]
        and apart[i] <= RANGE_M
        and not blocked(me["x"], me["y"], rows["x"][i], rows["y"][i])
    ]
    return seen[:COUNT]


def test_vehicles_behind_a_house_are_hidden() -> None:
    hidden = 0
    for k, (observations, vec) in enumerate(seen_from(False, 60)):
        if k % 15:
            continue
        place = vec_part(vec)
        rows = vec.worlds.simulation.vehicles(0)
        for me in rows[rows["agent"] >= 0]:
            found = observations[0, me["agent"]][place].reshape(COUNT, -1)
            wanted = expected(rows, me)
            assert int(found[:, 0].sum()) == len(wanted)
            cos, sin = np.cos(me["heading"]), np.sin(me["heading"])
            for told, (x, y) in zip(found, wanted, strict=False):
                ahead = ((x - me["x"]) * cos + (y - me["y"]) * sin) / RANGE_M
                assert abs(told[1] - ahead) < 1e-5
            near = np.hypot(rows["x"] - me["x"], rows["y"] - me["y"]) <= RANGE_M
            hidden += int(near.sum()) - 1 > len(wanted) and len(wanted) < COUNT
    assert hidden > 0


def test_zones_change_no_result() -> None:
    whole = [seen.tobytes() for seen, _ in seen_from(False, 40)]
    assert whole == [seen.tobytes() for seen, _ in seen_from(False, 40, zones=2)]


def vec_part(vec: Any) -> slice:
    return observation_parts(vec.config.sensors)["neighbors"].place
