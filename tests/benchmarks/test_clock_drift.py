"""Clock drift of followers, as in Table II of the paper in docs/explanation/papers.md.

An own tick is a tick that a follower requests although another caller is the time master.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from benchmarks.carla_clock_client import is_due
from benchmarks.clock_drift import ClockDrift, measure_drift, rows_of, write_rows
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.time_master import OwnTicks


def test_the_table_of_the_paper_is_computed_from_raw_ticks() -> None:
    share = Fraction("0.92")
    master = list(range(5001))
    follower = [40 + step + int(step * share) for step in master]
    rows = rows_of(master, follower, 0.05)
    assert [row.step for row in rows] == [100, 500, 1000, 5000]
    assert [round(row.delta_s, 9) for row in rows] == [4.6, 23.0, 46.0, 230.0]
    assert [row.master_s for row in rows] == [5.0, 25.0, 50.0, 250.0]
    assert {row.ratio for row in rows} == {1.92}
    assert rows[-1].follower_s == pytest.approx(482.0)


def test_the_table_has_the_steps_of_the_paper_and_the_last_step() -> None:
    random = np.random.default_rng(0)
    master, follower = (np.cumsum(random.integers(1, 9, 1001)).tolist() for _ in range(2))
    for last, steps in ((100, [100]), (101, [100, 101]), (7, [7]), (1000, [100, 500, 1000])):
        rows = rows_of(master[: last + 1], follower[: last + 1], 0.5)
        assert [row.step for row in rows] == steps
        for row in rows:
            seen = follower[row.step] - follower[0]
            assert (row.master_s, row.normalised_s) == (0.5 * master[row.step], 0.5 * seen)
            assert row.follower_s == 0.5 * follower[row.step]
            assert row.delta_s == 0.5 * (seen - master[row.step])
            assert row.ratio == pytest.approx(seen / master[row.step])


def test_a_measurement_holds_only_if_own_ticks_are_noticed_or_cause_no_drift() -> None:
    even = rows_of([0, 1, 2], [5, 6, 7], 0.1)
    found = ClockDrift("ring", 0.1, 0.5, "obey", None, even, 4, 4, 4, 0)
    assert found.holds
    for ticks, holds in ((1, True), (2, False), (1000, False), (None, False)):
        assert replace(found, noticed_ticks=ticks).holds == holds
    ahead = rows_of([0, 1, 2], [5, 6, 8], 0.1)
    assert not replace(found, rows=ahead, answer="refuse").holds
    assert not replace(found, rows=ahead, answer="ignore").holds
    assert not replace(found, rows=ahead, own_ticks=0).holds
    assert replace(found, answer="refuse").holds


@pytest.mark.parametrize("share", ["0", "0.3", "0.92", "1"])
def test_own_ticks_are_evenly_distributed_over_steps(share: str) -> None:
    steps = [is_due(step, Fraction(share)) for step in range(1, 101)]
    assert all(sum(steps[:n]) == int(n * Fraction(share)) for n in range(101))


@pytest.mark.parametrize("answer", ["obey", "refuse", "ignore"])
def test_own_ticks_of_a_follower_are_counted(answer: OwnTicks, tmp_path: Path) -> None:
    found = measure_drift("ring", steps=100, rogue=0.92, answer=answer)
    assert (found.own_ticks, found.counted) == (92, 92)
    assert found.holds
    (row,) = found.rows
    assert row.master_s == 5.0
    if answer == "obey":
        assert row.delta_s == pytest.approx(4.6)
        assert row.ratio == 1.92
        assert found.drift_events == 92
        assert found.noticed_ticks == 0
    else:
        assert (row.delta_s, row.ratio) == (0.0, 1.0)
        assert found.drift_events == 0
    path = tmp_path / "table.csv"
    write_rows(path, found.rows)
    with path.open(newline="") as file:
        (read,) = csv.DictReader(file)
    assert float(read["ratio"]) == row.ratio


def test_the_own_clock_of_a_follower_is_compared_with_the_clock_of_the_master() -> None:
    rows = rows_of([0, 1, 2, 3], [7, 8, 9, 10], 0.5, [0.0, 0.4, 1.2, 1.75])
    assert [row.own_delta_s for row in rows] == [0.25]
    found = measure_drift("ring", steps=20, pace=1e6)  # no machine reaches this pace
    (row,) = found.rows
    assert (row.delta_s, found.holds) == (0.0, True)
    assert row.own_delta_s is not None
    assert row.own_delta_s > 1.0
    assert measure_drift("ring", steps=2).rows[0].own_delta_s is None


def test_a_follower_without_own_ticks_does_not_drift() -> None:
    found = measure_drift("ring", steps=40)
    assert found.holds
    assert [(row.step, row.delta_s, row.ratio) for row in found.rows] == [(40, 0.0, 1.0)]
    assert found.noticed_ticks is None


@pytest.mark.parametrize(("steps", "rogue"), [(0, 0.0), (10, 1.5), (10, -0.1), (10, float("nan"))])
def test_invalid_numbers_of_steps_and_shares_are_refused(steps: int, rogue: float) -> None:
    with pytest.raises(ConfigError):
        measure_drift("ring", steps=steps, rogue=rogue)
