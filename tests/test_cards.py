from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import cavmarl
from cavmarl.cli.output import parse_settings
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import agent_entries, entries, load_config
from cavmarl.config.sensors import (
    ConflictsConfig,
    EgoConfig,
    HistoryConfig,
    KinematicsConfig,
    LanesConfig,
    LidarConfig,
    LidarObservationConfig,
    MessagesConfig,
    NeighborsConfig,
    OccupancyGridConfig,
    RouteAheadConfig,
    SensorsConfig,
    SignalAheadConfig,
    WayConfig,
)
from cavmarl.engine.spaces import flat_observation_space, observation_table
from cavmarl.networks.network_files import read_network_config
from cavmarl.policies.loading import driver_keys
from cavmarl.roads.road_kinds import road_kinds
from cavmarl.sensors.observed import SENSORS, layout
from cavmarl.sensors.observed.readings import readings_of, readings_table
from tests.support.generated import check_block

ROOT = Path(__file__).parent.parent
TRAINED = {name: path for name, path in agent_entries().items() if path.is_dir()}

OFF = SensorsConfig(
    ego=EgoConfig(enabled=False),
    route=RouteAheadConfig(points=0),
    neighbors=NeighborsConfig(count=0),
    signal=SignalAheadConfig(enabled=False),
    lidar=LidarConfig(rays=0),
    kinematics=KinematicsConfig(vehicles_count=1),  # one sensor must be on
)

# Sensors that are off in the environments, with their default settings.
OPTIONAL = (
    replace(OFF, kinematics=KinematicsConfig(vehicles_count=5)),
    replace(
        OFF,
        kinematics=KinematicsConfig(),
        occupancy_grid=OccupancyGridConfig(features=("presence", "vx", "vy", "on_road")),
    ),
    replace(OFF, kinematics=KinematicsConfig(), lidar_observation=LidarObservationConfig(cells=16)),
)


def optional_table() -> str:
    """Return one table of all sensors in `OPTIONAL`; the indices of each one begin at 0."""
    head, *rows = observation_table(OPTIONAL[0]).split("\n", 1)
    for config in OPTIONAL[1:]:
        rows.append(observation_table(config).split("\n", 2)[2])
    return "\n".join([head, *rows])


@pytest.mark.parametrize(
    "page",
    ["docs/reference/environments.md", *(f"envs/{name}/README.md" for name in sorted(entries()))],
)
def test_a_page_has_the_table_of_optional_sensors(page: str) -> None:
    check_block(ROOT / page, "optional sensors", optional_table())


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_has_the_table_of_observations(name: str) -> None:
    config, base_dir = load_config(name)
    check_block(base_dir / "README.md", "observation table", observation_table(config.sensors))


@pytest.mark.parametrize("name", sorted(entries()))
def test_the_card_of_an_environment_has_the_sources_of_observations(name: str) -> None:
    config, base_dir = load_config(name)
    check_block(base_dir / "README.md", "reads", readings_table(readings_of(config.sensors)))


@pytest.mark.parametrize("name", TRAINED)
def test_the_card_of_a_driver_has_the_sources_of_its_observations(name: str) -> None:
    config = read_network_config(TRAINED[name])
    readings = readings_of(config.sensors, config.residual)
    check_block(TRAINED[name] / "README.md", "reads", readings_table(readings))


def test_a_residual_driver_reads_the_state_of_the_world() -> None:
    config = read_network_config(TRAINED["cities_residual"])
    alone, residual = (readings_of(config.sensors, residual) for residual in (False, True))
    (added,) = [reading for reading in residual if reading not in alone]
    assert added.source == "world's state"
    assert "positions and plans of all vehicles" in added.what


@pytest.mark.parametrize("name", TRAINED)
def test_a_driver_was_trained_on_the_kinds_of_map_of_its_environment(
    name: str,
) -> None:
    config = read_network_config(TRAINED[name])
    network = cavmarl.make_vec(config.environment, num_envs=1).network
    assert set(road_kinds(network)) <= set(config.maps)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"signal": SignalAheadConfig(timing=True)}, "exact time until the next signal"),
        ({"way": WayConfig(lines=1, timing=True)}, "exact time until the signals on its path"),
        ({"conflicts": ConflictsConfig(count=1, indicators=True)}, "the next turn of vehicles"),
        ({"lanes": LanesConfig(range_m=50.0)}, "the paths of vehicles on other lanes"),
    ],
)
def test_plans_of_other_vehicles_and_signal_times_are_state_of_the_world(
    settings: dict[str, Any], said: str
) -> None:
    readings = readings_of(replace(OFF, **settings))
    assert any(one.source == "world's state" and said in one.what for one in readings)
    assert not any(one.source == "world's state" for one in readings_of(OFF))


@pytest.mark.parametrize("name", ["cities_sensed", "cities_test", "cities_test_left"])
def test_the_environments_of_sensed_drivers_do_not_use_the_state_of_the_world(
    name: str,
) -> None:
    sensors = load_config(name)[0].sensors
    readings = readings_of(sensors)
    assert {one.source for one in readings} == {"own vehicle", "ideal sensors", "map"}
    assert sensors == load_config("cities_sensed")[0].sensors
    features = [feature.name for sensor in SENSORS for feature in sensor.features(sensors)]
    assert {"line_stop_0", "turn_0"} < set(features)
    assert not any("change_" in name and name.startswith("line") for name in features)


def test_the_training_of_cities_sensed_has_the_sensors_of_its_environment() -> None:
    """The run starts from a driver with other sensors, so its settings must change them."""
    given: Any = read_yaml(ROOT / "configs/train/cities_sensed.yaml")
    overrides = driver_keys(given["start"]) | parse_settings(given["settings"].split(","))
    sensors = load_config(given["env"], overrides=overrides)[0].sensors
    assert sensors == load_config(given["env"])[0].sensors


def test_indicators_near_a_junction_are_not_state_of_the_world() -> None:
    conflicts = ConflictsConfig(count=1, indicators=True, indicators_m=40.0)
    readings = readings_of(replace(OFF, conflicts=conflicts))
    assert not any(one.source == "world's state" for one in readings)
    assert any("indicators of these vehicles, up to 40 m" in one.what for one in readings)


def test_each_sensor_lists_the_sources_of_its_features() -> None:
    config = SensorsConfig(
        lanes=LanesConfig(range_m=50.0),
        kinematics=KinematicsConfig(vehicles_count=2),
        occupancy_grid=OccupancyGridConfig(features=("presence",)),
        lidar_observation=LidarObservationConfig(cells=4),
        messages=MessagesConfig(objects=1),
        way=WayConfig(lines=1),
        conflicts=ConflictsConfig(count=1),
        history=HistoryConfig(steps=1),
    )
    assert set(layout(config)) == {sensor.name for sensor in SENSORS}
    assert all(sensor.reads(config) for sensor in SENSORS)


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_has_a_picture_of_its_environment(name: str) -> None:
    _, base_dir = load_config(name)
    assert f"](../../docs/images/{name}.png)" in (base_dir / "README.md").read_text("utf-8")
    assert (ROOT / "docs" / "images" / f"{name}.png").stat().st_size > 5_000


@pytest.mark.parametrize("name", sorted(entries()))
def test_the_layout_covers_the_observation_without_gaps(name: str) -> None:
    config, _ = load_config(name)
    places = list(layout(config.sensors).values())
    assert [place.start for place in places] == [0, *(place.stop for place in places[:-1])]
    assert flat_observation_space(config).shape == (places[-1].stop,)
    assert places[-1].stop == sum(len(sensor.features(config.sensors)) for sensor in SENSORS)
