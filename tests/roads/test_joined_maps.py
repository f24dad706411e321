"""Environments with several maps: each world draws one of them by its seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavVectorEnv, make_vec
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.core.math.rng import world_key
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.joined_maps import POINTERS, join
from cavmarl.roads.kernels.map_choice import map_of
from cavmarl.verify.equivalence import verify_zones
from tests.support.traffic import network

MAPS = [f"map/{name}.net.xml.gz" for name in ("roundabouts", "grid_two_lanes", "spider_two_lanes")]
OVERRIDES: dict[str, Any] = {"map.source": MAPS, "horizon_s": 8.0}


def drive(vec: CavVectorEnv, steps: int) -> list[str]:
    """Return the state hashes of all worlds after some steps."""
    vec.reset(seed=5)
    actions = np.zeros((vec.num_envs, vec.num_agents, 2), dtype=np.float32)
    actions[:, :, 0] = 0.2
    for _ in range(steps):
        vec.step(actions)
    return [vec.worlds.state_hash(world) for world in range(vec.num_envs)]


def maps_of(vec: CavVectorEnv) -> list[set[int]]:
    """Return the maps on which each world has vehicles."""
    on = vec.network.lanes["map"]
    simulation = vec.simulation
    return [set(on[simulation.vehicles(w)["lane"]].tolist()) for w in range(vec.num_envs)]


def test_each_episode_of_each_world_draws_its_map_by_the_seed() -> None:
    vec = make_vec("cities", num_envs=6, agents=4, background=4, overrides=OVERRIDES)
    seen = set()
    for episode in range(3):
        vec.reset(seed=3) if episode == 0 else vec.reset()
        for world, found in enumerate(maps_of(vec)):
            assert found == {map_of(np.uint64(world_key(3, world, episode)), 3)}
            seen |= found
    assert seen == {0, 1, 2}
    vec.reset(seed=3)
    first = [vec.worlds.state_hash(world) for world in range(6)]
    vec.reset()
    vec.reset(seed=3)
    assert [vec.worlds.state_hash(world) for world in range(6)] == first


def test_worlds_on_workers_have_the_same_states() -> None:
    settings: dict[str, Any] = {"agents": 4, "background": 4, "overrides": OVERRIDES}
    here = make_vec("cities", num_envs=4, **settings)
    there = make_vec("cities", num_envs=4, workers=2, **settings)
    try:
        assert drive(here, 60) == drive(there, 60)  # 40 steps per episode
    finally:
        there.close()
    alone = make_vec("cities", num_envs=1, **settings)
    here.reset(seed=5)
    alone.reset(seed=5, options={"first_world": 2})
    assert alone.worlds.state_hash(0) == here.worlds.state_hash(2)


def test_a_divided_world_equals_the_undivided_world() -> None:
    found = verify_zones("cities", (4, 9), steps=90, worlds=2, overrides=OVERRIDES)
    assert [result.difference for result in found.results] == [None, None]
    assert sum(result.crossings for result in found.results) > 10


def test_a_list_of_one_map_equals_the_map() -> None:
    plain, listed = (
        make_vec("ring", seed=1, overrides={"map.source": source})
        for source in ("map/map.net.xml", ["map/map.net.xml"])
    )
    for vec in (plain, listed):
        vec.reset()
    assert plain.worlds.state_hash(0) == listed.worlds.state_hash(0)


def test_rows_of_a_map_point_to_rows_of_the_same_map() -> None:
    parts = [network("ring"), network("grid4x4"), network("ring")]
    whole = join(parts)
    assert len(set(whole.map_names)) == 3
    starts = {key: np.cumsum([0, *(len(getattr(part, key)) for part in parts)]) for key in POINTERS}
    for key, fields in POINTERS.items():
        for number, part in enumerate(parts):
            rows = slice(starts[key][number], starts[key][number + 1])
            for field, target in fields.items():
                own, moved = getattr(part, key), getattr(whole, key)[rows]
                if field:
                    own, moved = own[field], moved[field]
                assert np.array_equal(
                    np.where(own >= 0, own + starts[target][number], own), moved
                ), (key, field)
    for number, part in enumerate(parts):
        first = whole.maps[number]["first_lane"]
        for lane in (0, len(part.lanes) - 1):
            moved = whole.lane_polyline(first + lane) - part.lane_polyline(lane)
            assert np.allclose(moved, moved[0], atol=1e-9)
    extents = [whole.extent_of(number) for number in range(3)]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        apart = max(
            max(extents[one][axis], extents[other][axis])
            - min(extents[one][axis + 2], extents[other][axis + 2])
            for axis in (0, 1)
        )
        assert apart >= 1000.0


def test_errors_of_several_maps_are_reported_in_one_message(tmp_path: Path) -> None:
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net>")
    sources = [MAPS[0], str(broken), "map/nowhere.net.xml"]
    with pytest.raises(MapError, match="nowhere"):
        load_world("cities", overrides={"map.source": sources})
    other = tmp_path / "other.net.xml"
    other.write_text("<nets/>")
    with pytest.raises(MapError) as caught:
        load_world("cities", overrides={"map.source": [str(broken), MAPS[0], str(other)]})
    assert "broken.net.xml" in str(caught.value)
    assert "other.net.xml" in str(caught.value)


def test_the_error_for_impossible_trips_names_all_maps() -> None:
    with pytest.raises(ConfigError) as caught:
        make_vec("cities", overrides={**OVERRIDES, "traffic.min_trip_m": 9000.0,
                                      "traffic.max_trip_m": 0.0})  # fmt: skip
    for name in ("roundabouts", "grid_two_lanes", "spider_two_lanes"):
        assert name in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("traffic.origins", ["a"]),
        ("traffic.demand", ["a.rou.xml"]),
        ("map.buildings", "osm"),
        ("scenario.name", "road_closure"),
    ],
)
def test_settings_of_a_single_map_are_refused_with_several_maps(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"{key}.*several"):
        load_world("cities", overrides={**OVERRIDES, key: value})


def test_a_folder_without_maps_or_a_missing_source_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no map file"):
        load_world("cities", overrides={"map.source": str(tmp_path)})
    with pytest.raises(ConfigError, match="source"):
        load_world("cities", overrides={"map.source": []})
    with pytest.raises(ConfigError, match="source"):
        load_world("cities", overrides={"map.source": 3})
