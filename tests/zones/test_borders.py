"""Search for vehicles near a border; transfer of a vehicle's row to another zone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.arrays import ZoneState
from cavmarl.shards.shard import make_zone_state
from cavmarl.zones.kernels.borders import NEAR, Borders, find_near, pass_on
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.naive import zones as naive
from tests.support.builders import vehicles
from tests.support.partitions import four, partitions, places
from tests.support.zoned import SIDE, exchanged

MAX_SPEED_MPS = 60.0
BORDERS = Borders(2.0, 1.0, MAX_SPEED_MPS)


@given(
    st.data(),
    partitions(),
    st.sampled_from([0.0, 2.0, 7.5]),
    st.sampled_from([0.1, 0.5]),
    st.booleans(),
)
def test_crossed_and_approaching_vehicles_are_found(
    data: st.DataObject,
    partition: ZonePartition,
    hysteresis_m: float,
    ahead_s: float,
    check_all: bool,
) -> None:
    draw = np.random.default_rng(data.draw(st.integers(0, 1000)))
    parts = []
    for zone in range(partition.count):
        xy = data.draw(places(partition, size=4))
        headings = draw.uniform(-math.pi, math.pi, len(xy))
        rows = vehicles(
            [(x, y, heading) for (x, y), heading in zip(xy.tolist(), headings, strict=True)],
            speed=draw.uniform(0.0, MAX_SPEED_MPS, len(xy)),
            id=100 * zone + np.arange(len(xy)),
        )
        parts.append(rows)
    reach_m = MAX_SPEED_MPS * ahead_s  # longest distance that a vehicle drives in `ahead_s`
    borders = Borders(hysteresis_m, ahead_s, MAX_SPEED_MPS)
    zoned = exchanged(partition, reach_m, parts, borders=borders)
    if check_all:
        zoned.num_border[:] = 0
    out = np.zeros(2 * zoned.rows.shape[-1] * partition.count, dtype=NEAR)
    found = find_near(partition.arrays, borders, zoned, SIDE, 0, check_all, out)
    for zone, rows in enumerate(parts):
        told = [
            (int(e["row"]), int(e["target"]), bool(e["crossed"]))
            for e in out[:found]
            if e["source"] == zone
        ]
        expected = naive.near_borders(partition.reaching, zone, hysteresis_m, ahead_s, rows)
        margins = _margins(partition, zone, hysteresis_m, ahead_s, rows)
        # The kernel compares squared distances, so rounding may change a result near a limit.
        clear = {i for i, margin in enumerate(margins) if margin > 1e-6}
        assert [e for e in told if e[0] in clear] == [e for e in expected if e[0] in clear]
    for entry in out[:found]:
        row = parts[entry["source"]][entry["row"]]
        assert entry["vehicle"] == row["id"]
        depth_m = naive.distance(partition.reaching[entry["source"]], row["x"], row["y"])
        if depth_m * depth_m == 0.0:  # the kernel squares the depth, and the square underflows
            target = partition.reaching[entry["target"]]
            depth_m = -naive.distance(target, row["x"], row["y"])
        assert entry["depth_m"] == pytest.approx(depth_m)


def _margins(
    partition: ZonePartition, zone: int, hysteresis_m: float, ahead_s: float, rows: NDArray[np.void]
) -> list[float]:
    """Return how close each vehicle's depth, now or after `ahead_s`, is to the hysteresis."""
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


def test_a_vehicle_near_a_corner_is_found_for_both_adjacent_zones() -> None:
    partition = four()
    row = vehicles([(13.0, 12.0, math.pi / 2)], speed=10.0)  # 3 m to the east of zone 0
    none = row[:0]
    zoned = exchanged(partition, 60.0, [row, none, none, none], borders=BORDERS)
    out = np.zeros(2, dtype=NEAR)
    found = find_near(partition.arrays, BORDERS, zoned, SIDE, 0, False, out)
    assert found == 2
    assert out["target"].tolist() == [1, 3]
    assert out["crossed"].tolist() == [True, False]


def test_removed_rows_are_ignored() -> None:
    partition = four()
    rows = vehicles([(13.0, 12.0, 0.0), (13.0, 12.0, 0.0)])
    none = rows[:0]
    zoned = exchanged(partition, 60.0, [rows, none, none, none], borders=BORDERS)
    zoned.num_owned[0, 0] = 1
    out = np.zeros(4, dtype=NEAR)
    found = find_near(partition.arrays, BORDERS, zoned, SIDE, 0, False, out)
    assert out["row"][:found].tolist() == [0]


def two_zones() -> ZoneState:
    """Return two zones with three and two vehicles, and ghosts of each other's vehicles."""
    zoned = make_zone_state(2, 1, 6)
    zoned.rows["id"][SIDE, 0, 0, :5] = [10, 11, 12, 21, 20]
    zoned.rows["id"][SIDE, 1, 0, :5] = [20, 21, 12, 10, 11]
    zoned.num_owned[:, 0] = [3, 2]
    zoned.num_rows[:, 0] = 5
    return zoned


def ids(zoned: ZoneState, zone: int, first: int, last: int) -> set[int]:
    return set(zoned.rows["id"][SIDE, zone, 0, first:last].tolist())


@pytest.mark.parametrize("hint", [0, 1, 2, 4, 99])
@pytest.mark.parametrize("vehicle", [10, 11, 12])
def test_a_handed_over_vehicle_is_owned_by_the_target_and_a_ghost_at_the_source(
    vehicle: int, hint: int
) -> None:
    zoned = two_zones()
    assert pass_on(vehicle, 0, hint, 1, 5, zoned, SIDE, 0) == 2
    assert zoned.num_owned[:, 0].tolist() == [2, 3]
    assert zoned.num_rows[:, 0].tolist() == [5, 5]
    assert ids(zoned, 1, 2, 3) == {vehicle}
    assert ids(zoned, 1, 0, 2) == {20, 21}
    assert ids(zoned, 1, 3, 5) == {10, 11, 12} - {vehicle}
    assert ids(zoned, 0, 0, 2) == {10, 11, 12} - {vehicle}
    assert ids(zoned, 0, 2, 5) == {vehicle, 20, 21}


@pytest.mark.parametrize(("vehicle", "why"), [(20, -1), (99, -1), (13, -2)])
def test_a_vehicle_without_owner_or_ghost_is_not_handed_over(vehicle: int, why: int) -> None:
    zoned = two_zones()
    zoned.rows["id"][SIDE, 0, 0, 1] = 13  # a vehicle without a ghost in the other zone
    before = zoned.rows.copy()
    assert pass_on(vehicle, 0, 0, 1, 5, zoned, SIDE, 0) == why
    assert zoned.num_owned[:, 0].tolist() == [3, 2]
    assert (zoned.rows == before).all()
