"""Agents as rows for stable-baselines3: checks of the library, equality with worlds, training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.config.registry import load_config
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.engine.spaces import flat_observation, observation_parts
from cavmarl.env.vector import make_vec

sb3 = pytest.importorskip("stable_baselines3")

MODES = ("closed", "open", "respawn")
WORLDS, SEATS, BUDGET = 2, 3, 5
SMALL: dict[str, Any] = {"num_worlds": WORLDS, "agents": SEATS, "background": 2}


def make(mode: str = "respawn", kind: str = "flat") -> Any:
    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    keys = {"population.mode": mode, "population.budget": BUDGET, "observation.kind": kind}
    return CavSb3VecEnv("merge", **SMALL, max_cycles=20, overrides=keys)


@pytest.fixture
def rows() -> Any:
    return make()


def wild(rows: Any, seed: int) -> list[Any]:
    """Reset and take 80 steps of full throttle and random steering; return all results."""
    rows.seed(seed)
    found = [rows.reset()]
    random = np.random.default_rng(0)
    for _ in range(80):
        actions = random.uniform(-1.0, 1.0, (rows.num_envs, 2)).astype(np.float32)
        actions[:, 0] = 1.0
        found.append(rows.step(actions))
    return found


def test_sb3_accepts_the_spaces(rows: Any) -> None:
    from stable_baselines3.common.utils import check_for_correct_spaces
    from stable_baselines3.common.vec_env import VecCheckNan, VecMonitor

    assert rows.num_envs == WORLDS * SEATS
    watched = VecMonitor(VecCheckNan(rows, raise_exception=True))
    watched.seed(0)
    observations = watched.reset()
    assert observations.dtype == rows.observation_space.dtype
    ended = 0
    for _ in range(60):
        actions = np.stack([rows.action_space.sample() for _ in range(rows.num_envs)])
        observations, rewards, done, infos = watched.step(actions)
        assert all(rows.observation_space.contains(row) for row in observations)
        assert rewards.shape == done.shape == (rows.num_envs,)
        assert done.dtype == np.bool_
        ended += sum("episode" in info for info in infos)
    assert ended >= rows.num_envs
    model = sb3.PPO("MlpPolicy", watched, n_steps=8, batch_size=24, n_epochs=1, device="cpu")
    check_for_correct_spaces(watched, model.observation_space, model.action_space)


def test_sb3_learns_saves_and_loads(rows: Any, tmp_path: Any) -> None:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecMonitor

    watched = VecMonitor(rows)
    model = sb3.PPO("MlpPolicy", watched, n_steps=16, batch_size=32, seed=0, device="cpu")
    model.learn(2 * 16 * rows.num_envs)
    model.save(tmp_path / "model.zip")
    loaded = sb3.PPO.load(tmp_path / "model.zip", env=watched, device="cpu")
    mean, _ = evaluate_policy(loaded, watched, n_eval_episodes=4)
    assert np.isfinite(mean)


@pytest.mark.parametrize("mode", MODES)
def test_results_of_rows_equal_those_of_the_agents(mode: str) -> None:
    rows = make(mode)
    vec = make_vec(
        "merge",
        num_envs=WORLDS,
        agents=SEATS,
        background=2,
        max_cycles=20,
        overrides={"population.mode": mode, "population.budget": BUDGET},
    )
    agents = vec.num_agents
    assert agents == (BUDGET if mode == "open" else SEATS)
    observations, _ = vec.reset(seed=5)
    random = np.random.default_rng(0)
    found = wild(rows, 5)
    assert np.array_equal(found[0], observations.reshape(rows.num_envs, -1))
    kinds = {"ended": 0, "cut": 0, "inactive": 0}
    for seen, rewards, done, infos in found[1:]:
        actions = random.uniform(-1.0, 1.0, (rows.num_envs, 2)).astype(np.float32)
        actions[:, 0] = 1.0
        theirs = vec.step(actions.reshape(WORLDS, agents, 2))
        assert np.array_equal(seen, theirs[0].reshape(rows.num_envs, -1))
        assert np.array_equal(rewards, theirs[1].ravel())
        assert np.array_equal(done, (theirs[2] | theirs[3]).ravel())
        for row, info in enumerate(infos):
            world, agent = divmod(row, agents)
            assert ("terminal_observation" in info) == done[row]
            assert ("inactive" in info) == (not theirs[4]["acted"][world, agent])
            kinds["inactive"] += "inactive" in info
            if done[row]:
                last = theirs[4]["final_observations"][world, agent]
                assert np.array_equal(info["terminal_observation"], last)
                assert info["TimeLimit.truncated"] == theirs[3][world, agent]
                kinds["cut" if theirs[3][world, agent] else "ended"] += 1
    assert kinds["ended"] > 0
    assert kinds["cut"] > 0
    assert kinds["inactive"] > 0


@pytest.mark.parametrize("kind", ["flat", "dict"])
@pytest.mark.parametrize("mode", MODES)
def test_ppo_trains_in_every_population_mode(mode: str, kind: str) -> None:
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    watched = VecNormalize(VecMonitor(make(mode, kind)))
    policy = "MultiInputPolicy" if kind == "dict" else "MlpPolicy"
    model = sb3.PPO(policy, watched, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(3 * 16 * watched.num_envs)
    assert model.ep_info_buffer


def test_observations_of_rows_can_be_dicts() -> None:
    named, flat = wild(make(kind="dict"), 5), wild(make(), 5)
    parts = observation_parts(load_config("merge")[0].sensors)

    def check(shown: Any, wanted: Any) -> None:
        assert list(shown) == list(parts)
        assert np.array_equal(flat_observation(parts, shown, stack=1), wanted)

    ended = 0
    for shown, wanted in zip(named[1:], flat[1:], strict=True):
        for row, info in enumerate(shown[3]):
            check({name: part[row] for name, part in shown[0].items()}, wanted[0][row])
            if "terminal_observation" in info:
                check(info["terminal_observation"], wanted[3][row]["terminal_observation"])
                ended += 1
    assert ended > 0


def test_the_same_seed_gives_the_same_rows(rows: Any) -> None:
    first, again, other = wild(rows, 1), wild(rows, 1), wild(rows, 2)
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(first[1:], again[1:], strict=True))
    assert not np.array_equal(first[0], other[0])


def test_attributes_and_methods_of_the_worlds_can_be_used(rows: Any) -> None:
    rows.reset()
    assert rows.get_attr("max_cycles") == [20] * rows.num_envs
    assert rows.get_attr("max_cycles", 1) == [20]
    assert not rows.has_attr("nonsense")
    assert rows.env_method("state_hash", 1, indices=[0]) == [rows.env_method("state_hash", 1)[0]]
    assert rows.env_is_wrapped(object) == [False] * rows.num_envs
    with pytest.raises(NotImplementedError, match=r"max_cycles: .*rows share"):
        rows.set_attr("max_cycles", 3)


def test_sb3_records_a_video_of_the_worlds(tmp_path: Any, recorded: Any) -> None:
    from stable_baselines3.common.vec_env import VecVideoRecorder

    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    rows = CavSb3VecEnv("merge", **SMALL, max_cycles=20, render_mode="rgb_array")
    film = VecVideoRecorder(rows, str(tmp_path), lambda step: step == 0, video_length=2)
    film.reset()
    for _ in range(3):
        film.step(np.zeros((rows.num_envs, 2), dtype=np.float32))
    film.close()
    (video,) = recorded
    height, width, _ = rows.get_images()[0].shape
    assert [frame.shape for frame in video.frames] == [(WORLDS * height, width, 3)] * 3
    assert video.fps == 5


def test_rows_have_the_spec_of_their_environment(rows: Any) -> None:
    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    assert rows.spec.id == "cavmarl/mergeAgents-v6"
    assert rows.get_attr("spec", 0) == [rows.spec]
    assert rows.spec.max_episode_steps == 20
    folder = Path(__file__).parents[2] / "envs" / "ring"
    assert CavSb3VecEnv(folder).spec is None, "an environment without an id has a spec"


def test_wrong_use_is_refused(rows: Any) -> None:
    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    for key, value in {"autoreset_mode": "NextStep", "copy": False}.items():
        with pytest.raises(ConfigError, match=f"^{key}: this view sets it"):
            CavSb3VecEnv("merge", **{key: value})
    rows.reset()
    with pytest.raises(ActionError, match="must be finite"):
        rows.step(np.full((rows.num_envs, 2), np.nan, dtype=np.float32))
