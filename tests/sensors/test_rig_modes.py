"""Observations that consist of samples of mounted sensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from cavmarl import make_vec, parallel_env
from cavmarl.core.errors import ConfigError

RIG: dict[str, Any] = {
    "wheels": {"type": "odometry", "rate_hz": 10},
    "imu": {"type": "imu", "rate_hz": 100},
    "gnss": {"type": "gnss", "rate_hz": 5},
    "lane": {"type": "lane_boundary", "rate_hz": 20},
    "events": {"type": "collision"},
}
NAMED = {"rig": RIG, "observation.mode": "sensors", "observation.kind": "dict"}
FLAT = {"rig": RIG, "observation.mode": "sensors"}


def _car(overrides: dict[str, Any], **keywords: Any) -> Any:
    return parallel_env("grid4x4", agents=3, background=5, overrides=overrides, **keywords)


def test_an_agent_observes_the_latest_samples() -> None:
    env = _car(NAMED)
    observations, _ = env.reset(seed=0)
    space = env.observation_space("car_0")
    assert isinstance(space, spaces.Dict)
    assert list(space) == sorted(RIG) or list(space) == list(RIG)
    for _ in range(5):
        for agent, seen in observations.items():
            assert space.contains(seen)
            for name, frames in env.frames(agent).items():
                np.testing.assert_array_equal(seen[name].ravel(), frames.data.ravel())
        observations, *_ = env.step(env.suggest_actions())
    assert space["gnss"].dtype == np.float64
    assert space["imu"].shape == (space["imu"].shape[0], 6)


def test_flat_observations_have_the_samples_in_the_order_of_the_rig() -> None:
    named, flat = _car(NAMED), _car(FLAT)
    in_named, in_flat = named.reset(seed=3)[0], flat.reset(seed=3)[0]
    for _ in range(4):
        for agent, seen in in_named.items():
            parts = [np.ravel(seen[name]).astype(np.float32) for name in RIG]
            np.testing.assert_array_equal(in_flat[agent], np.concatenate(parts))
            assert flat.observation_space(agent).contains(in_flat[agent])
        actions = named.suggest_actions()
        in_named, in_flat = named.step(actions)[0], flat.step(actions)[0]
    assert named.state_hash() == flat.state_hash()


@pytest.mark.parametrize("overrides", [NAMED, FLAT])
@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_final_observations_are_those_of_the_ended_episode(
    overrides: dict[str, Any], mode: str
) -> None:
    vec = make_vec(
        "grid4x4", num_envs=2, agents=3, background=5, max_cycles=3, overrides=overrides,
        autoreset_mode=mode,
    )  # fmt: skip
    space = vec.observation_space
    before, _ = vec.reset(seed=5)
    assert _same(space, before)
    for _ in range(3):
        seen, _, _, _, infos = vec.step(vec.suggest_actions())
        assert _same(space, seen)
    assert infos["episode_over"].all()
    final = infos["final_observations"]
    assert _same(space, final)
    first = "gnss" if isinstance(final, dict) else slice(None)
    assert _equal(final[first], seen[first]) == (mode == "NextStep")
    frames, last = vec.frames(), vec.final_frames()
    assert (last["wheels"].stamp_s[..., -1] == 0.6).all() or mode
    assert (frames["wheels"].stamp_s[..., -1] == 0.0).all() == (mode == "SameStep")


def _equal(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other))


def _same(space: Any, seen: Any) -> bool:
    """Return whether observations have the shapes and dtypes of their space."""
    if isinstance(seen, dict):
        return all(_same(space[name], array) for name, array in seen.items())
    return bool(seen.shape == space.shape and seen.dtype == space.dtype)


def test_the_observation_mode_sensors_is_refused_without_a_sensor() -> None:
    with pytest.raises(
        ConfigError, match=r"observation\.mode = 'sensors': needs a sensor under rig"
    ):
        _car({"observation.mode": "sensors"})
