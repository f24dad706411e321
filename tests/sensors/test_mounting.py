"""Mounting positions and rotations of sensors equal products of rotation matrices."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.config.rig import OdometryConfig
from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.sensors.kernels.rig_frames import sensor_pose
from cavmarl.sensors.mounted.mount_transforms import (
    check_place,
    mount_of,
    sensor_to_vehicle,
    transform,
)
from tests.naive.rig import turn


def _some(seed: int) -> tuple[OdometryConfig, np.void]:
    rng = np.random.default_rng(seed)
    x, y, z, yaw, pitch, roll = rng.uniform(-1, 1, 6).tolist()
    config = OdometryConfig(
        rate_hz=10.0, x_m=2 * x, y_m=y, z_m=1 + 0.5 * z,
        yaw_deg=180 * yaw, pitch_deg=80 * pitch, roll_deg=170 * roll,
    )  # fmt: skip
    row = blank_vehicle()[0]
    for name, value in zip(("x", "y", "z", "heading", "pitch"), rng.uniform(-1, 1, 5), strict=True):
        row[name] = value
    return config, row


@pytest.mark.parametrize("seed", range(5))
def test_a_mount_rotates_by_yaw_then_pitch_then_roll(seed: int) -> None:
    config, _ = _some(seed)
    angles = np.radians([config.yaw_deg, config.pitch_deg, config.roll_deg]).tolist()
    np.testing.assert_allclose(mount_of(config).turn, turn(*angles), atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_the_pose_of_a_sensor_combines_vehicle_and_mount(seed: int) -> None:
    config, row = _some(seed)
    mount = mount_of(config)
    points = np.random.default_rng(seed).normal(size=(20, 3))
    of_vehicle = turn(float(row["heading"]), float(row["pitch"]), 0.0)
    there = np.array([row["x"], row["y"], row["z"]])
    in_world = transform(of_vehicle, there, sensor_to_vehicle(mount, points))
    body, axes = np.zeros((3, 3)), np.zeros((3, 3))
    place = sensor_pose(row, mount, body, axes)
    np.testing.assert_allclose(points @ axes.T + np.array(place), in_world, atol=1e-12)


def test_a_positive_pitch_looks_up() -> None:
    mount = mount_of(OdometryConfig(rate_hz=10.0, pitch_deg=30.0))
    ahead = sensor_to_vehicle(mount, np.array([[1.0, 0.0, 0.0]]))[0]
    assert ahead[2] == pytest.approx(0.5)


@pytest.mark.parametrize("place", [{"x_m": 2.6}, {"y_m": -1.1}, {"z_m": 1.7}, {"z_m": -0.1}])
def test_a_position_outside_of_the_body_is_refused(place: dict[str, float]) -> None:
    car = generated_types()[0]
    check_place("a", OdometryConfig(rate_hz=1.0, x_m=2.5, y_m=-1.0, z_m=1.6), car)
    with pytest.raises(ConfigError, match=r"rig\.a\.[xyz]_m = .*outside the vehicle's body"):
        check_place("a", OdometryConfig(rate_hz=1.0, **place), car)
