"""Mounted sensors: schedules, stamps, reset, losses, and that no division changes a sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.vector_env import CavVectorEnv

WHEELS = {"type": "odometry", "rate_hz": 20, "noise": [0.1, 0.01, 0.5], "bias": [0.05]}
RIG = {
    "wheels": WHEELS,
    "slow": {"type": "odometry", "rate_hz": 4, "phase_ticks": 2, "dropout": 0.3},
    "fast": {"type": "odometry", "rate_hz": 100},
    "odd": {"type": "odometry", "rate_hz": 3, "schedule": "accumulate"},
}


def _drive(vec: CavVectorEnv, steps: int = 12) -> list[list[bytes]]:
    """All frames and hashes of some steps."""
    vec.reset(seed=7)
    seen = []
    for _ in range(steps):
        vec.step(vec.suggest_actions())
        arrays = [array.tobytes() for frames in vec.frames().values() for array in frames]
        hashes = [vec.state_hash(w).encode() for w in range(vec.num_envs)]
        seen.append(arrays + hashes)
    return seen


def _make(**keywords: Any) -> CavVectorEnv:
    return make_vec("grid4x4", agents=12, background=20, overrides={"rig": RIG}, **keywords)


@pytest.mark.parametrize("zones", [2, 4, 9])
def test_samples_do_not_depend_on_zones(zones: int) -> None:
    assert _drive(_make(zones=zones)) == _drive(_make(zones=1))


def test_samples_do_not_depend_on_workers() -> None:
    alone = _drive(_make(num_envs=2))
    vec = _make(num_envs=2, workers=2)
    try:
        assert _drive(vec) == alone
    finally:
        vec.close()


def test_a_minute_has_as_many_samples_as_the_rate_says() -> None:
    vec = make_vec("merge", agents=1, background=0, overrides={"rig": RIG, "horizon_s": 60.0})
    vec.reset(seed=0)
    rates = {"wheels": 20, "slow": 4, "fast": 100, "odd": 3}
    counts = {name: int(frames.fresh[0, 0]) for name, frames in vec.frames().items()}
    stamps = dict.fromkeys(rates, -1.0)
    over = False
    while not over:
        *_, infos = vec.step(vec.suggest_actions())
        over = bool(infos["episode_over"][0])
        if over:
            break
        for name, frames in vec.frames().items():
            count = int(frames.fresh[0, 0])
            counts[name] += count
            if count:
                new = frames.stamp_s[0, 0, -count:]
                assert (np.diff(new) > 0).all()
                assert new[0] > stamps[name]
                stamps[name] = float(new[-1])
