from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.math.counters import begins_second, count_tick, occasions, totals


@pytest.mark.parametrize(("ticks", "expected"), [([3, 7], False), ([3, 20], True), ([0, 1], True)])
def test_begins_second_is_true_if_a_second_begins_in_any_world(
    ticks: list[int], expected: bool
) -> None:
    assert begins_second(np.array(ticks), 10) == expected


@pytest.mark.parametrize("tick", [4, 20])
@pytest.mark.parametrize("through", [[[0, 0], [0, 0]], [[0, 0], [3, 0]]])
def test_occasions_report_begun_seconds_and_arrived_vehicles(
    tick: int, through: list[list[int]]
) -> None:
    found = occasions(np.array([tick, 7]), 10, np.array(through))
    assert found == (tick == 20, bool(np.any(through)))


def test_count_tick_adds_one_in_each_world() -> None:
    ticks = np.array([0, 41])
    count_tick(ticks)
    assert ticks.tolist() == [1, 42]


def test_totals_are_sums_over_zones() -> None:
    counts = np.random.default_rng(0).integers(0, 99, (4, 3))
    out = np.full(3, -1)
    totals(counts, out)
    np.testing.assert_array_equal(out, counts.sum(axis=0))
