"""Measure hand-overs between two zones with CARLA's client in a small run."""

from __future__ import annotations

import pytest

from benchmarks.carla_zones import measure_zones
from cavmarl.config.world_spec import WorldSpec
from cavmarl.handoff.simulators.carla_zone import PYTHON
from tests.cosim.carla.conftest import VERSION, client_python

pytest.importorskip("sumo", reason="needs the extra 'sumo'")


def test_no_vehicle_is_lost_between_two_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python(VERSION))
    found = measure_zones(WorldSpec.of("grid4x4", seed=3), zones=2, vehicles=60, steps=60)
    assert found["lost"] == 0
    assert found["hand_overs"] > 0
    assert 0.0 < found["median_ms"] <= found["p99_ms"] < 60_000.0
    assert found["ticks_per_s"] > 0.0
