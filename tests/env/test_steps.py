"""The number of steps of an episode, and actions with negative zeros."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl import ConfigError, make_vec, parallel_env


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
def test_max_cycles_can_be_reduced_later(mode: str) -> None:
    env = parallel_env("ring", agents=3, max_cycles=20, overrides={"population.mode": mode})
    env.max_cycles = 7
    for seed in range(2):
        env.reset(seed=seed)
        steps = 0
        while env.agents:
            *_, truncations, _ = env.step({a: env.action_space(a).sample() for a in env.agents})
            steps += 1
        assert steps <= 7
        if mode == "respawn":
            assert steps == 7
            assert all(truncations.values())
    for wrong in (0, 21, 3.0, None):
        with pytest.raises(ConfigError, match=r"from 1 to 20.*max_cycles to parallel_env"):
            env.max_cycles = wrong  # type: ignore[assignment]
    assert env.max_cycles == 7


def test_negative_zero_equals_zero_in_actions() -> None:
    hashes = set()
    for zero in (0.0, -0.0):
        env = parallel_env("ring", agents=2, background=0)
        env.reset(seed=0)
        env.step({agent: np.full(2, zero, np.float32) for agent in env.agents})
        vec = make_vec("ring", num_envs=1, agents=2, background=0)
        vec.reset(seed=0)
        vec.step(np.full(vec.action_space.shape, zero, np.float32))
        hashes |= {env.simulation.state_hash(), vec.state_hash(0)}
    assert len(hashes) == 1
