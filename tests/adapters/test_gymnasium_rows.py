"""Agents as rows of a vector environment of Gymnasium: equality with worlds, and wrappers."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError
from cavmarl.engine.spaces import flat_observation, observation_parts
from cavmarl.env.vector import make_vec

MODES = ("closed", "open", "respawn")
AUTORESET = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)
ROWS = 8
WORLDS = 2


def overrides(mode: str, kind: str = "flat") -> dict[str, Any]:
    chosen = {"population.mode": mode, "observation.kind": kind}
    return chosen | ({"population.agents": 2} if mode == "open" else {})


def make(mode: str = "respawn", kind: str = "flat", **arguments: Any) -> Any:
    settings = {"num_worlds": WORLDS, "background": 4, "max_cycles": 12} | arguments
    name = "cavmarl/mergeAgents-v6"
    return gymnasium.make_vec(name, num_envs=ROWS, overrides=overrides(mode, kind), **settings)


def wild(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return actions (count, 2) of full throttle and random steering, which soon end most trips."""
    actions = rng.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)
    actions[:, 0] = 1.0
    return actions


@pytest.mark.parametrize("autoreset", AUTORESET)
@pytest.mark.parametrize("mode", MODES)
def test_results_of_rows_equal_those_of_the_agents(mode: str, autoreset: AutoresetMode) -> None:
    rows = make(mode, autoreset_mode=autoreset)
    per_world = ROWS // WORLDS
    vec = make_vec(
        "merge",
        num_envs=WORLDS,
        background=4,
        max_cycles=12,
        autoreset_mode=autoreset,
        overrides={
            "population.agents": 2 if mode == "open" else per_world,
            "population.budget": per_world,
            "population.mode": mode,
        },
    )
    assert rows.metadata["autoreset_mode"] is autoreset
    observations, told = rows.reset(seed=5)
    np.testing.assert_array_equal(observations, vec.reset(seed=5)[0].reshape(ROWS, -1))
    rng = np.random.default_rng(0)
    singly = cut_at_once = 0
    for _ in range(100):
        actions = wild(rng, ROWS)
        observations, rewards, ended, cut, told = rows.step(actions)
        theirs = vec.step(actions.reshape(WORLDS, per_world, 2))
        np.testing.assert_array_equal(observations, theirs[0].reshape(ROWS, -1))
        for mine, other in zip((rewards, ended, cut), theirs[1:4], strict=True):
            np.testing.assert_array_equal(mine, other.ravel())
        infos = theirs[4]
        np.testing.assert_array_equal(told["active"], infos["mask"].ravel())
        for k, term in enumerate(TERMS):
            np.testing.assert_array_equal(told[term], infos["terms"][..., k].ravel())
        over = ended | cut
        singly += bool(over.any() and not over.all())
        cut_at_once += bool(cut.any())
        last = infos["final_observations"].reshape(ROWS, -1)
        if autoreset is AutoresetMode.NEXT_STEP:
            assert "final_obs" not in told
            assert "final_info" not in told
            np.testing.assert_array_equal(observations[over], last[over])
        else:
            assert not observations[~told["active"]].any()
            assert ("final_obs" in told) == over.any()
            for row in np.flatnonzero(over):
                assert told["_final_obs"][row]
                np.testing.assert_array_equal(told["final_obs"][row], last[row])
                assert all(told["final_info"][term][row] == told[term][row] for term in TERMS)
    assert singly > 0
    assert cut_at_once > 0


@pytest.mark.parametrize("autoreset", AUTORESET)
@pytest.mark.parametrize("mode", MODES)
def test_gymnasium_records_the_returns_of_all_rows(mode: str, autoreset: AutoresetMode) -> None:
    rows = wrappers.RecordEpisodeStatistics(make(mode, autoreset_mode=autoreset))
    if autoreset is AutoresetMode.SAME_STEP and gymnasium.__version__.startswith("1.2."):
        pytest.skip("this Gymnasium's wrapper counts as if every reset had a step of its own")
    rows.reset(seed=1)
    rng = np.random.default_rng(0)
    returns, found, wanted = np.zeros(ROWS), [], []
    for _ in range(90):
        _, rewards, ended, cut, told = rows.step(wild(rng, ROWS))
        returns += rewards
        over = ended | cut
        if over.any():
            found += told["episode"]["r"][over].tolist()
            wanted += returns[over].tolist()
            returns[over] = 0.0
    assert len(found) > ROWS
    assert rows.episode_count == len(found)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.parametrize("autoreset", AUTORESET)
