"""The cost of idle worker processes, in cavmarl and in other libraries."""

from __future__ import annotations

import sys

import pytest

from benchmarks.vectorization import LIBRARIES, measure

pytestmark = pytest.mark.filterwarnings("ignore")  # warnings of the libraries about their own code


def test_each_library_steps_the_same_agents() -> None:
    pytest.importorskip("supersuit", reason="needs the extra: bench")
    found = measure(agents=4, workers=2, repeats=1)
    rows = {row["library"]: row for row in found.rows}
    assert list(rows) == list(LIBRARIES)
    assert all(len(row["step_us"]) == 1 and row["step_us"][0] > 0.0 for row in rows.values())
    assert rows["cavmarl"]["ratio"] == 1.0
    gymnasium, order = rows["gymnasium"], rows["our workers alone"]
    assert gymnasium["order_ratio"] == gymnasium["step_us"][0] / order["step_us"][0]


def test_the_result_names_a_missing_library_and_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "supersuit", None)
    found = measure(agents=2, workers=2, repeats=1)
    assert "'.[bench]'" in found.facts["missing"]["supersuit"]
    assert "ratio" not in found.rows[-1]
