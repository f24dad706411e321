"""The measurement of the viewer runs, and its frames are within the bound."""

from __future__ import annotations

from benchmarks import viewer


def test_frames_are_small_and_clients_get_them() -> None:
    found = viewer.measure("ring", vehicles=10_000, clients=2, seconds=1.0, rate_hz=5.0)
    assert found.row("publishing")["kb"] <= 100.0
    assert found.row("2 clients, 5 Hz")["fps"] > 2.0
