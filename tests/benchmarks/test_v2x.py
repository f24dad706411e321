"""Every channel is measured on the same vehicles; a bound that does not hold is told."""

from __future__ import annotations

from benchmarks.v2x import CHANNELS, measure


def test_channels_are_measured_on_the_same_vehicles() -> None:
    found = measure("grid4x4", vehicles=40, ticks=10, warmup=10, at_most=1e-9)
    rows = {row["name"]: row for row in found.rows[1:]}
    assert list(rows) == list(CHANNELS)
    assert all(len(row["tick_ms"]) == 10 and row["median_ms"] > 0.0 for row in rows.values())
    assert rows["ideal"]["reception_ratio"] == rows["range 300 m"]["reception_ratio"] == 1.0
    assert rows["path loss"]["reachable"] == rows["range 300 m"]["reachable"]
    assert rows["ideal"]["reachable"] > rows["path loss"]["reachable"] > 0.0
    assert 0.0 < rows["path loss, busy air"]["reception_ratio"] < 1.0
    assert not found.holds
