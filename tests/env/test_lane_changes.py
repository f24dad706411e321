"""Roads that the caller closes or damages: equal in all divisions, saved, recorded, observed."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CapacityError, ConfigError, make_vec, parallel_env
from cavmarl.sensors.observed import feature_names
from tests.support.saved_midway import check_resumed

ROOM = {"map.changed_lanes": 40}


def damage(env: Any, step: int) -> None:
    """Damage and repair roads at some steps."""
    if step == 3:
        for edge in ("B1B2", "B2B1", "B1C1", "C1B1"):
            env.damage_road(edge, 3.0)
    if step == 8:
        env.damage_road("A1B1", 2.5, lanes=[0])
    if step == 20:
        env.damage_road("B1B2", 13.89)


def hashes(act: Any = damage, overrides: dict[str, Any] = ROOM, **more: Any) -> list[str]:
    with closing(
        parallel_env("grid4x4", agents=3, background=40, overrides=overrides, **more)
    ) as env:
        env.reset(seed=2)
        found = []
        for step in range(40):
            act(env, step)
            env.step(env.suggest_actions())
            if step % 5 == 4:
                found.append(env.state_hash())
        return found


def test_a_divided_world_with_limits_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=4) == undivided
    assert hashes(zones=4, workers=2) == undivided
    assert hashes(act=lambda env, step: None) != undivided


@pytest.mark.slow
def test_worlds_with_limits_over_nodes_are_equal() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_saved_states_include_limits() -> None:
    check_resumed(damage, ROOM, at=12, steps=30)


def test_drivers_and_sensors_have_the_limit_of_their_world() -> None:
    room = {"map.changed_lanes": 480}
    with closing(make_vec("grid4x4", num_envs=2, background=30, overrides=room)) as vec:
        vec.reset(seed=1)
        for edge in road_ids(vec):
            vec.damage_road(edge, 3.0, world=1)
        for _ in range(150):
            observations = vec.step(vec.suggest_actions())[0]
        limit = feature_names(vec.config.sensors).index(("ego", "speed_limit"))
        inside = vec.network.lanes["internal"]
        for world, most_mps in ((0, 13.89), (1, 3.0)):
            rows = vec.simulation.vehicles(world)
            rows = rows[~inside[rows["lane"]]]
            assert rows["speed"].max() <= 1.2 * most_mps
            own = rows[rows["agent"] >= 0]
            seen = observations.reshape(2, -1, observations.shape[-1])[world, own["agent"], limit]
            assert np.allclose(seen, most_mps / 40.0)
        assert vec.simulation.vehicles(0)["speed"].max() > 6.0


def test_impossible_limits_are_refused_with_a_fix() -> None:
    with closing(parallel_env("grid4x4", overrides={"map.changed_lanes": 3})) as env:
        env.reset(seed=1)
        with pytest.raises(ActionError, match="edge 'Z9': the map has no such road; give the id"):
            env.damage_road("Z9", 3.0)
        for speed_mps in (0.0, -1.0, 13.9, float("nan")):
            with pytest.raises(ActionError, match="give a speed above 0 and at most that"):
                env.damage_road("B1B2", speed_mps)
        with pytest.raises(ActionError, match="has the lanes 0 to 1, from the kerb"):
            env.damage_road("B1B2", 3.0, lanes=[2])
        with pytest.raises(ActionError, match="world 1: must be from 0 to 0"):
            env.damage_road("B1B2", 3.0, world=1)
        env.damage_road("B1B2", 3.0)
        with pytest.raises(CapacityError, match=r"map\.changed_lanes = 3; set it higher"):
            env.damage_road("B2B1", 3.0)
    with closing(parallel_env("grid4x4")) as env:
        env.reset(seed=1)
        with pytest.raises(ConfigError, match=r"set map\.changed_lanes"):
            env.damage_road("B1B2", 3.0)


def road_ids(env: Any) -> list[str]:
    """Return the ids of all roads."""
    network = env.network
    return [network.edge_ids[row] for row in np.flatnonzero(~network.edges["internal"]).tolist()]
