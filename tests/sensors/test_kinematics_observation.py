"""The table of `kinematics` equals that of highway-env on roads of highway-env."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.sensors import VEHICLE_FEATURES, KinematicsConfig, SensorsConfig
from cavmarl.sensors.kernels.kinematics_observation import observe_kinematics
from cavmarl.sensors.observed import kinematics_sensor as kinematics
from cavmarl.sensors.observed.highway import default_ranges, range_table
from tests.support import highway
from tests.support.traffic import network


def table(
    env: Any, rows: NDArray[np.void], i: int, ranges: dict[str, Any], **config: Any
) -> NDArray[np.float32]:
    """Return the table (vehicles, features) that cavmarl computes for row i."""
    settings = SensorsConfig(kinematics=KinematicsConfig(**config))
    sensor = kinematics.settings(settings, 0, network("ring"), highway.destinations(env))
    if ranges and config.get("normalize", True):
        sensor = sensor._replace(ranges=range_table(ranges))
    out = np.zeros(np.prod(kinematics.shape(settings), dtype=int), np.float32)
    observe_kinematics(highway.roads(env), rows, i, highway.grid_of(rows), sensor, out)
    return out.reshape(kinematics.shape(settings))


def road_ranges(env: Any) -> dict[str, Any]:
    """Return the default ranges of highway-env on the road of its own vehicle."""
    y = 4.0 * len(env.road.network.all_side_lanes(env.vehicle.lane_index))
    return {"x": (-200, 200), "y": (-y, y), "vx": (-80, 80), "vy": (-80, 80)}


# Accepted differences. Curved lanes of cavmarl are polylines of `highway.SAMPLES` points, so the
# heading of a quarter turn has steps of 0.025 rad.
OFFSETS = {"long_off": 0.1, "lat_off": 0.02, "ang_off": 0.0125}

CONFIGS: dict[str, dict[str, Any]] = {
    "default": {},
    "behind": {"vehicles_count": 15, "see_behind": True},
    "absolute": {"vehicles_count": 40, "absolute": True, "clip": False},
    "raw": {"vehicles_count": 8, "normalize": False, "features": VEHICLE_FEATURES},
    "intentions": {"vehicles_count": 8, "observe_intentions": True, "features": VEHICLE_FEATURES},
    "ranges": {
        "vehicles_count": 4,
        "features": ("presence", "heading", "x", "y"),
        "features_range": {"x": (-50.0, 100.0), "heading": (-1.0, 1.0)},
    },
}


@cache
def standing(name: str, seed: int) -> Any:
    """Return an environment of highway-env, which the tests must not step."""
    return highway.make(name, seed)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", ["highway-v0", "merge-v0", "two-way-v0", "intersection-v1"])
@pytest.mark.parametrize("case", CONFIGS)
def test_the_table_equals_that_of_highway_env(name: str, seed: int, case: str) -> None:
    env = standing(name, seed)
    config = {"vehicles_count": 5, "features": KinematicsConfig.features, **CONFIGS[case]}
    theirs = highway.observation(
        env, "Kinematics", **{**config, "features": list(config["features"])}
    )
    ranges = config.get("features_range") or road_ranges(env)
    ours = table(env, highway.vehicles(env), highway.own_row(env), ranges, **config)
    assert ours.shape == theirs.shape
    for column, feature in enumerate(config["features"]):
        np.testing.assert_allclose(
            ours[:, column], theirs[:, column], rtol=1e-6, atol=OFFSETS.get(feature, 0.0)
        )
    assert theirs[1:].any() or name == "intersection-v1", "no vehicle was near"


@pytest.mark.parametrize("seed", range(3))
def test_shuffled_rows_equal_those_of_highway_env_in_another_order(seed: int) -> None:
    env = standing("highway-v0", seed)
    config = {"vehicles_count": 8, "order": "shuffled"}
    theirs = highway.observation(env, "Kinematics", **config)
    rows = highway.vehicles(env)
    ours = table(env, rows, highway.own_row(env), road_ranges(env), **config)
    assert sorted(ours.tolist()) == sorted(theirs.tolist())
    np.testing.assert_array_equal(ours[0], theirs[0])
    rows["tick"] += 1
    later = table(env, rows, highway.own_row(env), road_ranges(env), **config)
    assert sorted(ours.tolist()) == sorted(later.tolist())
    assert not np.array_equal(ours, later)


def test_the_order_of_rows_does_not_matter() -> None:
    env = standing("highway-v0", 0)
    rows = highway.vehicles(env)
    order = np.random.default_rng(0).permutation(len(rows))
    for config in ({"vehicles_count": 9}, {"vehicles_count": 9, "order": "shuffled"}):
        tidy = table(env, rows, 3, {}, **config)
        np.testing.assert_array_equal(
            table(env, rows[order], int(np.flatnonzero(order == 3)[0]), {}, **config), tidy
        )


def test_a_table_of_one_row_describes_the_ego_vehicle() -> None:
    env = standing("highway-v0", 0)
    rows = highway.vehicles(env)
    alone = table(env, rows, 2, {}, vehicles_count=1, normalize=False)
    speed, heading = rows["speed"][2], rows["heading"][2]
    assert alone[0] == pytest.approx(
        [1.0, rows["x"][2], -rows["y"][2], speed * np.cos(heading), -speed * np.sin(heading)]
    )


def test_the_default_range_of_y_is_the_width_of_the_widest_road() -> None:
    assert default_ranges(network("merge"))["y"] == (-12.0, 12.0)
    assert default_ranges(network("ring"))["x"] == (-200.0, 200.0)
