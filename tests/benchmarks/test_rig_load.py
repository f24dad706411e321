"""A rig with a requested load is found, is valid, and can be read after it was written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import rig_load
from benchmarks.rig_load import scaled
from benchmarks.sensor_run import SensorJob, load_rig
from cavmarl.config.registry import find_settings, load_config
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError

LIDAR = {"type": "lidar", "rate_hz": 10, "rays": 30, "z_m": 1.6}


def test_a_rig_is_found_although_no_rig_has_the_requested_load(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With over 1000 rays, sensors take 2.4 times as long, so no load is between 10 and 24 ms."""

    def costs_ms(rig: Mapping[str, Any]) -> float:
        rays = rig["lidar"]["rays"]
        return rays / 100.0 if rays <= 1000 else 2.4 * rays / 100.0

    def run(job: SensorJob) -> SimpleNamespace:
        found = costs_ms(job.spec.overrides["rig"])
        return SimpleNamespace(
            parts_ms={"sensor compute": [found]}, costs_ms=[found / (job.spec.agents or 1)]
        )

    monkeypatch.setattr(rig_load, "run_job", run)
    said: list[str] = []
    spec = WorldSpec(env="grid4x4", overrides={"rig": {"lidar": LIDAR}}, agents=2, background=3)
    job = SensorJob(spec, 1, 2, 6)
    loaded = rig_load.loaded(job, 20.0, said.append)
    assert 24.0 <= costs_ms(loaded.spec.overrides["rig"]) <= 30.0
    tries = [float(text.split()[-2]) for text in said[2:]]
    assert min(tries) < 20.0, "no try was too light"
    assert max(tries) > 30.0, "no try was too heavy"


@pytest.mark.parametrize("factor", [0.1, 1.0, 3.0, 1e3, 1e6])
def test_rigs_of_any_load_are_valid(factor: float) -> None:
    rig = load_rig(find_settings("rig", "ten_sensors"))
    plain, _ = load_config("grid4x4", overrides={"rig": rig, "clock.ctrl_dt_s": 0.05})
    heavy = scaled(plain, dict.fromkeys(rig, factor), 20.0)
    config, _ = load_config("grid4x4", overrides={"rig": heavy, "clock.ctrl_dt_s": 0.05})
    for name, sensor in config.rig.items():
        before, after = plain.rig[name].shape, sensor.shape
        grows = [b >= a if factor >= 1.0 else b <= a for a, b in zip(before, after, strict=True)]
        assert all(grows)


def test_the_found_rig_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(rig_load, "loaded", lambda job, load_ms, say: job)
    out = tmp_path / "rig.yaml"
    found = rig_load.measure("grid4x4", 5.0, out)
    assert load_rig(out) == load_rig(find_settings("rig", "ten_sensors"))
    assert len(found.rows) == 10
    assert f"--rig {out}" in found.notes[0]


@pytest.mark.parametrize("load", [0.0, -1.0, 1e5])
def test_an_invalid_load_is_refused(load: float, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must be above 0"):
        rig_load.measure("grid4x4", load, tmp_path / "rig.yaml")
