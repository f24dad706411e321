"""A copy or pickle of an environment is independent of it and continues bit for bit."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import cavmarl

COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}
WORLDS: dict[str, dict[str, Any]] = {
    "ring": {"env": "ring"},
    "open": {"env": "merge", "overrides": {"population.mode": "open", "population.budget": 30}},
    "respawn": {"env": "grid4x4", "agents": 6, "overrides": {"population.mode": "respawn"}},
    "zones": {"env": "grid4x4", "agents": 6, "background": 40, "zones": 4},
    "v2x": {"env": "grid4x4", "agents": 4, "background": 10, "overrides": {"v2x.enabled": True}},
    "stacked": {"env": "merge", "overrides": {"sensors.stack": 3}},
}


def actions_of(env: cavmarl.CavEnv, step: int) -> dict[str, np.ndarray]:
    return {
        agent: np.array([0.4 * np.sin(step + k), 0.02 * np.cos(step - k)], dtype=np.float32)
        for k, agent in enumerate(env.agents)
    }


def flat(value: Any) -> Any:
    """Convert arrays in a result to bytes, so that `==` can compare results."""
    if isinstance(value, dict):
        return [(key, flat(item)) for key, item in value.items()]
    if isinstance(value, tuple):
        return [flat(item) for item in value]
    return np.asarray(value).tobytes()


def drive(env: cavmarl.CavEnv, first: int, steps: int) -> list[Any]:
    """Drive some steps; return all results and the final state."""
    seen: list[Any] = []
    for step in range(first, first + steps):
        if not env.agents:
            env.reset()
        seen.append(flat(env.step(actions_of(env, step))))
    return [*seen, env.simulation.state_hash()]


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", WORLDS)
def test_a_copy_continues_like_the_original(name: str, how: str) -> None:
    env = cavmarl.parallel_env(**WORLDS[name])
    env.reset(seed=3)
    drive(env, 0, 15)
    other = COPIES[how](env)
    assert other.simulation is not env.simulation
    assert other.agents == env.agents
    first = drive(env, 15, 12)
    assert drive(other, 15, 12) == first
    assert flat(other.reset()) == flat(env.reset()), "the next episodes differ"


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_is_independent_of_the_original(how: str) -> None:
    env = cavmarl.parallel_env("ring")
    env.reset(seed=1)
    other = COPIES[how](env)
    before = env.simulation.state_hash()
    drive(other, 0, 5)
    other.reset(seed=9)
    assert env.simulation.state_hash() == before


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_before_the_first_reset_equals_the_original(how: str) -> None:
    env = cavmarl.parallel_env("ring", seed=5)
    other = COPIES[how](env)
    with pytest.raises(cavmarl.EpisodeError):
        other.step({})
    assert flat(other.reset()) == flat(env.reset())
    assert drive(other, 0, 5) == drive(env, 0, 5)


@pytest.mark.parametrize("copied", [True, False])
@pytest.mark.parametrize("how", COPIES)
def test_a_copied_batch_of_worlds_continues_like_the_original(how: str, copied: bool) -> None:
    def step(vec: cavmarl.CavVectorEnv, number: int) -> tuple[bytes, ...]:
        actions = np.full(vec.action_space.shape, 0.1 * (number % 5), dtype=np.float32)
        observations, rewards, ended, cut, infos = vec.step(actions)
        parts = (observations, rewards, ended, cut, *infos.values())
        return tuple(np.asarray(part).tobytes() for part in parts)

    vec = cavmarl.make_vec("merge", num_envs=3, max_cycles=20, copy=copied)
    vec.reset(seed=2)
    for number in range(15):
        step(vec, number)
    other = COPIES[how](vec)
    for number in range(15, 30):  # past the end of an episode
        assert step(other, number) == step(vec, number)
    assert not np.shares_memory(other.worlds.arrays.observations, vec.worlds.arrays.observations)


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_of_an_aec_environment_continues(how: str) -> None:
    aec = cavmarl.env("ring", agents=2)
    aec.reset(seed=4)
    aec.step(np.zeros(2))
    later = COPIES[how](aec)
    seen = []
    for env in (aec, later):
        for _ in range(5):
            env.step(np.full(2, 0.3))
            seen.append((env.agent_selection, flat(env.last())))
    assert seen[5:] == seen[:5]


def test_a_copy_of_a_single_vehicle_environment_continues() -> None:
    one = gymnasium.make("cavmarl/merge-v6")
    one.reset(seed=4)
    one.step(np.zeros(2, np.float32))
    other = copy.deepcopy(one)
    for _ in range(5):
        assert flat(other.step(np.zeros(2, np.float32))) == flat(one.step(np.zeros(2, np.float32)))


def test_a_world_that_is_sent_to_another_process_continues() -> None:
    env = cavmarl.parallel_env("ring")
    env.reset(seed=3)
    drive(env, 0, 5)
    sent = pickle.dumps(env)
    program = (
        "import pickle, sys; from tests.env.test_world_copies import drive; "
        "print(drive(pickle.loads(sys.stdin.buffer.read()), 5, 5)[-1])"
    )
    done = subprocess.run([sys.executable, "-c", program], input=sent, stdout=-1, check=True)
    assert done.stdout.decode().strip() == drive(env, 5, 5)[-1]


@pytest.mark.parametrize("how", COPIES)
def test_copies_of_worlds_with_processes_are_refused(how: str) -> None:
    env = cavmarl.parallel_env("grid4x4", agents=2, zones=2, workers=2)
    with pytest.raises(cavmarl.ConfigError, match="backend='local'"):
        COPIES[how](env)
    env.close()


def test_a_copy_does_not_write_to_the_journal(tmp_path: Any) -> None:
    path = tmp_path / "journal"
    journal = {"zones.journal": str(path), "zones.check_invariants": True}
    env = cavmarl.parallel_env("grid4x4", agents=2, zones=2, overrides=journal)
    drive(env, 0, 5)
    written = path.read_bytes()
    other = copy.deepcopy(env)
    found = drive(other, 5, 5)
    assert path.read_bytes() == written
    assert drive(env, 5, 5) == found
    assert len(path.read_bytes()) > len(written)


class Named(cavmarl.CavEnv):
    """A class of a user, with a different constructor."""

    def __init__(self, name: str) -> None:
        super().__init__(cavmarl.parallel_env("ring").worlds)
        self.name = name


def test_an_instance_of_a_users_class_can_be_copied() -> None:
    env = Named("first")
    env.reset(seed=0)
    other = copy.deepcopy(env)
    assert type(other) is Named
    assert other.name == "first"
    assert drive(other, 0, 3) == drive(env, 0, 3)
