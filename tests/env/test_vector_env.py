"""`CavVectorEnv`: worlds that are stepped together equal single worlds bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl import TERMS, CavVectorEnv, ConfigError, EpisodeError, make_vec, parallel_env

MODES = ("closed", "open", "respawn")


def make(
    num_envs: int, mode: str = "respawn", env: str = "merge", **arguments: Any
) -> CavVectorEnv:
    overrides = {"population.mode": mode, "population.budget": 7, **arguments.pop("overrides", {})}
    return make_vec(
        env,
        num_envs=num_envs,
        **{"agents": 4, "background": 8, "max_cycles": 40, **arguments},
        overrides=overrides,
    )


def wild(rng: np.random.Generator, vec: CavVectorEnv) -> NDArray[np.float32]:
    """Return (worlds, agents, 2) actions: full throttle, random steering; most trips end soon."""
    actions = rng.uniform(-1.0, 1.0, (vec.num_envs, vec.num_agents, 2)).astype(np.float32)
    actions[..., 0] = 1.0
    return actions


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env", ["merge", "grid4x4"])
def test_the_first_of_many_worlds_equals_a_single_world(mode: str, env: str) -> None:
    many, alone = make(3, mode, env), make(1, mode, env)
    rng = np.random.default_rng(0)
    (observations, infos), (lone, lone_infos) = many.reset(seed=11), alone.reset(seed=11)
    np.testing.assert_array_equal(observations[:1], lone)
    for step in range(100):
        actions = wild(rng, many)
        *many_out, infos = many.step(actions)
        *lone_out, lone_infos = alone.step(actions[:1])
        assert many.state_hash(0) == alone.state_hash(), f"step {step}"
        for name, mine, other in zip("obs rew term trunc".split(), many_out, lone_out, strict=True):
            np.testing.assert_array_equal(mine[:1], other, f"step {step}: {name}")
        assert infos.keys() == lone_infos.keys()
        for key, value in infos.items():
            np.testing.assert_array_equal(value[:1], lone_infos[key], f"step {step}: {key}")
        assert many.traffic_stats(0) == alone.traffic_stats()


@pytest.mark.parametrize("mode", MODES)
def test_a_vectorized_world_equals_the_parallel_environment(mode: str) -> None:
    vec = make(2, mode)
    env = parallel_env(
        "merge",
        agents=4,
        background=8,
        max_cycles=40,
        overrides={"population.mode": mode, "population.budget": 7},
    )
    rng = np.random.default_rng(1)
    arrays, infos = vec.reset(seed=5)
    dicts, _ = env.reset(seed=5)
    for _ in range(40):
        active = [agent for k, agent in enumerate(vec.possible_agents) if infos["mask"][0, k]]
        for agent in active:
            np.testing.assert_array_equal(arrays[0, int(agent[4:])], dicts[agent])
        if not active:
            break  # here, a step of the parallel environment lasts until an agent enters
        actions = wild(rng, vec)
        arrays, rewards, terminations, truncations, infos = vec.step(actions)
        dicts, paid, ended, cut, told = env.step({a: actions[0, int(a[4:])] for a in active})
        for agent in active:
            k = int(agent[4:])
            assert rewards[0, k] == np.float32(paid[agent])
            np.testing.assert_array_equal(
                infos["terms"][0, k], np.array([told[agent][term] for term in TERMS], np.float32)
            )
            assert infos["vehicle_done"][0, k] == told[agent]["vehicle_done"]
            assert terminations[0, k] == bool(told[agent]["vehicle_done"])
            assert truncations[0, k] == (cut[agent] and not told[agent]["vehicle_done"])
            if mode != "respawn":
                assert terminations[0, k] == ended[agent]
            np.testing.assert_array_equal(infos["final_observations"][0, k], dicts[agent])
        assert infos["episode_over"][0] == (not env.agents)
        if not env.agents:
            break
        if not infos["mask"][0].any():
            break
        assert vec.state_hash(0) == env.state_hash()
        np.testing.assert_array_equal(vec.state()[0], env.state())


def test_actions_in_one_world_do_not_change_other_worlds() -> None:
    calm, shaken = make(3), make(3)
    calm.reset(seed=2)
    shaken.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = wild(rng, calm)
        calm.step(actions)
        actions[1] = -actions[1]
        shaken.step(actions)
        assert calm.state_hash(0) == shaken.state_hash(0)
        assert calm.state_hash(2) == shaken.state_hash(2)
    assert calm.state_hash(1) != shaken.state_hash(1)
    assert len({calm.state_hash(w) for w in range(3)}) == 3


def test_a_reset_with_a_seed_repeats_the_episode_and_a_reset_without_a_seed_continues() -> None:
    vec, again = make(2), make(2)
    hashes = []
    for seed in (3, None, 3, None):
        vec.reset(seed=seed)
        hashes.append((vec.state_hash(0), vec.state_hash(1)))
    assert hashes[:2] == hashes[2:]
    assert hashes[0] != hashes[1]
    again.reset(seed=3)
    assert again.state_hash(1) == hashes[0][1]
    assert make(1, seed=3).reset()[0].tobytes() == again.reset(seed=3)[0][:1].tobytes()


@pytest.mark.parametrize("mode", MODES)
def test_a_world_can_reset_in_the_same_step(mode: str) -> None:
    vec = make(2, mode)
    assert vec.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observations, infos = vec.reset(seed=0)
    rng = np.random.default_rng(4)
    over_early, steps = 0, np.zeros(2, dtype=int)
    for _ in range(130):
        acting = infos["mask"]
        observations, _, terminations, truncations, infos = vec.step(wild(rng, vec))
        steps += 1
        over = infos["episode_over"]
        np.testing.assert_array_equal(over[steps >= 40], True)
        # Agents that acted and have not ended are truncated exactly at the horizon.
        expected = infos["acted"] & ~terminations & (steps >= 40)[:, None]
        np.testing.assert_array_equal(truncations, expected)
        np.testing.assert_array_equal(infos["acted"], acting)
        for world in np.flatnonzero(over):
            over_early += steps[world] < 40
            steps[world] = 0
            first = vec.simulation.outputs.observations[world]
            shown = np.where(infos["mask"][world][:, None], first, 0.0)
            np.testing.assert_array_equal(observations[world], shown)
            assert vec.simulation.ticks()[world] == 0
            # In the mode "open", the last step may have no acting agent, because all wait to enter.
            shows = infos["final_observations"][world].any(axis=1)
            # An agent that entered in this step has a final observation although it has not acted.
            assert shows[infos["acted"][world]].all()
            assert not (shows & ~infos["acted"][world] & acting[world]).any()
            assert not np.array_equal(observations[world], infos["final_observations"][world])
        for world in np.flatnonzero(~over):
            going_on = infos["mask"][world] & ~terminations[world]
            np.testing.assert_array_equal(
                observations[world][going_on], infos["final_observations"][world][going_on]
            )
    assert (over_early > 0) == (mode != "respawn")


@pytest.mark.parametrize("copy", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_a_world_can_reset_in_the_next_step(mode: str, copy: bool) -> None:
    """Steps equal those of `SAME_STEP`, except that a reset takes one more step."""
    late, now = make(1, mode, autoreset_mode="NextStep", copy=copy), make(1, mode)
    assert late.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    rng = np.random.default_rng(4)
    np.testing.assert_array_equal(late.reset(seed=0)[0], now.reset(seed=0)[0])
    episodes = 0
    for step in range(130):
        actions = wild(rng, now)
        *shown, told = late.step(actions)
        *wanted, infos = now.step(actions)
        np.testing.assert_array_equal(shown[0], infos["final_observations"], f"step {step}")
        for mine, other in zip(shown[1:], wanted[1:], strict=True):
            np.testing.assert_array_equal(mine, other, f"step {step}")
        for key in ("acted", "terms", "arrivals", "vehicle_done", "episode_over"):
            np.testing.assert_array_equal(told[key], infos[key], f"step {step}: {key}")
        if not infos["episode_over"][0]:
            np.testing.assert_array_equal(told["mask"], infos["mask"])
            continue
        episodes += 1
        assert not told["mask"].any()
        first, rewards, ended, cut, told = late.step(np.full_like(actions, np.nan))  # ignored
        np.testing.assert_array_equal(first, wanted[0])
        np.testing.assert_array_equal(told["mask"], infos["mask"])
        assert not rewards.any()
        assert not (ended | cut | told["acted"]).any()
        assert not told["episode_over"].any()
        assert late.state_hash() == now.state_hash()
    assert episodes >= 3


def test_chosen_worlds_are_reset_and_other_worlds_continue() -> None:
    vec, alone = make(3), make(3)
    vec.reset(seed=3)
    alone.reset(seed=3)
    rng = np.random.default_rng(0)
    chosen = np.array([False, True, False])
    for _ in range(7):
        actions = wild(rng, vec)
        seen = vec.step(actions)[0]
        alone.step(actions)
    hashes = [vec.state_hash(w) for w in range(3)]
    observations, infos = vec.reset(options={"reset_mask": chosen})
    begun, _ = alone.reset()
    np.testing.assert_array_equal(observations[chosen], begun[chosen])
    np.testing.assert_array_equal(observations[~chosen], seen[~chosen])
    assert infos["mask"][chosen].all()
    assert [vec.state_hash(0), vec.state_hash(2)] == [hashes[0], hashes[2]]
    assert vec.state_hash(1) == alone.state_hash(1) != hashes[1]


@pytest.mark.parametrize(
    ("options", "seed", "message"),
    [
        ({"reset_mask": [True]}, None, r"reset_mask has shape \(1,\)"),
        ({"reset_mask": [1, 0]}, None, "dtype int64: must be"),
        ({"reset_mask": [True, False]}, 3, "reset_mask with a seed"),
    ],
)
def test_a_wrong_reset_mask_is_refused(
    options: dict[str, Any], seed: int | None, message: str
) -> None:
    vec = make(2)
    with pytest.raises(EpisodeError, match="before the first reset"):
        vec.reset(options={"reset_mask": np.ones(2, dtype=bool)})
    vec.reset(seed=0)
    with pytest.raises(ConfigError, match=message):
        vec.reset(seed=seed, options=options)


@pytest.mark.parametrize("mode", ["same_step", None])
def test_a_wrong_autoreset_mode_is_refused(mode: Any) -> None:
    with pytest.raises(ConfigError, match="must be 'SameStep', 'NextStep' or 'Disabled'"):
        make(1, autoreset_mode=mode)


def test_a_world_without_autoreset_waits_for_a_reset_after_its_episode() -> None:
    """Steps equal those of `NEXT_STEP`, and the reset begins the same next episode."""
    waits, late = make(2, autoreset_mode="Disabled"), make(2, autoreset_mode="NextStep")
    assert waits.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    waits.reset(seed=4)
    late.reset(seed=4)
    actions = np.zeros(waits.action_space.shape, dtype=np.float32)
    over = np.zeros(2, dtype=np.bool_)
    while not over.any():
        seen, *_, infos = waits.step(actions)
        np.testing.assert_array_equal(seen, late.step(actions)[0])
        over = infos["episode_over"]
    with pytest.raises(EpisodeError, match=r"world 0 is over.*reset_mask"):
        waits.step(actions)
    seen, _ = waits.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(seen[over], late.step(actions)[0][over])
    waits.step(actions)


@pytest.mark.parametrize("mode", MODES)
def test_the_mask_marks_acting_agents(mode: str) -> None:
    vec = make(3, mode)
    observations, infos = vec.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(100):
        mask = infos["mask"]
        assert not observations[~mask].any(), (
            "an agent without a vehicle observes values other than 0"
        )
        assert observations[mask].any(axis=-1).all()
        actions = wild(rng, vec)
        actions[~mask] = np.nan  # ignored
        observations, rewards, terminations, _, infos = vec.step(actions)
        assert not rewards[~mask].any()
        assert not infos["terms"][~mask].any()
        assert not terminations[~mask].any()
        np.testing.assert_array_equal(terminations, infos["vehicle_done"] & mask)
        assert not (terminations & infos["mask"])[~infos["episode_over"]].any()


def test_the_arrays_have_the_shapes_and_dtypes_of_the_spaces() -> None:
    vec = make(3)
    shape = (3, 4)
    size = vec.single_observation_space.shape[0]

    def check(array: NDArray[Any], dtype: type[np.generic], *more: int) -> None:
        assert array.shape == (*shape, *more)
        assert array.dtype == dtype

    observations, infos = vec.reset(seed=0)
    check(observations, np.float32, size)
    actions = vec.suggest_actions()
    check(actions, np.float32, 2)
    observations, rewards, terminations, truncations, infos = vec.step(actions)
    check(observations, np.float32, size)
    check(rewards, np.float32)
    for ends in (terminations, truncations, infos["mask"], infos["acted"], infos["vehicle_done"]):
        check(ends, np.bool_)
    assert infos["terms"].shape == (*shape, len(TERMS))
    assert infos["final_observations"].shape == observations.shape
    assert infos["episode_over"].shape == (3,)
    assert vec.step_s == vec.config.clock.ctrl_dt_s
    vec.close()


@pytest.mark.parametrize("mode", MODES)
def test_results_without_copies_are_equal_read_only_views(mode: str) -> None:
    stack = {"sensors.stack": 2}
    kept, shown = (make(3, mode, overrides=stack, copy=copy) for copy in (True, False))
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(shown.reset(seed=5)[0], kept.reset(seed=5)[0])
    ended = over = 0
    for _ in range(90):
        actions = wild(rng, kept)
        one, other = kept.step(actions), shown.step(actions)
        np.testing.assert_array_equal(other[0], one[0])
        np.testing.assert_array_equal(other[4]["final_observations"], one[4]["final_observations"])
        ended += int(one[2].sum())
        over += int(one[4]["episode_over"].sum())
    assert ended
    assert over
    with pytest.raises(ValueError, match="read-only"):
        other[0][:] = 0.0
    assert np.shares_memory(other[0], shown.simulation.outputs.observations)


def test_later_steps_do_not_change_earlier_results() -> None:
    vec = make(2)
    vec.reset(seed=0)
    kept = vec.step(vec.suggest_actions())[:4]
    copies = [array.copy() for array in kept]
    for _ in range(45):
        vec.step(vec.suggest_actions())
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_suggested_discrete_actions_are_integers() -> None:
    vec = make(2, overrides={"action.kind": "discrete"})
    vec.reset(seed=0)
    for _ in range(10):
        actions = vec.suggest_actions()
        assert (actions.shape, actions.dtype.kind) == ((2, 4), "i")
        assert all(vec.single_action_space.contains(action) for action in actions.ravel())
        vec.step(actions)
