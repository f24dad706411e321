"""Trained drivers on maps with stop signs or a side of traffic that they were not trained on."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.action import ActionConfig
from cavmarl.config.driver_form import form_of_driver
from cavmarl.config.env import EnvConfig, MapConfig
from cavmarl.config.sensors import (
    KinematicsConfig,
    LidarObservationConfig,
    OccupancyGridConfig,
    SensorsConfig,
)
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate import evaluate
from cavmarl.evaluate.evaluation import load_tables
from cavmarl.policies.loading import load_policy
from cavmarl.policies.map_check import UntrainedMapWarning
from cavmarl.policies.other_side import OtherSide
from cavmarl.roads.road_kinds import road_kinds
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate
from tests.support.saved_drivers import save_driver

pytestmark = pytest.mark.integration
GRID = ["--grid", "--grid.number", "3", "--grid.length", "120", "-L", "1", "-j"]
CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}


def world(path: Path, **overrides: Any) -> CavVectorEnv:
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return cavmarl.make_vec(path, num_envs=1, agents=3, background=0, overrides=keys)


@pytest.fixture
def left_hand(tmp_path: Path) -> Path:
    right = netgenerate(tmp_path / "right.net.xml", *GRID, "priority")
    return mirror_net(right, tmp_path / "left.net.xml")


@pytest.mark.parametrize(
    ("junctions", "kinds"),
    [
        ("priority", {"right_hand"}),
        ("traffic_light", {"right_hand"}),
        ("allway_stop", {"right_hand", "stop_signs"}),
        ("priority_stop", {"right_hand", "stop_signs"}),
    ],
)
def test_the_kinds_of_a_map_are_its_side_of_traffic_and_stop_signs(
    tmp_path: Path, junctions: str, kinds: set[str]
) -> None:
    path = netgenerate(tmp_path / "grid.net.xml", *GRID, junctions)
    assert set(road_kinds(world(path).network)) == kinds
    mirror = mirror_net(path, tmp_path / "left.net.xml")
    assert set(road_kinds(world(mirror).network)) == {*kinds - {"right_hand"}, "left_hand"}


def success(path: Path, driver: str, out: Path, **keys: Any) -> float:
    """Evaluate a driver; return the share of trips that arrive without an infraction."""
    traffic = {"traffic.min_trip_m": 150.0, "traffic.max_trip_m": 600.0, "traffic.trip_horizon": 3}
    form = {**form_of_driver(driver), **CLOCK, **traffic, "population.mode": "respawn"}
    with pytest.warns(UntrainedMapWarning) as warned:
        evaluate(
            path, {driver: driver}, out=out, agents=8, background=4, seed=7, episodes=2,
            overrides={**form, "horizon_s": 120.0, **keys},
        )  # fmt: skip
    assert len(warned) == 1, "must be one warning"
    trips = load_tables(out)[driver][0]
    trips = trips[trips["counted"]]
    assert len(trips) > 15
    return float(trips["success"].mean())


@pytest.mark.slow
def test_a_driver_that_gives_way_at_stop_signs_arrives(
    tmp_path: Path,
) -> None:
    path = netgenerate(tmp_path / "stops.net.xml", *GRID, "allway_stop")
    assert success(path, "cities_ippo", tmp_path / "yields") > 0.85
    with pytest.raises(PolicyError, match=r"sensors\.way\.stop_signs is give_way for it, red here"):
        load_policy(
            "cities_ippo",
            world(path, **{**form_of_driver("cities_ippo"), "sensors.way.stop_signs": "red"}),
        )


@pytest.mark.slow
def test_a_driver_of_right_hand_traffic_arrives_in_left_hand_traffic(
    tmp_path: Path, left_hand: Path
) -> None:
    assert success(left_hand, "cities_ippo", tmp_path / "mirrored") > 0.85


def test_a_driver_on_its_own_map_causes_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_policy("tollgate_ippo", cavmarl.make_vec("tollgate", num_envs=1))


def test_each_untrained_kind_of_a_map_is_named_once(tmp_path: Path) -> None:
    path = netgenerate(tmp_path / "stops.net.xml", *GRID, "allway_stop")
    mirror = mirror_net(path, tmp_path / "left.net.xml")
    with pytest.warns(UntrainedMapWarning) as warned:
        load_policy("cities_ippo", world(mirror, **form_of_driver("cities_ippo")))
    said = [str(one.message) for one in warned]
    assert len(said) == 2
    assert "trained in right-hand traffic, but this map has left-hand traffic" in said[0]
    assert "trained on maps without stop signs, but this map has some" in said[1]


def test_a_driver_trained_in_left_hand_traffic_is_not_mirrored_in_left_hand_traffic(
    tmp_path: Path, left_hand: Path
) -> None:
    pytest.importorskip("torch")
    vec = world(left_hand)
    folder = save_driver(tmp_path / "own", vec, maps=("left_hand",))
    assert json.loads((folder / "config.json").read_text())["maps"] == ["left_hand"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        at_home = load_policy(folder, vec)
    other = save_driver(tmp_path / "other", vec)  # equal weights, trained in right-hand traffic
    with pytest.warns(UntrainedMapWarning, match="trained in right-hand traffic"):
        abroad = load_policy(other, vec)
    observations, infos = vec.reset(seed=2)
    exchange = OtherSide(vec.config)
    found = abroad.act_batch(observations, infos["mask"])
    mirrored = at_home.act_batch(exchange.observations(observations), infos["mask"])
    np.testing.assert_array_equal(found, exchange.actions(mirrored))
    assert (found != at_home.act_batch(observations, infos["mask"])).any()


@pytest.mark.parametrize("kinds", [(), ("stop_signs",)])
def test_a_driver_without_a_side_of_traffic_is_refused(
    tmp_path: Path, kinds: tuple[str, ...]
) -> None:
    pytest.importorskip("torch")
    vec = cavmarl.make_vec("merge", num_envs=1)
    with pytest.raises(ConfigError, match="must contain right_hand or left_hand"):
        save_driver(tmp_path / "driver", vec, maps=kinds)


def test_a_driver_with_sensors_that_cannot_be_mirrored_is_refused(
    tmp_path: Path, left_hand: Path
) -> None:
    pytest.importorskip("torch")
    vec = world(left_hand, sensors__lidar_observation__cells=8)
    folder = save_driver(tmp_path / "driver", vec)
    with pytest.raises(
        PolicyError,
        match=r"driver cannot drive on this map: sensors\.lidar_observation: .* use a driver that",
    ):
        load_policy(folder, vec)


def config_of(sensors: SensorsConfig | None = None, **action: Any) -> EnvConfig:
    return EnvConfig(
        "any", MapConfig("any"), sensors=sensors or SensorsConfig(), action=ActionConfig(**action)
    )


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        (SensorsConfig(lidar_observation=LidarObservationConfig(cells=4)), "cannot be exchanged"),
        (
            SensorsConfig(
                kinematics=KinematicsConfig(vehicles_count=2, features_range={"y": (0.0, 9.0)})
            ),
            "the range of y is from 0 to 9",
        ),
        (
            SensorsConfig(
                occupancy_grid=OccupancyGridConfig(
                    features=("presence",), grid_size_m=((-10.0, 10.0), (-10.0, 5.0))
                )
            ),
            "the grid from -10 m to 5 m",
        ),
        (
            SensorsConfig(occupancy_grid=OccupancyGridConfig(features=("vy",), as_image=True)),
            "as_image rounds the values",
        ),
    ],
)
def test_the_error_for_sensors_that_cannot_be_mirrored_gives_the_reason(
    sensors: SensorsConfig, said: str
) -> None:
    with pytest.raises(PolicyError, match=f"{said}.*; use a driver"):
        OtherSide(config_of(sensors))


def test_mirrored_discrete_actions_exchange_left_and_right() -> None:
    discrete = OtherSide(config_of(kind="discrete"))
    np.testing.assert_array_equal(discrete.actions(np.arange(5)), [2, 1, 0, 3, 4])
    action = ActionConfig(kind="grid", grid_throttle=(-1.0, 0.0), grid_steering=(-0.5, 0.0, 0.5))
    grid = OtherSide(
        config_of(kind="grid", grid_throttle=(-1.0, 0.0), grid_steering=(-0.5, 0.0, 0.5))
    )
    for choice, other in enumerate(grid.actions(np.arange(6))):
        throttle, steering = action.pairs[choice]
        assert action.pairs[other] == (throttle, 0.0 - steering)
    with pytest.raises(PolicyError, match="is not symmetric, so that"):
        OtherSide(config_of(kind="grid", grid_steering=(-0.5, 0.0, 0.2)))
