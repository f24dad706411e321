"""Closed roads compared with SUMO's rerouters, and the cost of a closure."""

from __future__ import annotations

import pytest

pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

from benchmarks.closures import ROADS, compare


@pytest.mark.slow
def test_arrivals_and_travel_times_agree_with_sumos_rerouters() -> None:
    found = compare("grid4x4", ROADS.split(","), 300, 900, 60, seed=3)
    assert found["rerouted"] > 50
    assert found["arrived"] == pytest.approx(found["sumo_arrived"], rel=0.15)
    assert found["trip_s"] == pytest.approx(found["sumo_trip_s"], rel=0.15)
    assert found["waiting"] == 0
