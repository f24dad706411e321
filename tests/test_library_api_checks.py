"""All environments and some bare maps pass the tests of PettingZoo in each population mode."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.registry import entries
from cavmarl.env.parallel import CavEnv

with warnings.catch_warnings():
    # PettingZoo's test module imports environments in a deprecated way.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import (
        api_test,
        max_cycles_test,
        parallel_api_test,
        render_test,
        state_test,
    )

MODES = ("closed", "open", "respawn")
STEPS = 60
LARGE = ("cities", "cities_sensed")  # they read 31 and 81 maps; all of their tests are slow
BARE_MAPS = ("net/Town10HD.net.xml", "xodr/Town01.xodr", "osm/laufamholz.osm.xml")

Make = Callable[..., Any]


def worlds(*often: str, modes: tuple[str, ...] = MODES, bare: tuple[str, ...] = BARE_MAPS) -> Any:
    """Return a mark that parametrizes a test by environment and population mode.

    The first mode, and all modes of the environments in `often`, are in every run of the tests. The
    other variants, and those of `LARGE`, are slow tests.
    """

    def is_slow(source: str, mode: str) -> bool:
        return source in LARGE or not (mode == modes[0] or source in often)

    return pytest.mark.parametrize(
        "arguments",
        [
            pytest.param(
                (source, mode),
                id=f"{mode}-{source}",
                marks=pytest.mark.slow if is_slow(source, mode) else [],
            )
            for source in (*sorted(entries()), *bare)
            for mode in modes
        ],
        indirect=True,
    )


in_few_worlds = worlds("grid4x4", "merge")


@pytest.fixture
def arguments(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return arguments of `parallel_env` for a small population and short episodes."""
    source, mode = request.param
    if source in BARE_MAPS:
        source = request.getfixturevalue("shared_maps") / source
    return {
        "env": source,
        "agents": 1 if source == "ring22" else 3,  # no room for more
        "background": 6,
        "seed": 0,
        "max_cycles": STEPS,
        "overrides": {"population.mode": mode, "population.budget": 6},
    }


@pytest.fixture
def make(arguments: dict[str, Any]) -> Make:
    return partial(cavmarl.parallel_env, **arguments)


@pytest.fixture
def make_aec(arguments: dict[str, Any]) -> Make:
    arguments = dict(arguments)
    return partial(cavmarl.env, arguments.pop("env"), **arguments)


# An episode can end before all possible agents have entered.
@pytest.mark.filterwarnings("ignore:No agents present but not all possible_agents")
@worlds(*sorted(entries()), *BARE_MAPS)
def test_environments_pass_parallel_api_test(make: Make) -> None:
    parallel_api_test(make(), num_cycles=STEPS)


# An agent without a vehicle observes zeros.
@pytest.mark.filterwarnings("ignore:Observation numpy array is all zeros")
@in_few_worlds
def test_environments_pass_api_test(make_aec: Make) -> None:
    api_test(make_aec(), num_cycles=STEPS)


@in_few_worlds
def test_environments_pass_max_cycles_test(
    arguments: dict[str, Any], make: Make, make_aec: Make
) -> None:
    # PettingZoo's test expects most possible agents to act until the end. So all agents enter at
    # the reset, and small steering angles keep them on the road.
    few = {"population.budget": arguments["agents"], "action.steering_rad": 0.05}
    whole = {**arguments["overrides"], **few}
    max_cycles_test(
        SimpleNamespace(
            parallel_env=partial(make, overrides=whole), env=partial(make_aec, overrides=whole)
        )
    )


@in_few_worlds
def test_environments_pass_state_test(make: Make, make_aec: Make) -> None:
    state_test(make_aec(), make(), num_cycles=STEPS)


@worlds(bare=())  # without bare maps
def test_environments_pass_render_test(make_aec: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame", reason="frames need the extra 'render'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(make_aec)


Step = tuple[Any, ...]


def episode(env: CavEnv, seed: int, actions_seed: int = 0) -> Iterator[Step]:
    """Yield all results of each step of an episode with random actions."""
    rng = np.random.default_rng(actions_seed)
    observations, infos = env.reset(seed=seed)
    yield observations, {}, {}, {}, infos, env.state(), env.state_hash()
    while env.agents:
        actions = {
            agent: rng.uniform(-1.0, 1.0, 2).astype(np.float32) * (1.0, 0.2) for agent in env.agents
        }
        yield *env.step(actions), env.state(), env.state_hash()


def assert_equal(one: Step, other: Step, where: str) -> None:
    *mine, my_state, my_hash = one
    *theirs, their_state, their_hash = other
    assert my_hash == their_hash, where
    np.testing.assert_array_equal(my_state, their_state, where)
    assert mine[0].keys() == theirs[0].keys(), where
    for agent, observation in mine[0].items():
        np.testing.assert_array_equal(observation, theirs[0][agent], f"{where}, {agent}")
    assert mine[1:] == theirs[1:], f"{where}: rewards, terminations, truncations, infos"


@in_few_worlds
def test_episodes_with_equal_seeds_are_equal(make: Make) -> None:
    fresh, used = make(), make()
    for _ in episode(used, seed=99, actions_seed=1):
        pass
    steps = 0
    for steps, (one, other) in enumerate(
        zip(episode(fresh, seed=4), episode(used, seed=4), strict=True)
    ):
        assert_equal(one, other, f"step {steps}")
    assert steps > 5
    hashes = [step[-1] for step in episode(fresh, seed=4)]
    assert hashes == [step[-1] for step in episode(used, seed=4)], "the second episode differs"
    assert len(set(hashes)) == len(hashes)
    others = [step[-1] for step in episode(fresh, seed=5)]
    assert not set(hashes) & set(others), "another seed gives the same state"


@in_few_worlds
def test_resets_without_a_seed_follow_from_the_last_seed(make: Make) -> None:
    env = make()
    runs = []
    for seed in (7, None, None, 7, None):
        env.reset(seed=seed)
        runs.append(env.state_hash())
    assert runs[3:] == runs[:2]
    assert len(set(runs[:3])) == 3
