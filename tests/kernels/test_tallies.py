from __future__ import annotations

import numpy as np
import pytest

from cavmarl.kernels.tallies import begins_second, count_tick, totals


@pytest.mark.parametrize(("ticks", "expected"), [([3, 7], False), ([3, 20], True), ([0, 1], True)])
def test_a_second_begins_in_some_world(ticks: list[int], expected: bool) -> None:
    assert begins_second(np.array(ticks), 10) == expected


def test_ticks_are_counted() -> None:
    ticks = np.array([0, 41])
    count_tick(ticks)
    assert ticks.tolist() == [1, 42]


def test_totals_are_sums_over_zones() -> None:
    counts = np.random.default_rng(0).integers(0, 99, (4, 3))
    out = np.full(3, -1)
    totals(counts, out)
    np.testing.assert_array_equal(out, counts.sum(axis=0))
