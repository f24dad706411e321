from __future__ import annotations

import math
from itertools import pairwise

import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.zones.partition.zone_halo import zone_halo
from tests.support.partitions import PINWHEEL, four


@pytest.mark.parametrize("value", [-1.0, math.inf, math.nan])
def test_a_negative_or_infinite_halo_is_refused(value: float) -> None:
    with pytest.raises(ConfigError, match="halo_m = "):
        zone_halo(four(), value)


def test_near_zones_are_those_within_the_halo() -> None:
    def near(halo_m: float) -> list[list[int]]:
        halo = zone_halo(PINWHEEL, halo_m)
        return [halo.near[a:b].tolist() for a, b in pairwise(halo.near_start)]

    assert near(0.0) == [[0, 1, 3, 4], [0, 1, 2, 4], [1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 2, 3, 4]]
    assert near(9.9) == near(0.0)
    assert near(10.0) == [[0, 1, 2, 3, 4]] * 5


def test_the_inner_part_of_a_zone_is_outside_of_the_halos_of_other_zones() -> None:
    halo = zone_halo(PINWHEEL, 3.0)
    assert halo.inner[4] == pytest.approx([13.0, 13.0, 17.0, 17.0])
    assert halo.inner[0].tolist()[:2] == [-math.inf, -math.inf]
    assert (halo.inner[4][:2] > 13.0).all()
    assert (halo.inner[4][2:] < 17.0).all()
