"""A point-cloud map from the lidar of a vehicle that drives through the map."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl.cli.map import app
from cavmarl.config.rig import LidarRigConfig
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.height_track import HeightTrack
from cavmarl.cosim.stack.lidar_points import lidar_points
from cavmarl.cosim.stack.stack_types import StackMount, StackSensor
from cavmarl.maps.fidelity.cloud_files import read_cloud
from cavmarl.sensors.kernels.vehicle_readings import GRAVITY_MPS2
from cavmarl.sensors.mounted.lidar import lidar_fan
from cavmarl.sensors.sensed_shapes import sampled_shapes

pytest.importorskip("small_gicp", reason="needs the extra 'maps'")


def test_the_heights_and_pitches_of_a_hill_are_estimated() -> None:
    """Drive for 40 s over hills at 10 m/s, with the noise of the reference rig."""
    random = np.random.default_rng(1)
    dt, steps, speed = 0.05, 800, 10.0
    s = np.arange(steps) * dt * speed
    height = 300.0 + 5.0 * np.sin(s / 60.0)
    pitch = np.arctan(5.0 / 60.0 * np.cos(s / 60.0))
    track = HeightTrack(2.0, 0.05)
    for k in range(steps):
        force = GRAVITY_MPS2 * np.sin(pitch[k]) + random.normal(0.0, 0.05 / np.sqrt(5.0))
        fix = height[k] + random.normal(0.0, 2.0) if k % 2 == 0 else None
        track.add(dt if k else 0.0, force, speed + random.normal(0.0, 0.05), fix)
    found, turned = track.smoothed()
    assert np.abs(found - height).mean() < 0.4
    assert np.ptp(found - height) < 1.0
    assert np.abs(turned - pitch).mean() < 0.01


def test_an_echo_becomes_a_point_at_the_end_of_its_ray() -> None:
    settings = {
        "fov_deg": 360.0, "range_m": 50.0, "lower_deg": -10.0, "upper_deg": 10.0,
        "yaw_deg": 90.0, "pitch_deg": 0.0, "roll_deg": 0.0, "x_m": 1.0, "y_m": 0.0, "z_m": 1.6,
    }  # fmt: skip
    lidar = StackSensor("roof", "lidar", StackMount(1.0, 0.0, 0.0), settings)
    scan = np.full((3, 4), 50.0)
    scan[1, 0] = 10.0  # level and ahead of the sensor, which points to the left of the vehicle
    scan[0, 2] = 5.0
    found = lidar_points(lidar, scan)
    down = np.radians(10.0)
    assert found[1] == pytest.approx([1.0, 10.0, 1.6])
    assert found[0] == pytest.approx([1.0, -5.0 * np.cos(down), 1.6 - 5.0 * np.sin(down)])
    assert len(found) == 2
    assert len(lidar_points(lidar, scan, 7.0)) == 1


def test_the_ray_of_a_lidar_with_one_ray_points_straight_ahead() -> None:
    """Check the world (`lidar_fan`) and all programs that use its scans."""
    config = LidarRigConfig(rate_hz=10.0, rays=1, fov_deg=90.0)
    (ahead,) = lidar_fan(config).rays[:, 0]
    lidar = StackSensor("roof", "lidar", StackMount(0.0, 0.0, 0.0), asdict(config))
    scan = np.array([[10.0]])
    assert lidar_points(lidar, scan) - (0.0, 0.0, config.z_m) == pytest.approx(10.0 * ahead[None])
    (shape,) = sampled_shapes("roof", config, scan)
    assert shape["ends"] == pytest.approx(10.0 * ahead[:2])
    assert ahead == pytest.approx([1.0, 0.0, 0.0])


@pytest.mark.slow
def test_the_points_of_a_survey_lie_on_the_map(tmp_path: Path) -> None:
    cloud, told = tmp_path / "grid.ply", tmp_path / "told.json"
    words = ["survey", "grid4x4", "-o", str(cloud), "--time-s", "12", "--vehicles", "1"]
    words += ["--buildings", "map/buildings.poly.xml", "--voxel", "0.4", "--json", str(told)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    document = json.loads(told.read_text())
    assert len(read_cloud(cloud).points) == document["points"] > 5000
    assert document["frames"] > 15
    assert document["pose"]["mean_off_m"] < 0.7
    surface = document["surface"]
    assert surface["height_rmse_m"] < 0.6
    assert surface["wall_rmse_m"] is None or surface["wall_rmse_m"] < 0.7
    assert 0.0 < surface["seen_share"] <= 1.0


def test_a_survey_with_an_unknown_file_type_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["survey", "ring", "-o", str(tmp_path / "a.las")])
    assert isinstance(result.exception, ConfigError)
