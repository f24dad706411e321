from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.core.errors import ConfigError
from cavmarl.zones.kernels.zone_lookup import zone_of
from cavmarl.zones.partition.zone_partition import Neighbor, ZonePartition
from tests.naive import zones as naive
from tests.support.partitions import BOUNDS, PINWHEEL, four, partitions, places


@given(st.data(), partitions())
@settings(deadline=None, max_examples=50)
def test_each_place_is_in_one_zone(data: st.DataObject, partition: ZonePartition) -> None:
    xy = data.draw(places(partition))
    for (x, y), zone in zip(xy, partition.zones_of(xy), strict=True):
        assert naive.owners(partition.reaching, x, y) == [zone] == [zone_of(partition.arrays, x, y)]


def test_a_single_zone_contains_all_points() -> None:
    one = ZonePartition(BOUNDS, np.array([BOUNDS]))
    assert zone_of(one.arrays, 1e9, -1e9) == 0
    assert one.neighbors == ((),)


def test_an_empty_array_of_positions_gives_an_empty_array_of_zones() -> None:
    assert four().zones_of(np.empty((0, 2))).tolist() == []


def test_neighbors_touch_along_a_side_or_at_a_corner() -> None:
    assert four().neighbors[0] == (Neighbor(1, False), Neighbor(2, False), Neighbor(3, True))
    assert four().side_neighbors == ((1, 2), (0, 3), (0, 3), (1, 2))
    assert [[other.zone for other in row] for row in PINWHEEL.neighbors] == [
        [1, 3, 4], [0, 2, 4], [1, 3, 4], [0, 2, 4], [0, 1, 2, 3]
    ]  # fmt: skip
    assert not any(other.corner for row in PINWHEEL.neighbors for other in row)


@given(partitions())
@settings(deadline=None, max_examples=30)
def test_neighbors_are_mutual(partition: ZonePartition) -> None:
    for zone, row in enumerate(partition.neighbors):
        for other in row:
            assert Neighbor(zone, other.corner) in partition.neighbors[other.zone]


def test_the_hash_depends_only_on_the_cuts() -> None:
    plain = four()
    assert plain.content_hash == four().content_hash
    assert plain.content_hash != four(np.nextafter(10.0, 11.0)).content_hash
    assert plain.content_hash != ZonePartition(BOUNDS, plain.rects[::-1]).content_hash
    # The bounds that were cut do not change which zone owns a point.
    wider = np.where(plain.rects == -40.0, -45.0, plain.rects)
    assert plain.content_hash == ZonePartition((-45.0, *BOUNDS[1:]), wider).content_hash
    assert four(0.0).content_hash == four(-0.0).content_hash


def test_the_arrays_of_a_partition_are_read_only() -> None:
    for array in (four().rects, four().reaching, four().arrays.cells):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((0, 2, 11.0), r"zones 0 and 1 overlap in x 10 to 11, y -30 to 20; make one"),
        ((0, 2, 9.0), r"no zone covers x 9 to 10, y -30 to 20"),
        ((1, 2, 61.0), r"zone 1: .* exceeds bounds_m"),
        ((1, 2, 10.0), r"zone 1: .* is empty"),
        ((3, 0, np.nan), r"zone 3: .* must be finite"),
        ((3, 3, np.inf), r"zone 3: .* must be finite"),
    ],
)
def test_an_invalid_division_is_refused(change: tuple[int, int, float], words: str) -> None:
    zone, side, value = change
    rects = four().rects.copy()
    rects[zone, side] = value
    with pytest.raises(ConfigError, match=words):
        ZonePartition(BOUNDS, rects)


def test_invalid_bounds_are_refused() -> None:
    with pytest.raises(ConfigError, match="there are no zones"):
        ZonePartition(BOUNDS, np.empty((0, 4)))
    with pytest.raises(ConfigError, match=r"bounds_m: .* must be finite"):
        ZonePartition((-np.inf, *BOUNDS[1:]), four().rects)
    with pytest.raises(ConfigError, match="no zone reaches max_x = 70 of bounds_m"):
        ZonePartition((*BOUNDS[:2], 70.0, BOUNDS[3]), four().rects)
