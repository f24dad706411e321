from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.ownership.distances import needed_overlap_m
from cavmarl.ownership.limits import Limits
from cavmarl.zones.kernels.zone_lookup import squared_distance, zone_of, zones_of
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.naive import zones as naive
from tests.support.builders import vehicles
from tests.support.partitions import PINWHEEL, four, partitions, places
from tests.support.zoned import exchanged, ghosts_of

HALOS = [0.0, 1.0, 7.5, 30.0, 1000.0]


def cars(xy: NDArray[np.float64]) -> NDArray[np.void]:
    return vehicles([(x, y, 0.0) for x, y in xy.tolist()])


def ghosts(
    partition: ZonePartition, halo_m: float, rows: NDArray[np.void], zone: int
) -> list[list[int]]:
    """Return for each zone the ghosts that it gets, if `zone` owns all rows."""
    rows = rows.copy()
    rows["id"] = np.arange(len(rows))
    parts = [rows if own == zone else rows[:0] for own in range(partition.count)]
    zoned = exchanged(partition, halo_m, parts)
    return [sorted(ghosts_of(zoned, other)["id"].tolist()) for other in range(partition.count)]


@given(st.data(), partitions())
def test_each_point_is_in_exactly_one_zone(data: st.DataObject, partition: ZonePartition) -> None:
    xy = data.draw(places(partition))
    rows = cars(xy)
    out = np.full(len(rows), -7, np.int32)
    zones_of(partition.arrays, rows, len(rows), out)
    for (x, y), zone in zip(xy.tolist(), out.tolist(), strict=True):
        assert naive.owners(partition.reaching, x, y) == [zone]
        assert zone_of(partition.arrays, x, y) == zone


@pytest.mark.parametrize(
    ("x", "y", "zone"),
    [
        (10.0, 20.0, 3),  # the four-corner point
        (math.nextafter(10.0, 0.0), 20.0, 2),
        (10.0, math.nextafter(20.0, 0.0), 1),
        (math.nextafter(10.0, 0.0), math.nextafter(20.0, 0.0), 0),
        (-1e9, 20.0, 2),
        (10.0, -1e9, 1),
        (math.nan, 0.0, 0),
    ],
)
def test_a_corner_belongs_to_the_zone_that_begins_there(x: float, y: float, zone: int) -> None:
    assert zone_of(four().arrays, x, y) == zone


@given(st.data(), partitions())
def test_the_distance_to_a_zone_equals_the_twin(
    data: st.DataObject, partition: ZonePartition
) -> None:
    for x, y in data.draw(places(partition)).tolist():
        for zone, rect in enumerate(partition.reaching):
            squared = squared_distance(partition.reaching, zone, x, y)
            assert math.sqrt(squared) == pytest.approx(naive.distance(rect, x, y), rel=1e-12)


@given(st.data(), partitions(), st.sampled_from(HALOS))
def test_published_ghosts_equal_the_twin(
    data: st.DataObject, partition: ZonePartition, halo_m: float
) -> None:
    # Positions may be outside of the zone, because a transfer may be late.
    xy = data.draw(places(partition))
    zone = data.draw(st.integers(0, partition.count - 1))
    expected = naive.published(partition.reaching, halo_m, xy, zone)
    assert ghosts(partition, halo_m, cars(xy), zone) == expected


def test_ghosts_reach_across_narrow_zones_and_corners() -> None:
    strips = ZonePartition(
        (0.0, 0.0, 100.0, 10.0),
        np.array([[0, 0, 49, 10], [49, 0, 51, 10], [51, 0, 100, 10]], dtype=np.float64),
    )
    # A ghost reaches across a zone that is 2 m wide.
    assert ghosts(strips, 5.0, cars(np.array([[48.0, 5.0], [40.0, 5.0]])), 0) == [[], [0], [0]]
    # A ghost reaches across a corner: at 3 m in x and 4 m in y, the distance is 5 m.
    car = cars(np.array([[7.0, 16.0]]))
    assert ghosts(four(), 5.0, car, 0) == [[], [0], [0], [0]]
    assert ghosts(four(), 4.9, car, 0) == [[], [0], [0], []]
    # The vehicle is outside of the zone that owns it, because a transfer is late.
    assert ghosts(PINWHEEL, 1.0, cars(np.array([[15.0, 15.0]])), 0) == [[], [], [], [], [0]]


@given(st.data(), partitions(), st.sampled_from([0.0, 3.0, 25.0]), st.sampled_from([0, 2]))
def test_a_zone_has_ghosts_of_all_vehicles_within_reach_of_its_own_vehicles(
    data: st.DataObject, partition: ZonePartition, reach_m: float, deferred: int
) -> None:
    halo_m = needed_overlap_m(reach_m, 2.0, Limits(deferral=deferred), 50.0, 0.1) + 1e-6
    drift_m = 2.0 + (deferred + 1) * 5.0
    places_then = data.draw(places(partition))
    owners = partition.zones_of(places_then)
    # Move each vehicle as far as it can get until its owner changes.
    headings = data.draw(st.lists(st.floats(0.0, 6.3), min_size=len(owners), max_size=len(owners)))
    now = places_then + drift_m * np.stack([np.cos(headings), np.sin(headings)], axis=1) * (
        1 - 1e-12
    )
    needed = {zone: set[int]() for zone in range(partition.count)}
    for zone in range(partition.count):
        own = np.flatnonzero(owners == zone)
        for other, rows in enumerate(ghosts(partition, halo_m, cars(now[own]), zone)):
            needed[other] |= set(own[rows].tolist())
    for a in range(len(now)):
        for b in range(len(now)):
            apart = now[a] - now[b]
            if owners[a] != owners[b] and apart[0] ** 2 + apart[1] ** 2 <= reach_m * reach_m:
                assert b in needed[int(owners[a])]


@given(partitions(), st.tuples(st.floats(-40, 60), st.floats(-30, 50)), st.floats(0.0, 6.3))
def test_the_distance_to_a_zone_is_at_most_the_distance_to_its_vehicles(
    partition: ZonePartition, here: tuple[float, float], angle: float
) -> None:
    # No margin is needed: both sides square the same differences.
    there = (here[0] + 13.0 * math.cos(angle), here[1] + 13.0 * math.sin(angle))
    dx, dy = there[0] - here[0], there[1] - here[1]
    zone = zone_of(partition.arrays, *here)
    assert squared_distance(partition.reaching, zone, *there) <= dx * dx + dy * dy
