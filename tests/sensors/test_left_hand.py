"""Observations in left-hand traffic are mirror images of those in right-hand traffic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cavmarl
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.loading import driver_keys, load_policy
from cavmarl.policies.map_check import UntrainedMapWarning
from cavmarl.policies.other_side import OtherSide
from cavmarl.sensors.observed import feature_names, sensors_of
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

GRID = ["--grid", "--grid.number", "3", "--grid.length", "120", "-L", "2", "-j", "traffic_light"]
SETTINGS = {
    "sensors.lanes.range_m": 80.0,
    "sensors.signal.timing": True,
    "sensors.way.distances_m": [5.0, 15.0, 30.0],
    "sensors.way.lines": 2,
    "sensors.way.timing": True,
    "rig": {"lane": {"type": "lane_boundary", "rate_hz": 5}},
}
LIKE = ("ego", "route", "signal", "lanes", "way")  # sensors whose rows are not ordered by distance
TURNED = ("y", "left", "curvature", "lateral_offset", "heading_error", "steering", "yaw_rate")
STEPS = 40


EVERY = {
    **SETTINGS,
    "sensors.ego.size": True,
    "sensors.signal.stop_signs": "own",
    "sensors.way.stop_signs": "own",
    "sensors.lidar.rays": 12,
    "sensors.lidar.speeds": True,
    "sensors.kinematics.vehicles_count": 4,
    "sensors.kinematics.features": ["presence", "x", "y", "vx", "vy", "sin_h", "lat_off"],
    "sensors.occupancy_grid.features": ["presence", "vx", "vy", "on_road"],
    "sensors.occupancy_grid.grid_size_m": [[-20.0, 20.0], [-21.0, 21.0]],
    "sensors.occupancy_grid.grid_step_m": [5.0, 6.0],
    "sensors.messages.objects": 3,
    "sensors.messages.signal": True,
    "sensors.conflicts.count": 4,
    "sensors.conflicts.indicators": True,
    "sensors.history.steps": 2,
    "sensors.stack": 2,
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
}


def mirror_of(names: list[str]) -> tuple[list[int], NDArray[np.float64]]:
    """Return the index of each feature in the mirrored world, and the factor 1 or -1."""
    sides = str.maketrans({"<": "right_", ">": "left_"})
    other = [name.replace("left_", "<").replace("right_", ">").translate(sides) for name in names]
    stems = [name.rstrip("_0123456789") for name in names]
    where = [
        names.index(name if stem in TURNED else swapped)
        for name, stem, swapped in zip(names, stems, other, strict=True)
    ]
    return where, np.array([-1.0 if stem in TURNED else 1.0 for stem in stems])


def both_worlds(
    folder: Path, overrides: dict[str, Any], junctions: str = "traffic_light"
) -> tuple[CavVectorEnv, CavVectorEnv]:
    """Return a world in right-hand traffic and its mirror image in left-hand traffic.

    All vehicles are agents, because background vehicles prefer one side for lane changes.
    """
    plain = netgenerate(folder / "right.net.xml", *GRID[:-1], junctions)
    mirror = mirror_net(plain, folder / "left.net.xml")
    right, left = (
        cavmarl.make_vec(path, agents=24, background=0, overrides=overrides)
        for path in (plain, mirror)
    )
    return right, left


@pytest.mark.parametrize("junctions", ["traffic_light", "allway_stop"])
def test_observations_with_exchanged_sides_equal_those_of_the_mirrored_world(
    tmp_path: Path, junctions: str
) -> None:
    overrides = EVERY
    if junctions == "allway_stop":
        overrides = {name: value for name, value in EVERY.items() if "roadside" not in name}
    right, left = both_worlds(tmp_path, overrides, junctions)
    exchange = OtherSide(right.config)
    names = feature_names(right.config.sensors) * right.config.sensors.stack
    seen, other = right.reset(seed=3)[0], left.reset(seed=3)[0]
    turned = np.zeros(len(names), dtype=np.bool_)
    for _ in range(STEPS):
        mirrored = exchange.observations(other)
        np.testing.assert_allclose(seen, mirrored, atol=1e-12)
        np.testing.assert_array_equal(exchange.observations(mirrored), other)
        turned |= (np.abs(seen - other) > 1e-6).any(axis=(0, 1))
        actions = right.suggest_actions()
        seen, other = right.step(actions)[0], left.step(exchange.actions(actions))[0]
    sensors = {names[k][0] for k in np.flatnonzero(turned)}
    assert sensors >= {"ego", "route", "neighbors", "lanes", "lidar", "kinematics"}
    assert sensors >= {"occupancy_grid", "messages", "way", "conflicts", "history"}
    right.close()
    left.close()


@pytest.mark.parametrize("driver", ["cities_ippo", "cities_residual", "merge_ippo"])
def test_a_trained_driver_drives_mirror_images_in_the_mirrored_world(
    tmp_path: Path, driver: str
) -> None:
    clock = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
    right, left = both_worlds(tmp_path, {**driver_keys(driver), **clock})
    here = load_policy(driver, right)
    with pytest.warns(UntrainedMapWarning, match="trained in right-hand traffic, but") as warned:
        there = load_policy(driver, left)
    assert len(warned) == 1
    assert warned[0].filename == __file__
    seen, infos = right.reset(seed=5)
    other, others = left.reset(seed=5)
    steered = 0.0
    for _ in range(STEPS):
        np.testing.assert_array_equal(infos["mask"], others["mask"])
        mine, its = here.act_batch(seen, infos["mask"]), there.act_batch(other, others["mask"])
        np.testing.assert_array_equal(mine, its * np.float32([1.0, -1.0]))
        steered = max(steered, float(np.abs(mine[..., 1]).max()))
        seen, _, _, _, infos = right.step(mine)
        other, _, _, _, others = left.step(its)
    assert steered > 0.02
    right.close()
    left.close()


def test_features_of_route_and_lanes_are_mirrored(tmp_path: Path) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID)
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    right, left = (
        cavmarl.make_vec(path, agents=9, background=20, overrides=SETTINGS)
        for path in (plain, mirror)
    )
    config = right.config.sensors
    named = [(s.name, f.name) for s in sensors_of(config) for f in s.features(config)]
    chosen = [k for k, (sensor, _) in enumerate(named) if sensor in LIKE]
    where, sign = mirror_of([named[k][1] for k in chosen])
    seen, other = right.reset(seed=3)[0], left.reset(seed=3)[0]
    different = np.zeros(len(chosen), dtype=np.bool_)
    for _ in range(STEPS):
        np.testing.assert_allclose(
            seen[..., chosen], (other[..., chosen] * sign)[..., where], atol=1e-4
        )
        lane, mirrored = (vec.frames()["lane"].data[:, :, -1] for vec in (right, left))
        turned = mirrored[..., [1, 0, 2, 3, 4]] * [1.0, 1.0, 1.0, -1.0, -1.0]
        np.testing.assert_allclose(lane, turned, atol=1e-3)
        different |= (seen != other)[..., chosen].any(axis=(0, 1))
        seen = right.step(right.suggest_actions())[0]
        other = left.step(left.suggest_actions())[0]
    assert different.sum() > 20, "too few features differ between the worlds for a comparison"
    right.close()
    left.close()
