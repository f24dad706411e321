"""Signals as rows for stable-baselines3: equality with their worlds, and training."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import make_vec

sb3 = pytest.importorskip("stable_baselines3")

KEYS = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 2.5, "horizon_s": 40.0}


def make(env: str = "grid4x4", **more: Any) -> Any:
    from cavmarl.adapters.sb3_signal_env import CavSb3SignalEnv

    keys = {"background": 60, "overrides": KEYS, **more}
    return CavSb3SignalEnv(env, num_worlds=2, **keys)


def test_a_step_lasts_until_the_next_decision() -> None:
    vec = make_vec(
        "grid4x4",
        num_envs=2,
        agents=0,
        background=60,
        overrides=KEYS | {"signals.agents": "all"},
    )
    rows = make()
    with closing(vec), closing(rows):
        rows.seed(3)
        seen = rows.reset()
        expected, _ = vec.reset(seed=3)
        assert seen.shape == (32, rows.observation_space.shape[0])
        np.testing.assert_array_equal(seen, expected["signals"].reshape(32, -1))
        rng = np.random.default_rng(0)
        ends = 0
        for _ in range(20):
            actions = rng.integers(0, 2, 32)
            seen, rewards, done, infos = rows.step(actions)
            total = np.zeros((2, 16), np.float32)
            over = np.zeros((2, 16), np.bool_)
            for _ in range(2):  # a decision every 5 s lasts two steps of the worlds
                expected, gained, _, truncated, _ = vec.step({"signals": actions.reshape(2, 16)})
                total += gained["signals"]
                over |= truncated["signals"]
            np.testing.assert_array_equal(seen, expected["signals"].reshape(32, -1))
            np.testing.assert_array_equal(rewards, total.reshape(-1))
            np.testing.assert_array_equal(done, over.reshape(-1))
            np.testing.assert_array_equal(infos[5]["action_mask"], rows.action_masks()[5])
            for row in np.flatnonzero(done):
                assert infos[row]["TimeLimit.truncated"]
                assert infos[row]["terminal_observation"].shape == seen[row].shape
            ends += done.sum()
        assert ends == 2 * 32


def test_an_action_beyond_the_number_of_greens_keeps_the_green() -> None:
    beyond, kept = make(), make()
    with closing(beyond), closing(kept):
        for rows in (beyond, kept):
            rows.seed(1)
            rows.reset()
        for _ in range(5):
            one, other = beyond.step(np.full(32, 7)), kept.step(np.zeros(32, int))
            np.testing.assert_array_equal(one[0], other[0])


def test_ppo_learns_from_the_rows() -> None:
    rows = make()
    with closing(rows):
        model = sb3.PPO("MlpPolicy", rows, n_steps=8, batch_size=64, n_epochs=1, device="cpu")
        model.learn(8 * 32)
        assert model.num_timesteps == 8 * 32


def test_sizes_count_features_of_greens_and_spread_worlds_start_at_different_times() -> None:
    with pytest.raises(ConfigError, match="features"):
        make(features="cars")
    with closing(make()) as rows, pytest.raises(ConfigError, match="sizes"):
        assert rows.sizes
    rows = make(features="greens", spread=True)
    with closing(rows):
        rows.seed(2)
        seen = rows.reset()
        greens, others = rows.sizes
        assert greens == 2
        assert others == 5 + 16
        assert rows.observation_space.contains(seen[0])
        assert rows.get_attr("signals")[0].view.ticks.tolist() == [0, 200]
        done = np.zeros(32, np.bool_)
        for _ in range(8):
            _, _, ended, infos = rows.step(np.zeros(32, int))
            done |= ended
            for row in np.flatnonzero(ended):
                assert infos[row]["terminal_observation"].shape == seen[row].shape
        assert done.all()


def test_arguments_that_the_adapter_sets_are_refused() -> None:
    with pytest.raises(ConfigError, match="autoreset_mode"):
        make(autoreset_mode="next_step")
    with pytest.raises(ConfigError, match="no signal of this map"):
        make("merge")
