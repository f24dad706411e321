"""Who is near a border, and rows that change hands."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.kernels.borders import NEAR, find_near, pass_on
from cavmarl.roads.zones import ZonePartition
from cavmarl.shard.vehicles import VEHICLE
from tests.kernels.builders import vehicles
from tests.naive import zones as naive
from tests.partitions import four, partitions, places

MAX_SPEED_MPS = 60.0


@given(
    st.data(),
    partitions(),
    st.sampled_from([0.0, 2.0, 7.5]),
    st.sampled_from([0.1, 0.5]),
)
def test_who_has_crossed_or_soon_will_is_told_of(
    data: st.DataObject, partition: ZonePartition, hysteresis_m: float, ahead_s: float
) -> None:
    xy = data.draw(places(partition))
    zone = data.draw(st.integers(0, partition.count - 1))
    draw = np.random.default_rng(data.draw(st.integers(0, 1000)))
    headings = draw.uniform(-math.pi, math.pi, len(xy))
    rows = vehicles(
        [(x, y, heading) for (x, y), heading in zip(xy.tolist(), headings, strict=True)],
        speed=draw.uniform(0.0, MAX_SPEED_MPS, len(xy)),
    )
    out = np.zeros(2 * len(rows), dtype=NEAR)
    found = find_near(
        partition.arrays, zone, hysteresis_m, ahead_s, MAX_SPEED_MPS, rows, len(rows) - 1, out
    )
    told = [(int(e["row"]), int(e["target"]), bool(e["crossed"])) for e in out[:found]]
    expected = naive.near_borders(
        partition.reaching, zone, hysteresis_m, ahead_s, rows[: len(rows) - 1]
    )
    margins = _margins(partition, zone, hysteresis_m, ahead_s, rows)
    clear = {i for i, margin in enumerate(margins) if margin > 1e-6}  # squares round otherwise
    assert [e for e in told if e[0] in clear] == [e for e in expected if e[0] in clear]
    for entry in out[:found]:
        row = rows[entry["row"]]
        assert entry["vehicle"] == row["id"]
        depth_m = naive.distance(partition.reaching[zone], row["x"], row["y"])
        if depth_m == 0.0:
            target = partition.reaching[entry["target"]]
            depth_m = -naive.distance(target, row["x"], row["y"])
        assert entry["depth_m"] == pytest.approx(depth_m)


def _margins(
    partition: ZonePartition,
    zone: int,
    hysteresis_m: float,
    ahead_s: float,
    rows: NDArray[np.void],
) -> list[float]:
    """How far each vehicle is from where the answer changes."""
    rect = partition.reaching[zone]
    margins = []
    for row in rows:
        way = row["speed"] * ahead_s
        then = row["x"] + math.cos(row["heading"]) * way, row["y"] + math.sin(row["heading"]) * way
        margins.append(
            min(
                abs(naive.distance(rect, x, y) - hysteresis_m)
                for x, y in ((row["x"], row["y"]), then)
            )
        )
    return margins


def test_who_drives_over_a_corner_is_told_to_both_zones() -> None:
    partition = four()
    row = vehicles([(13.0, 12.0, math.pi / 2)], speed=10.0)  # of zone 0, 3 m to the east of it
    out = np.zeros(2, dtype=NEAR)
    assert find_near(partition.arrays, 0, 2.0, 1.0, MAX_SPEED_MPS, row, 1, out) == 2
    assert out["target"].tolist() == [1, 3]
    assert out["crossed"].tolist() == [True, False]


def shards() -> tuple[NDArray[np.void], NDArray[np.void], list[NDArray[np.int64]]]:
    """Two zones of one world with three and two vehicles, which see each other's."""
    mine, theirs = np.zeros((1, 6), VEHICLE), np.zeros((1, 6), VEHICLE)
    mine["id"][0, :5] = [10, 11, 12, 21, 20]
    theirs["id"][0, :5] = [20, 21, 12, 10, 11]
    counts = [np.array([3]), np.array([2]), np.array([5])]
    return mine, theirs, counts


@pytest.mark.parametrize("hint", [0, 1, 2, 4, 99])
@pytest.mark.parametrize("vehicle", [10, 11, 12])
def test_who_is_passed_on_is_a_ghost_here_and_owned_there(vehicle: int, hint: int) -> None:
    mine, theirs, (owned, their_owned, their_rows) = shards()
    place = pass_on(
        vehicle, mine, owned, hint, theirs, their_owned, their_rows, 0, np.zeros(1, VEHICLE)
    )
    assert (place, owned[0], their_owned[0], their_rows[0]) == (2, 2, 3, 5)
    assert theirs["id"][0, place] == vehicle
    assert set(theirs["id"][0, :2]) == {20, 21}
    assert set(theirs["id"][0, 3:5]) == {10, 11, 12} - {vehicle}
    assert set(mine["id"][0, :2]) == {10, 11, 12} - {vehicle}
    assert set(mine["id"][0, 2:5]) == {vehicle, 20, 21}


@pytest.mark.parametrize(("vehicle", "why"), [(20, -1), (99, -1), (13, -2)])
def test_nobody_is_passed_on_who_is_not_owned_or_has_no_ghost(vehicle: int, why: int) -> None:
    mine, theirs, (owned, their_owned, their_rows) = shards()
    mine["id"][0, 1] = 13  # whom the other zone has not seen
    before = mine.copy(), theirs.copy()
    spare = np.zeros(1, VEHICLE)
    assert pass_on(vehicle, mine, owned, 0, theirs, their_owned, their_rows, 0, spare) == why
    assert (owned[0], their_owned[0]) == (3, 2)
    assert (mine == before[0]).all()
    assert (theirs == before[1]).all()
