"""Divided worlds with all sensors and messages equal the undivided world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.sensors.registry import TYPES
from cavmarl.verify.equivalence import verify_zones

ABOVE: dict[str, Any] = {"z_m": 1.4, "yaw_deg": 30.0}
TILTED: dict[str, Any] = {"x_m": -1.0, "y_m": 0.4, **ABOVE, "pitch_deg": -8.0, "roll_deg": 5.0}
CAMERA: dict[str, Any] = {"rate_hz": 5, "width": 24, "height": 16, **ABOVE}
RIG: dict[str, Any] = {
    "lidar": {"type": "lidar", "rate_hz": 5, "rays": 48, "noise": [0.02], "dropout": 0.1, **ABOVE},
    "layers": {"type": "lidar", "rate_hz": 2.5, "rays": 90, "layers": 8, **TILTED},
    "radar": {"type": "radar", "rate_hz": 5, "noise": [0.2, 0.01, 0.1], "bias": [0.1], **ABOVE},
    "depth": {"type": "depth_camera", "noise": [0.05], **CAMERA},
    "semantic": {"type": "semantic_camera", **CAMERA, **TILTED},
    "rgb": {"type": "rgb_camera", **CAMERA},
    "bev": {"type": "bev_grid", "rate_hz": 5, "cell_m": 1.0, "yaw_deg": 30.0},
    "gnss": {"type": "gnss", "rate_hz": 5, "noise": [1.0], "bias": [2.0]},
    "imu": {"type": "imu", "rate_hz": 50, "noise": [0.01], **ABOVE},
    "wheels": {"type": "odometry", "rate_hz": 2.5, "phase_ticks": 1},
    "lane": {"type": "lane_boundary", "rate_hz": 5, "noise": [0.02]},
    "events": {"type": "collision"},
}
EVERYTHING: dict[str, Any] = {
    "clock.sim_dt_s": 0.1,
    "clock.ctrl_dt_s": 0.2,
    "rig": RIG,
    "sensors.lidar.rays": 16,
    "v2x.enabled": True,
    "v2x.perception.rate_hz": 5.0,
    "v2x.roadside.signals": ["all"],
    "v2x.channel.range_m": 250.0,
    "v2x.channel.path_loss_exponent": 2.75,
    "v2x.channel.latency_ticks": 1,
    "v2x.channel.loss": 0.1,
    "observation.mode": "sensors",
    "observation.kind": "dict",
}
CROWD = {"population.mode": "respawn", "population.agents": 4, "population.background": 80}


def test_the_settings_have_every_type_of_sensor() -> None:
    rig = make_vec("grid4x4", overrides=EVERYTHING).config.rig
    assert {type(sensor) for sensor in rig.values()} == set(TYPES)


def test_records_of_a_tick_have_no_padding() -> None:
    simulation = make_vec("grid4x4", overrides=EVERYTHING).simulation
    for part in simulation.attached:
        for array in part.arrays():
            sizes = [array.dtype[name].itemsize for name in array.dtype.names or ()]
            assert sum(sizes) in (0, array.dtype.itemsize), (part, array.dtype)


def check_zones(env: str | Path, overrides: dict[str, Any], steps: int, crossings: int) -> None:
    found = verify_zones(env, (2, 4, 9), overrides=overrides, steps=steps, seed=3, check=True)
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == steps
    assert sum(result.crossings for result in found.results) >= crossings


def test_a_divided_world_with_all_sensors_equals_the_undivided_one() -> None:
    check_zones("grid4x4", EVERYTHING | CROWD, 20, 20)


@pytest.mark.parametrize("name", ["pedestrian_crossing", "unprotected_left_turn"])
def test_a_divided_scenario_with_all_sensors_equals_the_undivided_one(name: str) -> None:
    alone = {"population.agents": 1, "population.background": 20, "scenario.name": name}
    check_zones("grid4x4", EVERYTHING | alone, 20, 5)


@pytest.mark.parametrize("worlds", [1, 2])
def test_results_of_all_sensors_do_not_depend_on_workers(worlds: int) -> None:
    alone, shared = (
        make_vec("grid4x4", num_envs=worlds, zones=2, workers=workers, overrides=EVERYTHING | CROWD)
        for workers in (0, 2)
    )
    try:
        for vec in (alone, shared):
            vec.reset(seed=5)
        for _ in range(8):
            actions = alone.suggest_actions()
            for ours, theirs in zip(
                alone.step(actions)[1:4], shared.step(actions)[1:4], strict=True
            ):
                np.testing.assert_array_equal(ours, theirs)
            for name, frames in alone.frames().items():
                for ours, theirs in zip(frames, shared.frames()[name], strict=True):
                    assert ours.tobytes() == theirs.tobytes(), name
            for w in range(worlds):
                assert alone.state_hash(w) == shared.state_hash(w)
    finally:
        shared.close()
        alone.close()
