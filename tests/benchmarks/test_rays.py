"""Every sensor of the rig is measured among many cars."""

from __future__ import annotations

import pytest

from benchmarks.rays import measure
from cavmarl.core.errors import ConfigError


@pytest.mark.parametrize("repeats", [0, 101])
def test_numbers_out_of_range_are_refused(repeats: int) -> None:
    with pytest.raises(ConfigError, match=f"repeats = {repeats}: must be from 1 to 100"):
        measure(repeats)


@pytest.mark.slow
def test_every_sensor_of_the_rig_is_measured() -> None:
    said: list[str] = []
    found = measure(2, said.append)
    facts = found.facts
    assert facts["cars_per_km2"] == pytest.approx(400.0, abs=8.0)
    assert len(found.rows) == 11
    for row in found.rows:
        assert 0.0 < row["low_us"] <= row["median_us"] <= row["high_us"]
    assert 0.0 < facts["lidar_ns"] < 250.0
    assert 0.0 < facts["cameras_ms"] < 2.5
    assert facts["cameras_ms"] < facts["tick_ms"] < 20.0
    assert said[-1] == "measuring, 2 of 2"
