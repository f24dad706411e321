"""Localisation against a point-cloud map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from benchmarks.localisation import STEP_S, Drive, rig_with, write_surface
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.follower_driver import StackDriver
from cavmarl.cosim.followers.follower_snapshots import welcome_to
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.stack import Stack, StackConfig, sensor_of, vehicle_of
from cavmarl.engine.world_setup import load_roads
from cavmarl.maps.fidelity.cloud_files import Cloud, write_cloud

pytest.importorskip("small_gicp", reason="needs the extra 'maps'")


@pytest.fixture(scope="module")
def world() -> Any:
    overrides = {
        "rig": rig_with(1.0, 2.0, markings=False),
        "clock.ctrl_dt_s": STEP_S,
        "map.buildings": "map/buildings.poly.xml",
    }
    return cavmarl.parallel_env("grid4x4", agents=2, background=0, overrides=overrides)


@pytest.fixture(scope="module")
def cloud(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the surface of the map as a point cloud."""
    return write_surface(world, tmp_path_factory.mktemp("cloud") / "grid.ply")


@pytest.mark.slow
def test_scan_matching_removes_a_bias_of_gnss(world: Any, cloud: Path) -> None:
    """Compare the position error of the filter with and without scans.

    Without scans, the error is the bias of GNSS. With fixes of 1 m at 10 Hz and a drift of
    0.1 m/√s, the position has a standard deviation of √(0.1 · √0.1) m = 0.18 m about the biased
    position. With scans, the error is at most that of one scan. A scan has a standard deviation of
    0.1 m east and north (lidar 2 cm, map 3 cm, points 0.4 m apart), so its mean error is
    0.1 · √(π/2) m.
    """
    drive = Drive(world, cloud, seed=3)
    for _ in range(200):
        assert drive.step()
    bias_m = float(np.hypot(*np.mean(drive.fixes_m, axis=0)))
    before, after = (float(np.mean(off[100:])) for off in drive.off_m.values())
    assert bias_m > 3.0, "the bias is within the range of scan matching"
    assert before == pytest.approx(bias_m, abs=3.0 * 0.18)
    assert after < 0.1 * math.sqrt(0.5 * math.pi)
    matching = drive.stages["scan_matching"]
    assert (matching.refused, matching.lost) == (0, 0)
    assert matching.bias == pytest.approx(np.mean(drive.fixes_m, axis=0), abs=3.0 * 0.1)


def test_missing_inputs_are_errors_that_name_the_input(
    world: Any, cloud: Path, tmp_path: Path
) -> None:
    hd_map = HdMap(world.network)
    sensors = [sensor_of(v.name, v.settings) for v in welcome_to(world, ["car_0"], 0).sensors]

    def stack(chosen: Any, path: Path | None) -> Stack:
        return Stack(vehicle_of(hd_map, chosen, 0.05, path), StackConfig(**MATCHING))

    with pytest.raises(ConfigError, match="needs a point-cloud map"):
        stack(sensors, None)
    with pytest.raises(ConfigError, match="needs a lidar"):
        stack([one for one in sensors if one.type != "lidar"], cloud)
    flat = tmp_path / "flat.csv"
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    ground = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    write_cloud(flat, Cloud("flat", ground))
    with pytest.raises(ConfigError, match="has no walls"):
        stack(sensors, flat)
    assert stack(sensors, cloud).pose is None


def test_a_stack_refuses_a_map_with_other_settings_than_the_world(world: Any) -> None:
    welcome = welcome_to(world, ["car_0"], 0)
    with pytest.raises(ConfigError, match=r"another map than .*--set map\.buildings"):
        StackDriver(load_roads(*load_config("grid4x4")), welcome)
    keys = {"map.buildings": "map/buildings.poly.xml"}
    assert not StackDriver(load_roads(*load_config("grid4x4", overrides=keys)), welcome).stacks


MATCHING = {"localisation": "scan_matching"}