def test_observations_of_rows_can_be_dicts(autoreset: AutoresetMode) -> None:
    named = make(kind="dict", autoreset_mode=autoreset)
    flat = make(autoreset_mode=autoreset)
    parts = observation_parts(named.unwrapped.vec.config.sensors)

    def flattened(observation: dict[str, Any]) -> NDArray[np.float32]:
        return flat_observation(parts, observation, stack=1)

    def check(shown: Any, wanted: NDArray[np.float32]) -> None:
        assert named.observation_space.contains(shown)
        for row in range(ROWS):
            one = {name: part[row] for name, part in shown.items()}
            np.testing.assert_array_equal(flattened(one), wanted[row])

    check(named.reset(seed=0)[0], flat.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(60):
        actions = wild(rng, ROWS)
        shown, _, _, _, told = named.step(actions)
        wanted, _, _, _, infos = flat.step(actions)
        check(shown, wanted)
        for row in np.flatnonzero(infos.get("_final_obs", False)):
            np.testing.assert_array_equal(
                flattened(told["final_obs"][row]), infos["final_obs"][row]
            )
            ended += 1
    assert (ended > 0) == (autoreset is AutoresetMode.SAME_STEP)


def test_wrappers_of_gymnasium_accept_the_rows() -> None:
    rows: Any = wrappers.NormalizeObservation(make(autoreset_mode="NextStep"))
    rows = wrappers.NormalizeReward(wrappers.DictInfoToList(rows))
    rows.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        observations, *_ = rows.step(wild(rng, ROWS))
    assert np.isfinite(observations).all()
    flattened = wrappers.FlattenObservation(make(kind="dict", autoreset_mode="NextStep"))
    flattened.reset(seed=0)
    for _ in range(50):
        observations, *_ = flattened.step(wild(rng, ROWS))
        assert observations.shape == flattened.observation_space.shape


def test_the_same_seed_gives_the_same_rows() -> None:
    def episode(seed: int) -> list[bytes]:
        rng = np.random.default_rng(0)
        rows = make()
        return [rows.reset(seed=seed)[0].tobytes()] + [
            rows.step(wild(rng, ROWS))[0].tobytes() for _ in range(20)
        ]

    first = episode(3)
    assert first == episode(3)
    assert first[0] != episode(4)[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"agents": 2}, "^agents: this view sets it"),
        ({"overrides": {"population.agents": 2}}, r"^population\.agents: this view"),
        ({"overrides": {"population.budget": 9}}, r"^population\.budget: this view"),
        ({"num_worlds": 3}, "num_envs = 8: must be a multiple of num_worlds = 3"),
        ({"num_worlds": 0}, "num_envs = 8: must be a multiple of num_worlds = 0"),
        ({"autoreset_mode": "Never"}, "autoreset_mode = 'Never': must be"),
        ({"render_mode": "human"}, "render_mode = 'human': must be rgb_array, or None"),
        ({"overrides": {"population.mode": "opened"}}, r"population\.mode"),
    ],
)
def test_invalid_rows_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gymnasium.make_vec("cavmarl/mergeAgents-v6", num_envs=ROWS, **arguments)


def test_rows_without_autoreset_begin_an_episode_on_reset() -> None:
    """There is one row per world, so each row can be reset while other rows continue."""
    rows = make(num_worlds=ROWS, autoreset_mode="Disabled")
    assert rows.autoreset_mode is AutoresetMode.DISABLED
    seen, _ = rows.reset(seed=5)
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(30):
        seen, _, terminated, cut, _ = rows.step(wild(rng, ROWS))
        over = terminated | cut
        if over.any():
            anew, told = rows.reset(options={"reset_mask": over})
            assert told["active"][over].all()
            assert (anew[over] != seen[over]).any(axis=1).all()
            np.testing.assert_array_equal(anew[~over], seen[~over])
            ended += int(over.sum())
    assert ended > ROWS


