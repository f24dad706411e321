from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cavmarl.config.registry import entries, load_config
from cavmarl.config.sensors import (
    EgoConfig,
    KinematicsConfig,
    LidarConfig,
    LidarObservationConfig,
    NeighborsConfig,
    OccupancyGridConfig,
    RouteAheadConfig,
    SensorsConfig,
    SignalAheadConfig,
)
from cavmarl.engine.spaces import flat_observation_space, observation_table
from cavmarl.sensors.observed import SENSORS, layout
from tests.support.generated import check_block

ROOT = Path(__file__).parent.parent

OFF = SensorsConfig(
    ego=EgoConfig(enabled=False),
    route=RouteAheadConfig(points=0),
    neighbors=NeighborsConfig(count=0),
    signal=SignalAheadConfig(enabled=False),
    lidar=LidarConfig(rays=0),
    kinematics=KinematicsConfig(vehicles_count=1),  # at least one sensor must be on
)

# The sensors that environments switch off, with the default settings of their authors.
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
    """Return one table of the sensors of `OPTIONAL`; the indices of each sensor begin at 0."""
    head, *rows = observation_table(OPTIONAL[0]).split("\n", 1)
    for config in OPTIONAL[1:]:
        rows.append(observation_table(config).split("\n", 2)[2])
    return "\n".join([head, *rows])


@pytest.mark.parametrize(
    "page",
    ["docs/reference/environments.md", *(f"envs/{name}/README.md" for name in sorted(entries()))],
)
def test_a_page_has_the_sensors_that_can_be_switched_on(page: str) -> None:
    check_block(ROOT / page, "optional sensors", optional_table())


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_has_the_observation_index_by_index(name: str) -> None:
    config, base_dir = load_config(name)
    check_block(base_dir / "README.md", "observation table", observation_table(config.sensors))


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_shows_its_world(name: str) -> None:
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
