"""Table II: a follower in another process, and one that ticks by itself."""

from __future__ import annotations

import csv
from fractions import Fraction
from pathlib import Path

import pytest

from cavmarl.bench.clock_drift import measure_drift, rows_of, write_rows
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.clock_reader import is_due
from cavmarl.cosim.time_master import OwnTicks


def test_the_table_of_the_paper_from_raw_ticks() -> None:
    share = Fraction("0.92")
    master = list(range(5001))
    follower = [40 + step + int(step * share) for step in master]
    rows = rows_of(master, follower, 0.05)
    assert [row.step for row in rows] == [100, 500, 1000, 5000]
    assert [round(row.delta_s, 9) for row in rows] == [4.6, 23.0, 46.0, 230.0]
    assert [row.master_s for row in rows] == [5.0, 25.0, 50.0, 250.0]
    assert {row.ratio for row in rows} == {1.92}
    assert rows[-1].follower_s == pytest.approx(482.0)


@pytest.mark.parametrize("share", ["0", "0.3", "0.92", "1"])
def test_own_ticks_are_spread_evenly(share: str) -> None:
    steps = [is_due(step, Fraction(share)) for step in range(1, 101)]
    assert all(sum(steps[:n]) == int(n * Fraction(share)) for n in range(101))


@pytest.mark.parametrize("answer", ["obey", "refuse", "ignore"])
def test_a_rogue_follower(answer: OwnTicks, tmp_path: Path) -> None:
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


def test_a_clock_of_its_own_is_compared_with_the_masters() -> None:
    rows = rows_of([0, 1, 2, 3], [7, 8, 9, 10], 0.5, [0.0, 0.4, 1.2, 1.75])
    assert [row.own_delta_s for row in rows] == [0.25]
    found = measure_drift("ring", steps=20, pace=1e6)  # which no machine keeps
    (row,) = found.rows
    assert (row.delta_s, found.holds) == (0.0, True)
    assert row.own_delta_s is not None
    assert row.own_delta_s > 1.0
    assert measure_drift("ring", steps=2).rows[0].own_delta_s is None


def test_a_follower_that_only_follows() -> None:
    found = measure_drift("ring", steps=40)
    assert found.holds
    assert [(row.step, row.delta_s, row.ratio) for row in found.rows] == [(40, 0.0, 1.0)]
    assert found.noticed_ticks is None


@pytest.mark.parametrize(("steps", "rogue"), [(0, 0.0), (10, 1.5), (10, -0.1), (10, float("nan"))])
def test_impossible_measurements(steps: int, rogue: float) -> None:
    with pytest.raises(ConfigError):
        measure_drift("ring", steps=steps, rogue=rogue)