def test_rows_of_one_world_begin_an_episode_together() -> None:
    rows = make(autoreset_mode="Disabled")
    rows.reset(seed=5)
    first = np.arange(ROWS) == 0
    with pytest.raises(ConfigError, match="row 0, which has not ended, but not all rows"):
        rows.reset(options={"reset_mask": first})
    with pytest.raises(ConfigError, match=r"must be \(8,\) and bool, one value per row"):
        rows.reset(options={"reset_mask": first[:WORLDS]})
    rng = np.random.default_rng(0)
    whole = waiting = 0
    for _ in range(40):
        *_, terminated, cut, _ = rows.step(wild(rng, ROWS))
        over = terminated | cut
        if over.any():
            seen, told = rows.reset(options={"reset_mask": over})
            assert not seen[over & ~told["active"]].any(), (
                "a waiting row observes values other than 0"
            )
            whole += bool(told["active"][over].all())
            waiting += bool((over & ~told["active"]).any())
    assert whole > 0
    assert waiting > 0


def test_a_world_may_end_while_none_of_its_rows_has_a_vehicle() -> None:
    """If all ended rows are reset after each step, the steps raise no error."""
    rows = make(num_worlds=4, autoreset_mode="Disabled")
    rows.reset(seed=0)
    rng = np.random.default_rng(0)
    empty = 0
    had = np.ones(ROWS, dtype=np.bool_)
    for _ in range(300):
        *_, terminated, cut, infos = rows.step(wild(rng, ROWS))
        over = terminated | cut
        empty += int((over & ~had).reshape(4, -1).all(axis=1).sum())
        had = infos["active"]
        if over.any():
            had = rows.reset(options={"reset_mask": over})[1]["active"]
    assert empty > 0


@pytest.mark.parametrize("autoreset", ["Disabled", "SameStep"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torchrl")
@pytest.mark.filterwarnings("ignore:Creating .* inherits from WeightUpdaterBase")
def test_the_wrapper_of_torchrl_accepts_the_rows(autoreset: str) -> None:
    envs = pytest.importorskip("torchrl.envs", reason="needs the extra: torchrl")
    wrapped = envs.GymWrapper(make(autoreset_mode=autoreset))
    told = wrapped.rollout(30, break_when_any_done=False)
    assert told["observation"].shape == (ROWS, 30, wrapped.observation_spec["observation"].shape[1])
    assert told["next", "done"].any(dim=1).all(), "a row did not end"


def test_the_spec_contains_the_horizon_and_makes_an_equal_environment() -> None:
    rows = make()
    assert rows.spec.id == "cavmarl/mergeAgents-v6"
    assert rows.spec.max_episode_steps == 12
    again = gymnasium.make_vec(rows.spec)
    assert (again.num_envs, again.vec.max_cycles) == (ROWS, 12)
    shorter = gymnasium.make_vec("cavmarl/ringAgents-v5", num_envs=2, max_episode_steps=7)
    assert shorter.vec.max_cycles == 7


def test_gymnasium_records_a_video_of_the_rows(tmp_path: Any, recorded: Any) -> None:
    rows = make(render_mode="rgb_array", autoreset_mode="NextStep")
    film = wrappers.RecordVideo(rows, str(tmp_path / "film"), step_trigger=lambda step: step == 0)
    film.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(3):
        film.step(wild(rng, ROWS))
    frames = rows.render()
    film.close()
    assert len(frames) == ROWS
    assert (frames[0] == frames[ROWS // WORLDS - 1]).all(), (
        "rows of one world show different pictures"
    )
    assert (frames[0] != frames[-1]).any(), "rows of two worlds show one picture"
    (video,) = recorded
    assert len(video.frames) == 3
    assert video.fps == rows.metadata["render_fps"] == 5


def test_rendering_rows_without_a_render_mode_warns() -> None:
    rows = make()
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert rows.render() is None
