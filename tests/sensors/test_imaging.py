"""Lidars, radars, cameras and grids in front of a wall, and their settings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.config.rig import LidarRigConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.sensors.kernels.panorama import (
    BUILDING,
    LANE_LINE,
    PEDESTRIAN,
    ROAD,
    SEMANTIC_OF_CLASS,
    TRUCK,
)
from cavmarl.sensors.mounted.backdrop import lane_strips
from cavmarl.sensors.mounted.lidar import lidar_fan

FRONT = {"x_m": 1.0, "z_m": 1.3}
SMALL = {"width": 40, "height": 24, "rate_hz": 5}
DISTANCE_M = 10.0
WALL_RIG: dict[str, Any] = {
    "plane": {"type": "lidar", "rate_hz": 5, "rays": 4, **FRONT},
    "layers": {"type": "lidar", "rate_hz": 5, "rays": 4, "layers": 3, "lower_deg": -5, **FRONT},
    "turned": {"type": "lidar", "rate_hz": 5, "rays": 4, **FRONT, "yaw_deg": 60.0},
    "radar": {"type": "radar", "rate_hz": 5, "rays": 61, **FRONT},
    "depth": {"type": "depth_camera", **SMALL, **FRONT},
    "classes": {"type": "semantic_camera", **SMALL, **FRONT},
    "colours": {"type": "rgb_camera", **SMALL, **FRONT},
    "grid": {"type": "bev_grid", "rate_hz": 5, "cell_m": 0.25, "ahead_m": 20.0},
}


def _alone(**overrides: Any) -> CavVectorEnv:
    vec = make_vec("merge", agents=1, background=0, overrides={"rig": WALL_RIG, **overrides})
    vec.reset(seed=0)
    return vec


@pytest.fixture
def before_a_wall(tmp_path: Path) -> CavVectorEnv:
    """Return a world with one vehicle whose sensors are 10 m in front of the wall of a hall."""
    row = _alone().simulation.vehicles()[0]
    heading, away = float(row["heading"]), FRONT["x_m"] + DISTANCE_M
    corners = [
        (
            row["x"] + x * math.cos(heading) - y * math.sin(heading),
            row["y"] + x * math.sin(heading) + y * math.cos(heading),
        )
        for x, y in ((away, -30.0), (away + 5.0, -30.0), (away + 5.0, 30.0), (away, 30.0))
    ]
    shape = " ".join(f"{x!r},{y!r}" for x, y in (map(float, corner) for corner in corners))
    tall = '<param key="height" value="30"/>'
    hall = f'<poly id="hall" type="building" shape="{shape}">{tall}</poly>'
    path = tmp_path / "hall.poly.xml"
    path.write_text(f"<additional>{hall}</additional>")
    return _alone(**{"map.buildings": str(path)})


def test_all_sensors_measure_10_m_to_a_wall_ten_metres_ahead(before_a_wall: CavVectorEnv) -> None:
    data: dict[str, NDArray[Any]] = {
        name: frames.data[0, 0, -1] for name, frames in before_a_wall.frames().items()
    }
    assert data["plane"][0].tolist() == pytest.approx([10.0, 60.0, 60.0, 60.0])
    layers = LidarRigConfig(**WALL_RIG["layers"])
    elevations = np.linspace(layers.lower_deg, layers.upper_deg, 3)
    assert data["layers"][:, 0] == pytest.approx(10.0 / np.cos(np.radians(elevations)), abs=1e-4)
    assert data["turned"][0, 0] == pytest.approx(20.0, abs=1e-4)
    speed = before_a_wall.simulation.vehicles()["speed"][0]
    assert data["radar"][0] == pytest.approx([10.0, 0.0, -speed], abs=1e-4)
    assert not data["radar"][1:].any()
    upper = slice(0, SMALL["height"] // 2)
    assert (data["depth"][upper] == 10.0).all()
    assert (data["classes"][upper] == BUILDING).all()
    assert len(np.unique(data["colours"][upper].reshape(-1, 3), axis=0)) == 1
    middle = data["grid"][:, data["grid"].shape[1] // 2]
    first = np.flatnonzero(
        middle == BUILDING
    ).max()  # the lowest row of the grid is the nearest one
    assert 20.0 - 0.25 * (first + 1) == pytest.approx(FRONT["x_m"] + DISTANCE_M, abs=0.25)
    assert set(middle[first + 1 :].tolist()) <= {ROAD, LANE_LINE}


def test_rays_of_a_lidar_are_spread_evenly() -> None:
    fan = lidar_fan(LidarRigConfig(rate_hz=5, rays=5, fov_deg=90.0))
    angles = np.degrees(np.arctan2(fan.rays[:, 0, 1], fan.rays[:, 0, 0]))
    assert angles == pytest.approx([-45.0, -22.5, 0.0, 22.5, 45.0])


def test_the_strips_of_lanes_have_the_area_of_the_lanes() -> None:
    network = load_world("grid4x4").network
    strips, lined = lane_strips(network)
    x, y = strips[..., 0], strips[..., 1]
    area = 0.5 * np.abs((x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y).sum(axis=1)).sum()
    lanes = (network.lanes["length_m"] * network.lanes["width_m"]).sum()
    assert area == pytest.approx(lanes, rel=0.05)
    assert 0.0 < lined.mean() < 1.0


def test_every_class_of_vehicles_has_a_semantic_class() -> None:
    assert set(VEHICLE_CLASSES) <= set(SEMANTIC_OF_CLASS)


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ({"type": "semantic_camera", "noise": [0.1]}, r"rig\.wrong\.noise = .*must be 0"),
        ({"type": "bev_grid", "bias": [0.1]}, r"rig\.wrong\.bias = .*must be 0"),
        ({"type": "bev_grid", "roll_deg": 1.0}, r"rig\.wrong\.roll_deg = 1.*is horizontal"),
        ({"type": "depth_camera", "fov_deg": 180.0}, r"rig\.wrong\.fov_deg"),
        ({"type": "depth_camera", "width": 4096, "height": 4096}, "more than"),
        ({"type": "lidar", "rays": 0}, r"rig\.wrong\.rays"),
        ({"type": "radar", "range_m": 1e9}, r"rig\.wrong\.range_m"),
    ],
)
def test_invalid_camera_settings_are_refused(sensor: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_vec("merge", overrides={"rig": {"wrong": {"rate_hz": 5, **sensor}}})


def _crossing(occluded: bool) -> tuple[set[int], NDArray[np.void]]:
    """Return the classes that an agent's camera sees before a pedestrian starts, and all rows."""
    rig = {"eyes": {"type": "semantic_camera", "rate_hz": 5, "width": 640, "height": 90, **FRONT}}
    scenario = {"scenario.name": "pedestrian_crossing", "scenario.params": {"occluded": occluded}}
    vec = make_vec("grid4x4", agents=1, background=0, overrides={"rig": rig, **scenario})
    vec.reset(seed=0)
    return set(vec.frames()["eyes"].data[0, 0, -1].ravel().tolist()), vec.simulation.vehicles()


def test_a_camera_sees_a_pedestrian_unless_a_van_hides_the_pedestrian() -> None:
    seen, rows = _crossing(occluded=False)
    assert len(rows) == 2
    assert PEDESTRIAN in seen
    seen, rows = _crossing(occluded=True)
    assert len(rows) == 3
    assert TRUCK in seen
    assert PEDESTRIAN not in seen
