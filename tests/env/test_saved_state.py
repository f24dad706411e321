"""A vector environment goes on bit for bit from bytes, whatever zones and workers run it then."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.env.vector import CavVectorEnv, make_vec

WORLDS, HORIZON = 2, 15


def make(mode: str = "SameStep", num_envs: int = WORLDS, **arguments: Any) -> CavVectorEnv:
    return make_vec(
        "ring",
        num_envs=num_envs,
        agents=3,
        background=4,
        max_cycles=HORIZON,
        autoreset_mode=mode,
        **arguments,
    )


def drive(vec: CavVectorEnv, steps: range) -> list[bytes]:
    """Everything that comes of steps, their numbers among the seeds of what agents do."""
    found = []
    for step in steps:
        actions = np.random.default_rng(step).uniform(-1.0, 1.0, (vec.num_envs, vec.num_agents, 2))
        *results, infos = vec.step(actions.astype(np.float32))
        found += [array.tobytes() for array in (*results, *infos.values(), vec.state())]
    return [*found, *(vec.state_hash(world).encode() for world in range(vec.num_envs))]


@pytest.mark.parametrize(
    ("mode", "arguments"),
    [
        ("SameStep", {}),
        ("NextStep", {"zones": 2}),
        ("NextStep", {"zones": 2, "workers": 4}),
        ("SameStep", {"workers": 2, "overrides": {"workers.balance_steps": 3}}),
        ("NextStep", {"zones": 3, "nodes": 2}),
    ],
)
@pytest.mark.filterwarnings("ignore:workers = ")
def test_loaded_worlds_continue_bit_for_bit(mode: str, arguments: dict[str, Any]) -> None:
    before, middle, after = range(HORIZON + 4), range(20, 30), range(30, 50)
    whole = make(mode)
    whole.reset(seed=3)
    drive(whole, before)
    saved = whole.save_state()
    expected = drive(whole, middle), drive(whole, after)
    other = make(mode, **arguments)
    try:
        other.load_state(saved)
        found = drive(other, middle)
        again = other.save_state()
        assert (found, drive(other, after)) == expected
    finally:
        other.close()
    whole.load_state(again)
    assert drive(whole, after) == expected[1]


def test_invalid_saves_and_loads_are_refused() -> None:
    vec = make()
    with pytest.raises(EpisodeError, match=r"save_state\(\) before reset"):
        vec.save_state()
    vec.reset(seed=0)
    saved = vec.save_state()
    for other in (make(num_envs=3), make_vec("merge", num_envs=WORLDS, agents=3, background=4)):
        with pytest.raises(ConfigError, match="belongs to other worlds, or to another"):
            other.load_state(saved)
    for damaged in (saved[:-1], saved[:50] + b"x" + saved[51:], b""):
        with pytest.raises(ConfigError, match="the saved state is damaged"):
            vec.load_state(damaged)
