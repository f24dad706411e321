"""Loading of the parts of a world from its configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import load_config
from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import load_roads, load_world, load_zones
from cavmarl.env.vector import make_vec
from cavmarl.maps.check import check_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.default_horizon import horizon_of
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_layouts import cut_map
from tests.support.driving import make_simulation, start
from tests.support.netgenerate import netgenerate, random_map


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a grid of five by five roads, 200 m apart."""
    path = tmp_path_factory.mktemp("grid") / "grid.net.xml"
    return netgenerate(path, "--grid", "--grid.number=5", "--grid.length=200")


def ring(layout: str) -> tuple[EnvConfig, Path]:
    config, folder = load_config("ring")
    return replace(config, zones=ZonesConfig(layout=layout)), folder


def test_zones_are_cut_by_the_named_layout() -> None:
    config, folder = ring("bisection")
    network = load_roads(config, folder)
    assert load_zones(config, folder, network).count == 1


def test_zones_are_read_from_a_file_beside_the_entry(tmp_path: Path) -> None:
    config, folder = ring("zones.json")
    network = load_roads(config, folder)
    with pytest.raises(ConfigError, match=r"zones\.layout = 'zones\.json': no file"):
        load_zones(config, tmp_path, network)
    written = cut_map(network, "grid", 1)
    write_zones(tmp_path / "zones.json", written)
    assert load_zones(config, tmp_path, network).content_hash == written.content_hash
    write_zones(tmp_path / "zones.json", cut_map(network, "grid", 4))
    with pytest.raises(ConfigError, match=r"zones\.count = 1: .* has 4 zones; use 4"):
        load_zones(config, tmp_path, network)


def test_worlds_of_the_same_files_share_their_map(tmp_path: Path) -> None:
    network, other = (load_roads(*load_config("merge")) for _ in range(2))
    assert other is network
    # Maps are equal if name and content of their files are equal, in any folder.
    source = load_config("merge")[1] / "map" / "map.net.xml"
    copied, renamed = tmp_path / source.name, tmp_path / "other.net.xml"
    copied.write_bytes(source.read_bytes())
    assert load_world(copied).network is network
    renamed.write_bytes(source.read_bytes())
    assert load_world(renamed).network.name == "other"
    copied.write_bytes(source.read_bytes() + b"\n")
    changed = load_world(copied).network
    assert changed.source_hash != network.source_hash
    assert (load_world("merge").network, load_world(renamed).network.name) == (network, "other")


def test_the_horizon_of_a_bare_map_depends_on_its_size(grid: Path) -> None:
    # The map is 800 m wide and high: 1600 m take 115.2 s at SUMO's 13.89 m/s. Use three times this.
    worlds = [load_world(grid, agents=2, background=3, zones=zones) for zones in (1, 4)]
    assert [world.config.horizon_s for world in worlds] == [350.0, 350.0]
    assert check_map(grid).horizon_s == 350.0
    assert load_world(grid, overrides={"clock.ctrl_dt_s": 0.15}).config.max_steps == 2333


def test_a_configured_horizon_overrides_the_horizon_of_the_map(grid: Path) -> None:
    assert load_world(grid, overrides={"horizon_s": 42.0}).config.horizon_s == 42.0
    assert load_world(grid, max_cycles=30).config.max_steps == 30
    named = {"map.source": str(grid)}
    assert load_world("ring", overrides=named).config.horizon_s == load_config("ring")[0].horizon_s
    followed = load_world("ring", overrides={**named, "horizon_s": 0.0}).config
    assert followed.horizon_s == 350.0


def test_the_horizon_of_a_map_is_from_one_to_fifteen_minutes(grid: Path) -> None:
    network = load_network(grid)
    for side_m, horizon_s in ((50.0, 60.0), (9e3, 900.0)):
        lanes = network.lanes.copy()
        for field in ("min_x", "min_y"):
            lanes[field] = 0.0
        for field in ("max_x", "max_y"):
            lanes[field] = side_m
        assert horizon_of(replace(network, lanes=lanes)) == horizon_s


@pytest.mark.parametrize(
    "number", [*range(3), *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 30))]
)
def test_trips_on_a_bare_map_take_less_than_half_of_the_horizon(
    tmp_path: Path, number: int
) -> None:
    world = make_simulation(random_map(tmp_path, number), mode="respawn", agents=20)
    roads = world.network
    slowest_mps = float(roads.lanes["speed_mps"][~roads.lanes["internal"]].min())
    for seed in range(3):
        start(world, seed)
        to_go = world.vehicles(0)["to_go"]
        assert len(to_go) == 40
        assert (to_go / slowest_mps < 0.5 * world.config.horizon_s).all()


def test_each_process_and_episode_has_the_horizon_of_the_map(grid: Path) -> None:
    settings = {"population.mode": "respawn", "clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 2.0}
    vec = make_vec(grid, num_envs=1, workers=1, agents=1, background=0, overrides=settings)
    try:
        lengths = []
        vec.reset(seed=0)
        for step in range(350):
            _, _, _, _, infos = vec.step(np.zeros((1, 1, 2)))
            if infos["episode_over"].all():
                lengths.append(step + 1)
        assert lengths == [175, 350]
    finally:
        vec.close()
