"""Discrete actions from a grid of accelerations and steering angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from cavmarl.adapters.gymnasium_env import CavEgoEnv
from cavmarl.adapters.gymnasium_rows import CavAgentRows
from cavmarl.config.action import ActionConfig
from cavmarl.core.errors import ActionError, PolicyError
from cavmarl.env.actions import ActionDecoder
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.policies.loading import load_policy

GRID = ActionConfig(kind="grid", acceleration_mps2=5.0, steering_rad=0.5)
MEANINGS = [(5.0 * throttle, 0.5 * steering) for throttle, steering in GRID.pairs]
SPACE = spaces.Discrete(35)


def worlds(**overrides: object) -> CavVectorEnv:
    keys = {"action.kind": "grid", "population.mode": "respawn", **overrides}
    return make_vec("merge", num_envs=2, agents=4, background=4, overrides=keys)


def test_each_choice_is_a_pair_of_acceleration_and_steering() -> None:
    choices = np.arange(35).reshape(5, 7)
    decoder = ActionDecoder(GRID, 5, [f"car_{k}" for k in range(7)])
    everyone = np.ones((5, 7), dtype=np.bool_)
    found = decoder.from_array(choices, everyone)
    assert [tuple(pair) for pair in found.controls.reshape(35, 2)] == MEANINGS
    read_only = choices.copy()
    read_only.flags.writeable = False  # arrays that are not writeable are decoded by other code
    again = decoder.from_array(read_only, everyone)
    assert [tuple(pair) for pair in again.controls.reshape(35, 2)] == MEANINGS
    assert (decoder.encode(again.controls) == choices).all()
    assert (decoder.idle().controls == 0.0).all()
    nobody = decoder.from_array(np.full((5, 7), 99), ~everyone)
    assert (nobody.controls == 0.0).all()


def test_a_continuous_action_is_encoded_as_the_nearest_pair() -> None:
    decoder = ActionDecoder(GRID, 1, ["car_0"])
    for wanted, pair in (
        ((0.4, 0.01), (0.0, 0.0)),
        ((-9.0, 0.1), (-5.0, 0.15)),
        ((1.8, -0.7), (2.5, -0.5)),
    ):
        (choice,) = decoder.encode(np.array([[wanted]])).ravel()
        assert MEANINGS[choice] == pytest.approx(pair)


@pytest.mark.parametrize("wrong", [-1, 35])
def test_an_invalid_choice_is_refused(wrong: int) -> None:
    decoder = ActionDecoder(GRID, 1, ["car_0", "car_1"])
    with pytest.raises(ActionError, match=rf"car_1: the action is {wrong}, must be from 0 to 34"):
        decoder.from_array(np.array([[0, wrong]]), np.ones((1, 2), dtype=np.bool_))


def test_every_kind_of_environment_has_the_discrete_action_space() -> None:
    chosen = {"action.kind": "grid"}
    assert worlds().single_action_space == SPACE
    assert parallel_env("merge", overrides=chosen).action_space("car_0") == SPACE
    assert CavEgoEnv("merge", action_kind="grid").action_space == SPACE
    rows = CavAgentRows("merge", num_envs=16, action_kind="grid")
    assert rows.single_action_space == SPACE
    rows.close()


def test_a_choice_has_the_effect_of_its_continuous_action() -> None:
    grid = worlds()
    fine = worlds(**{"action.kind": "continuous"})
    for vec in (grid, fine):
        vec.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        choices = rng.integers(0, 35, (2, 4))
        grid.step(choices)
        fine.step(np.array(GRID.pairs)[choices])
        assert [grid.state_hash(w) for w in (0, 1)] == [fine.state_hash(w) for w in (0, 1)]


def test_the_built_in_driver_arrives_with_actions_from_the_grid() -> None:
    vec = worlds()
    observations, infos = vec.reset(seed=0)
    driver = load_policy("idm", vec)
    driver.reset(0)
    arrived = left = 0
    for _ in range(300):
        actions = driver.act_batch(observations, infos["mask"])
        assert actions.dtype == np.int64
        observations, _, _, _, infos = vec.step(actions)
        left += int(infos["vehicle_done"].sum())
        arrived += int(infos["terms"][..., 8][infos["vehicle_done"]].sum())
    assert left > 10
    assert arrived >= 0.9 * left


def test_a_network_trained_on_another_grid_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra: train")
    from cavmarl.learning.actor_critic import ActorCritic, save_network
    from cavmarl.networks.network_files import NetworkConfig

    vec = worlds()
    config = NetworkConfig("merge", 105, vec.config.sensors, vec.config.action, (8,))
    save_network(tmp_path, ActorCritic(config), config)
    observations, infos = vec.reset(seed=0)
    actions = load_policy(tmp_path, vec).act_batch(observations, infos["mask"])
    assert vec.action_space.contains(actions)
    with pytest.raises(PolicyError, match=r"action\.grid_steering"):
        load_policy(tmp_path, worlds(**{"action.grid_steering": [0.0, 0.1]}))
    with pytest.raises(PolicyError, match=r"action\.kind is grid for it, discrete here"):
        load_policy(tmp_path, worlds(**{"action.kind": "discrete"}))
