"""What worker processes cost in which nothing happens, ours and others'."""

from __future__ import annotations

import sys

import pytest

from cavmarl.bench.split_speed import SplitSpeed, split_line
from cavmarl.bench.vectorization_speed import measure_vectorization
from cavmarl.core.errors import ConfigError

pytestmark = pytest.mark.filterwarnings("ignore")  # what the libraries warn of themselves


def test_each_library_steps_the_same_agents() -> None:
    pytest.importorskip("supersuit", reason="needs the extra: supersuit")
    found = measure_vectorization(agents=4, workers=2, repeats=1)
    assert [row.library for row in found.rows] == ["cavmarl", "gymnasium", "supersuit"]
    assert all(len(row.step_us) == 1 and row.step_us[0] > 0.0 for row in found.rows)
    assert found.to_dict()["ratios"]["cavmarl"] == 1.0
    assert 0.0 < found.order_us[0]
    gymnasium = found.rows[1].step_us[0]
    assert found.order_ratio("gymnasium") == gymnasium / found.order_us[0]


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "supersuit", None)
    found = measure_vectorization(agents=2, workers=2, repeats=1)
    assert "cavmarl[supersuit]" in found.rows[2].missing
    assert found.ratio("supersuit") is None


def test_agents_are_shared_out_evenly() -> None:
    with pytest.raises(ConfigError, match="5 agents over 2 workers"):
        measure_vectorization(agents=5, workers=2)


def test_the_line_lies_where_splitting_pays_from_then_on() -> None:
    def split(vehicles: int, ratio: float) -> SplitSpeed:
        return SplitSpeed(vehicles, 2, 2, (ratio,), (1.0,), (1.0,))

    few, some, many = split(100, 1.1), split(1000, 0.9), split(10_000, 1.6)
    assert split_line([many, few, some]) == 10_000
    assert split_line([few, some]) is None
    assert split_line([few, many]) == 100
