from __future__ import annotations

import math
from itertools import pairwise

import pytest

from cavmarl.errors import ZoneError
from cavmarl.roads.zone_coverage import Coverage, zone_halo
from tests.partitions import PINWHEEL, four


def coverage(**changes: float) -> Coverage:
    values = {
        "reach_m": 100.0, "hysteresis_m": 2.0, "max_deferred_ticks": 2, "max_speed_mps": 50.0,
        "sim_dt_s": 0.05,
    } | changes  # fmt: skip
    return Coverage(**values)  # type: ignore[arg-type]


def test_the_halo_is_reach_hysteresis_and_the_way_of_late_ticks() -> None:
    assert coverage().halo_m == pytest.approx(100.0 + 2.0 + 3 * 2.5, abs=1e-5)
    assert coverage().halo_m > 109.5


def test_the_farthest_reach_counts() -> None:
    rest = {
        "hysteresis_m": 0.0, "max_deferred_ticks": 0, "max_speed_mps": 0.0, "sim_dt_s": 0.05
    }  # fmt: skip
    assert Coverage.of([30.0, 80.0, 0.0], **rest).reach_m == 80.0  # type: ignore[arg-type]
    assert Coverage.of([], **rest).reach_m == 0.0  # type: ignore[arg-type]


def test_a_halo_that_is_too_narrow_is_refused_with_the_numbers() -> None:
    coverage().check(coverage().halo_m)
    coverage().check(500.0)
    words = r"109 m is too narrow .*100 m .*2 m .*\(2 \+ 1\) ticks .*50 m/s .*0\.05 s need 109\.5"
    with pytest.raises(ZoneError, match=words):
        coverage().check(109.0)
    with pytest.raises(ZoneError, match="too narrow"):
        coverage().check(math.nan)


@pytest.mark.parametrize("name", ["reach_m", "hysteresis_m", "max_speed_mps", "sim_dt_s"])
@pytest.mark.parametrize("value", [-1.0, math.inf, math.nan])
def test_only_finite_numbers_from_0_are_taken(name: str, value: float) -> None:
    with pytest.raises(ZoneError, match=rf"{name} = .*must be a finite number from 0"):
        coverage(**{name: value})


@pytest.mark.parametrize("value", [-1.0, math.inf, math.nan])
def test_a_halo_is_a_finite_number_from_0(value: float) -> None:
    with pytest.raises(ZoneError, match="halo_m = "):
        zone_halo(four(), value)


def test_near_zones_are_those_within_the_halo() -> None:
    def near(halo_m: float) -> list[list[int]]:
        halo = zone_halo(PINWHEEL, halo_m)
        return [halo.near[a:b].tolist() for a, b in pairwise(halo.near_start)]

    assert near(0.0) == [[0, 1, 3, 4], [0, 1, 2, 4], [1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 2, 3, 4]]
    assert near(9.9) == near(0.0)
    assert near(10.0) == [[0, 1, 2, 3, 4]] * 5


def test_the_inner_part_is_out_of_others_halos() -> None:
    halo = zone_halo(PINWHEEL, 3.0)
    assert halo.inner[4] == pytest.approx([13.0, 13.0, 17.0, 17.0])
    assert halo.inner[0].tolist()[:2] == [-math.inf, -math.inf]
    assert (halo.inner[4][:2] > 13.0).all()
    assert (halo.inner[4][2:] < 17.0).all()
