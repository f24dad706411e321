"""The drawn shapes of sensor data are at the positions of the sensed objects."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.viewer.vehicle_details import vehicle_details

RIG = {
    "roof": {"type": "lidar", "rate_hz": 10, "rays": 90, "z_m": 0.8, "range_m": 50},
    "tower": {"type": "lidar", "rate_hz": 10, "rays": 90, "layers": 8, "z_m": 1.5},
    "front": {"type": "rgb_camera", "rate_hz": 10, "z_m": 1.2, "width": 640, "height": 360},
    "depth": {"type": "depth_camera", "rate_hz": 10, "z_m": 1.2, "width": 32, "height": 18},
    "above": {"type": "bev_grid", "rate_hz": 10},
    "bumper": {"type": "radar", "rate_hz": 10, "x_m": 2.4, "z_m": 0.5},
    "motion": {"type": "imu", "rate_hz": 10},
}


@pytest.fixture(scope="module")
def told() -> Any:
    """Yield the details of an agent with all kinds of sensors, its frame and its vehicle id."""
    grid = {"features": ["presence", "on_road"], "align_to_vehicle_axes": True}
    sensors = {"sensors.lidar.rays": 72, "sensors.occupancy_grid": grid}
    env = parallel_env("merge", agents=4, background=20, overrides={"rig": RIG, **sensors})
    env.reset(seed=3)
    for _ in range(20):
        env.step(env.suggest_actions())
    frame = env.world_frames()[0]
    vehicle = int(env.worlds.arrays.vehicle_ids[0, 0])
    yield vehicle_details(env, 0, frame, vehicle, sensors=True), frame, vehicle
    env.close()


def shapes_of(told: Any) -> dict[str, dict[str, Any]]:
    return {shape["name"]: shape for shape in told[0]["shapes"]}


def on_map(told: Any, flat: list[float]) -> np.ndarray:
    """Transform points from the vehicle's coordinates to the map's."""
    rows = told[1].vehicles
    row = rows[rows["id"] == told[2]][0]
    cos, sin = np.cos(row["heading"]), np.sin(row["heading"])
    places = np.array(flat).reshape(-1, 2)
    turned: np.ndarray = places @ np.array([[cos, sin], [-sin, cos]]) + [row["x"], row["y"]]
    return turned


def to_bodies_m(told: Any, places: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest other vehicle; 0 inside of its body."""
    others = told[1].vehicles[told[1].vehicles["id"] != told[2]]
    gaps = []
    for row in others:
        cos, sin = np.cos(row["heading"]), np.sin(row["heading"])
        local = (places - [row["x"], row["y"]]) @ np.array([[cos, -sin], [sin, cos]])
        over = np.abs(local) - [row["length"] / 2, row["width"] / 2]
        gaps.append(np.hypot(*np.maximum(over, 0.0).T))
    least: np.ndarray = np.min(gaps, axis=0)
    return least


def test_lidar_rays_end_at_the_bodies_of_other_vehicles(told: Any) -> None:
    shape = shapes_of(told)["lidar"]
    hits = np.array(shape["hits"], bool)
    assert 0 < hits.sum() < len(hits) == 72
    ends = on_map(told, shape["ends"])
    assert to_bodies_m(told, ends[hits]).max() < 0.05
    assert to_bodies_m(told, ends[~hits]).min() > 0.0


def test_neighbours_and_radar_targets_lie_on_vehicles(told: Any) -> None:
    shapes = shapes_of(told)
    assert shapes["neighbors"]["kind"] == "links"
    for name in ("neighbors", "bumper"):
        places = on_map(told, shapes[name]["points"])
        assert len(places)
        assert to_bodies_m(told, places).max() < 0.3


def test_occupied_cells_are_at_vehicles(told: Any) -> None:
    shape = shapes_of(told)["occupancy_grid"]
    shown = np.frombuffer(base64.b64decode(shape["rgba"]), np.uint8)
    shown = shown.reshape(shape["height"], shape["width"], 4)
    rows, columns = np.nonzero((shown[..., 0] == 255) & (shown[..., 3] > 0))
    first, right, below = np.array(shape["corners"]).reshape(3, 2)
    across, down = (right - first) / shape["width"], (below - first) / shape["height"]
    middles = first + (columns[:, None] + 0.5) * across + (rows[:, None] + 0.5) * down
    places = on_map(told, middles.ravel().tolist())
    centres = np.stack([told[1].vehicles["x"], told[1].vehicles["y"]], axis=1)
    nearest = np.abs(places[:, None] - centres).max(axis=2).min(axis=1)
    assert len(places) > 1
    assert nearest.max() < 5.0  # half the diagonal of a cell


def test_pictures_of_all_kinds_are_small_enough(told: Any) -> None:
    shapes = shapes_of(told)
    assert shapes["front"]["width"] * shapes["front"]["height"] <= 64_000
    for name in ("front", "depth", "above"):
        shape = shapes[name]
        pixels = base64.b64decode(shape["rgba"])
        assert len(pixels) == 4 * shape["width"] * shape["height"]
        assert len(set(np.frombuffer(pixels, np.uint32).tolist())) > 1
    assert shapes["roof"]["kind"] == "rays"
    assert shapes["tower"]["kind"] == "points"
    assert len(shapes["motion"]["rows"]) == 6
    assert "route" in shapes
    json.dumps(told[0], allow_nan=False)


def test_the_drawn_route_has_the_length_to_the_goal(told: Any) -> None:
    details, frame, vehicle = told
    way = np.array(details["way"]).reshape(-1, 2)
    length_m = np.hypot(*np.diff(way, axis=0).T).sum()
    (row,) = frame.vehicles[frame.vehicles["id"] == vehicle]
    assert len(way) > 2
    assert length_m == pytest.approx(row["to_go"], abs=10.0)


def test_details_belong_to_the_chosen_world() -> None:
    vec = make_vec("merge", num_envs=2, agents=2, background=4)
    vec.reset(seed=0)
    for _ in range(5):
        vec.step(vec.suggest_actions())
    frame = vec.world_frames([1])[0]
    vehicle = int(vec.worlds.arrays.vehicle_ids[1, 1])
    found = vehicle_details(vec, 1, frame, vehicle, sensors=True)
    terms = vec.worlds.arrays.terms[1, 1]
    assert [value for _, value in found["terms"]] == pytest.approx(terms.tolist(), abs=1e-4)
    assert len(found["observation"]) == vec.single_observation_space.shape[0]
    vec.close()
