"""One vehicle as an environment of Gymnasium: checker, wrappers, settings and infos."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics

from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError

MODES = ("closed", "open", "respawn")


def make(mode: str = "closed", kind: str = "flat", **arguments: Any) -> gymnasium.Env[Any, Any]:
    overrides = {"population.mode": mode, "observation.kind": kind}
    return gymnasium.make("cavmarl/merge-v6", max_cycles=40, overrides=overrides, **arguments)


@pytest.mark.parametrize("kind", ["flat", "dict"])
@pytest.mark.parametrize("mode", MODES)
def test_the_environment_passes_the_checker_of_gymnasium(mode: str, kind: str) -> None:
    world = make(mode, kind, background=5).unwrapped
    assert isinstance(world.observation_space, gymnasium.spaces.Dict) == (kind == "dict")
    check_env(world, skip_render_check=True)


def test_other_agents_become_background_vehicles() -> None:
    population = make().unwrapped.parallel_env.config.population
    entry, _ = load_config("merge")
    everybody = entry.population.agents + entry.population.background
    assert (population.agents, population.background) == (1, everybody - 1)
    overridden = gymnasium.make("cavmarl/ring-v5", overrides={"population.background": 3})
    assert overridden.unwrapped.parallel_env.config.population.background == 3


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_ends_with_the_trip_or_at_the_horizon(mode: str) -> None:
    world = RecordEpisodeStatistics(FlattenObservation(make(mode, "dict", background=5)))
    crashes = cuts = 0
    for seed in range(6):
        world.reset(seed=seed)
        crash = seed % 2 == 0
        action = np.array([1.0, 1.0] if crash else [-1.0, 0.0], dtype=np.float32)
        total, steps, done = 0.0, 0, False
        while not done:
            _, reward, ended, cut, info = world.step(action)
            total, steps, done = total + reward, steps + 1, ended or cut
            assert not (ended and cut)
        crashes, cuts = crashes + ended, cuts + cut
        assert info["vehicle_done"] == float(ended)
        assert info["episode"]["r"] == pytest.approx(total)
        assert info["episode"]["l"] == steps
        assert cut == (steps == 40 and not ended)
    assert crashes > 0
    assert cuts > 0


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        ({"agents": 2}, "agents"),
        ({"overrides": {"population.budget": 2}}, r"population\.budget"),
        ({"overrides": {"population.agents": 2}}, r"population\.agents"),
    ],
)
def test_other_numbers_of_agents_are_refused(arguments: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=f"^{key}: this view sets it"):
        gymnasium.make("cavmarl/ring-v5", **arguments)


def test_the_spec_contains_the_horizon_and_makes_an_equal_environment() -> None:
    world = make()
    assert world.spec is not None
    assert world.spec.max_episode_steps == 40
    assert gymnasium.make(world.spec).unwrapped.parallel_env.max_cycles == 40
    cut = gymnasium.make("cavmarl/ring-v5", max_episode_steps=2)
    cut.reset(seed=0)
    cut.step(cut.action_space.sample())
    assert cut.step(cut.action_space.sample())[3], "max_episode_steps does not truncate the episode"
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert cut.unwrapped.render() is None


def test_infos_contain_the_keys_of_highway_env() -> None:
    """Even episodes have the built-in driver; in odd episodes, full throttle causes a contact."""
    ends = {"crashed": 0, "is_success": 0}
    for seed in range(4):
        driven = seed % 2 == 0
        world = gymnasium.make("cavmarl/merge-v6", background=0 if driven else 24)
        _, info = world.reset(seed=seed)
        env, done = world.unwrapped.parallel_env, False
        while not done:
            assert not info["crashed"]
            assert not info["is_success"]
            vehicles = env.simulation.vehicles()
            speed = vehicles["speed"][vehicles["agent"] == 0]
            assert info["speed"] == pytest.approx(float(speed[0]))
            action = env.suggest_actions()["car_0"] if driven else np.array([1.0, 0.0])
            _, _, ended, cut, info = world.step(action)
            done = ended or cut
        assert info["speed"] > 0.0
        assert info["is_success"] == (info["arrival"] > 0.0)
        assert info["crashed"] == (info["collision"] > 0.0)
        for end in ends:
            ends[end] += info[end]
    assert min(ends.values()) > 0


def test_config_may_contain_nested_keys_of_the_environment() -> None:
    config = {"sensors": {"lidar": {"rays": 8}}, "terms": {"weights": {"collision": -9.0}}}
    made = make(config=config).unwrapped.parallel_env.config
    entry, _ = load_config("merge")
    assert made.sensors.lidar.rays == 8
    assert made.sensors.lanes == entry.sensors.lanes, "another key has changed"
    assert made.terms.weights == {**entry.terms.weights, "collision": -9.0}
    with pytest.raises(ConfigError, match="lanes_count"):
        gymnasium.make("cavmarl/merge-v6", config={"lanes_count": 4})
    with pytest.raises(ConfigError, match="must be a mapping from keys"):
        gymnasium.make("cavmarl/merge-v6", config=[1])
