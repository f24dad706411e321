"""CARLA's own client gets a frame of each of ten sensors in each tick."""

from __future__ import annotations

import pytest

from benchmarks.carla_rates import TEN_SENSORS, Load, measure_load
from cavmarl.config.world_spec import WorldSpec
from cavmarl.handoff.simulators.carla_zone import PYTHON
from tests.cosim.carla.conftest import client_python

pytest.importorskip("sumo", reason="needs the extra 'sumo'")


def test_no_frame_of_ten_sensors_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python("0.9.16"))
    spec = WorldSpec.of("grid4x4", seed=0)
    found = measure_load(spec, Load("ten sensors", 12, TEN_SENSORS, 0.0), ticks=1000)
    assert len(found["sensors"]) == 10
    assert [sensor["lost"] for sensor in found["sensors"]] == [0] * 10
    assert found["vehicles"] == 12
    for sensor in found["sensors"]:
        assert 0.0 < sensor["median_ms"] <= sensor["usual_ms"] <= sensor["largest_ms"]
