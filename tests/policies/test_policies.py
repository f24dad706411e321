"""Policies: loading by name or path, checks of the environment, and driving."""

from __future__ import annotations

import json
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import agent_entries
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.cosim.stack.stack import REFERENCE_RIG
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.policies import shield
from cavmarl.policies.loading import driver_keys, load_policy, policy_files
from cavmarl.policies.policy import Environment, Policy
from cavmarl.policies.shield import ShieldedPolicy
from tests.support.saved_drivers import save_driver, small_vec

SCRIPTED = ("idm", "random_actions")
ACTIONS = ("continuous", "discrete")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """Save an untrained driver for `merge`."""
    pytest.importorskip("torch")
    return save_driver(tmp_path / "driver", small_vec())


@pytest.mark.parametrize("kind", ACTIONS)
@pytest.mark.parametrize("name", SCRIPTED)
def test_scripted_drivers_drive_batches(name: str, kind: str) -> None:
    vec = small_vec(action__kind=kind)
    policy = load_policy(name, vec)
    observations, infos = vec.reset(seed=1)
    policy.reset(1)
    for _ in range(5):
        observations, _, _, _, infos = vec.step(policy.act_batch(observations, infos["mask"]))


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
@pytest.mark.parametrize("form", ["flat", "dict"])
@pytest.mark.parametrize("name", SCRIPTED)
def test_scripted_drivers_drive_dicts(name: str, form: str, mode: str) -> None:
    overrides = {"observation.kind": form, "population.mode": mode}
    env = parallel_env("merge", agents=3, background=2, max_cycles=80, overrides=overrides)
    drive(env, load_policy(name, env), 80)


def drive(env: CavEnv, policy: Policy, steps: int) -> None:
    observations, _ = env.reset(seed=3)
    policy.reset(3)
    for _ in range(steps):
        if not env.agents:
            break
        observations, *_ = env.step(policy.act(observations))


@pytest.mark.parametrize("form", ["flat", "dict"])
def test_a_network_gives_the_same_actions_for_dicts_and_batches(
    checkpoint: Path, form: str
) -> None:
    vec = make_vec("merge", num_envs=1, agents=3, background=4)
    env = parallel_env("merge", agents=3, background=4, overrides={"observation.kind": form})
    one, many = load_policy(checkpoint, env), load_policy(checkpoint, vec)
    seen, _ = env.reset(seed=5)
    batch, infos = vec.reset(seed=5)
    for _ in range(3):
        by_agent, by_index = one.act(seen), many.act_batch(batch, infos["mask"])
        for k, agent in enumerate(env.possible_agents):
            if infos["mask"][0, k]:
                np.testing.assert_array_equal(by_agent[agent], by_index[0, k])
        seen, *_ = env.step(by_agent)
        batch, _, _, _, infos = vec.step(by_index)


def test_a_network_acts_only_where_the_mask_is_set(checkpoint: Path) -> None:
    vec = small_vec()
    policy = load_policy(checkpoint, vec)
    observations, infos = vec.reset(seed=0)
    mask = infos["mask"].copy()
    mask[0] = False
    actions = policy.act_batch(observations, mask)
    assert actions.shape == (2, 3, 2)
    assert not actions[0].any()
    assert actions[1].any()
    assert np.abs(actions).max() <= 1.0


def test_random_actions_repeat_with_the_seed() -> None:
    vec = small_vec()
    policy = load_policy("random_actions", vec)
    observations, infos = vec.reset(seed=0)

    def draw(seed: int) -> list[float]:
        policy.reset(seed)
        return [float(policy.act_batch(observations, infos["mask"]).sum()) for _ in range(3)]

    assert draw(7) == draw(7)
    assert draw(7) != draw(8)


# Settings that scripted drivers require.
NEEDED = {
    "fleet": {"population.fleet": [{"driver": "idm"}]},
    "cacc": {
        "v2x.enabled": True,
        "sensors.messages.objects": 4,
        "sensors.lanes.range_m": 100.0,
        "sensors.signal.enabled": True,
    },
    "gap_taker": {
        "v2x.enabled": True,
        "sensors.conflicts.count": 4,
        "sensors.conflicts.heard": True,
        "sensors.signal.enabled": True,
    },
    "glosa": {
        "v2x.enabled": True,
        "sensors.messages.signal": True,
        "sensors.messages.timing": True,
    },
    "reference": {"rig": REFERENCE_RIG},
}


def test_each_driver_of_cavmarl_loads_in_its_environment() -> None:
    for name, path in agent_entries().items():
        config = path / "config.json"
        home = json.loads(config.read_text())["environment"] if path.is_dir() else "merge"
        keys = driver_keys(name) if path.is_dir() else NEEDED.get(name)
        policy = load_policy(name, make_vec(home, overrides=keys))
        assert isinstance(policy, Policy)


def test_a_policy_for_a_wrapped_environment_uses_the_environment_inside() -> None:
    from pettingzoo.utils.wrappers import BaseParallelWrapper

    env = parallel_env("merge", agents=2, background=0)
    assert load_policy("idm", BaseParallelWrapper(env)).env is env


@pytest.mark.parametrize("wrong", ["merge", None, 3])
def test_only_environments_of_cavmarl_are_accepted(wrong: Any) -> None:
    with pytest.raises(PolicyError, match=r"pass what parallel_env\(\) or make_vec\(\) returned"):
        load_policy("idm", wrong)


def test_the_error_for_an_unknown_name_names_the_nearest_and_all() -> None:
    with pytest.raises(PolicyError, match=r"'idn'; did you mean idm\? Drivers: .*random_actions"):
        load_policy("idn", small_vec())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def make_policy(env: object) ->", ", line 1: SyntaxError"),
        ("\n\nimport nowhere_to_be_found", ", line 3: ModuleNotFoundError"),
        ("x = 1", r": .*no function make_policy\(env\)"),
        ("def make_policy(env): return 3", ": .*returned a int, not a"),
    ],
)
def test_the_error_for_a_broken_script_names_the_line(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(PolicyError, match=rf"mine\.py{message}"):
        load_policy(path, small_vec())


@pytest.mark.parametrize("policy", [None, 3, ["idm"]])
def test_a_policy_that_is_neither_a_name_nor_a_path_is_refused(policy: Any) -> None:
    with pytest.raises(PolicyError, match=r"policy = .*: must be"):
        load_policy(policy, small_vec())


def test_a_file_that_is_no_policy_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pkl"
    path.touch()
    with pytest.raises(PolicyError, match=r"model\.pkl: not a policy"):
        load_policy(path, small_vec())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sensors__lidar__rays", 32),
        ("sensors__neighbors__range_m", 30.0),
        ("action__kind", "discrete"),
        ("action__steering_rad", 0.3),
    ],
)
def test_a_network_refuses_an_environment_with_other_sensors_or_actions(
    checkpoint: Path, key: str, value: Any
) -> None:
    vec = small_vec(**{key: value})
    name = key.replace("__", ".")
    with pytest.raises(PolicyError, match=rf"expects different .*overrides: .*'{name}'") as caught:
        load_policy(checkpoint, vec)
    at_home = attrgetter(name)(small_vec().config)
    assert f"{name} is {at_home} for it, {value} here" in str(caught.value)
    sizes = {seat.single_observation_space.shape[0] for seat in (small_vec(), vec)}
    assert all(str(size) in str(caught.value) for size in sizes)


def test_the_overrides_that_an_error_proposes_make_a_driver_fit(checkpoint: Path) -> None:
    changed = {"sensors.lidar.rays": 32, "action.kind": "discrete", "sensors.route.points": 2}
    with pytest.raises(PolicyError) as caught:
        load_policy(checkpoint, make_vec("merge", overrides=changed))
    import ast

    cure = ast.literal_eval(str(caught.value).partition("overrides: ")[2])
    load_policy(checkpoint, make_vec("merge", overrides={**changed, **cure}))
    load_policy(checkpoint, make_vec("merge", overrides=changed | driver_keys(checkpoint)))


@pytest.mark.parametrize("kind", ["batches", "dicts"])
def test_a_shield_brakes_when_the_built_in_driver_brakes_harder(kind: str) -> None:
    name = "shielded:never_yield"
    vec = small_vec() if kind == "batches" else make_vec("merge", num_envs=1, agents=3)
    shielded, bare, idm = (load_policy(one, vec) for one in (name, "never_yield", "idm"))
    one = parallel_env("merge", agents=3)
    seen, _ = one.reset(seed=5)
    alone = load_policy(name, one)
    observations, infos = vec.reset(seed=5)
    relieved = 0
    for _ in range(40):
        mask = infos["mask"]
        found, own, safe = (p.act_batch(observations, mask) for p in (shielded, bare, idm))
        brakes = (safe[..., 0] < 0.0) & (safe[..., 0] < own[..., 0])
        np.testing.assert_array_equal(found[mask], np.where(brakes[..., None], safe, own)[mask])
        relieved += int((brakes & mask).sum())
        if kind == "dicts":
            by_agent = alone.act(seen)
            for k, agent in enumerate(one.possible_agents):
                if agent in by_agent:
                    np.testing.assert_array_equal(by_agent[agent], found[0, k])
            seen, *_ = one.step(by_agent)
        observations, _, _, _, infos = vec.step(found)
    assert relieved
    assert policy_files(name) == policy_files("never_yield")


class Fixed(Policy):
    """A policy with constant actions."""

    def __init__(self, env: Environment, actions: NDArray[np.float32]) -> None:
        super().__init__(env)
        self.actions = actions

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> Any:
        return self.actions


def test_a_shield_changes_actions_only_to_brake_harder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vec = make_vec("merge", num_envs=1, agents=5)
    # Compared with the driver's own throttle, the built-in driver accelerates less, coasts, brakes
    # less, brakes equally or brakes harder.
    built_in = np.array([[(0.2, 0.5), (0.0, 0.5), (-0.3, 0.5), (-0.4, 0.5), (-0.9, 0.5)]])
    own = np.array([[(1.0, -0.1), (0.8, -0.1), (-0.6, -0.1), (-0.4, -0.1), (-0.2, -0.1)]])
    monkeypatch.setattr(shield, "built_in_actions", lambda env, mask: built_in)
    observations, infos = vec.reset(seed=0)
    found = ShieldedPolicy(vec, Fixed(vec, own)).act_batch(observations, infos["mask"])
    assert found[0, :4].tolist() == own[0, :4].tolist()
    assert found[0, 4].tolist() == [-0.9, 0.5]
    assert own[0, 4].tolist() == [-0.2, -0.1], "the shield changed the driver's own array"


def test_a_residual_driver_adds_to_the_actions_of_the_built_in_driver(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    vec = make_vec("merge", num_envs=1, agents=3)
    folder = save_driver(tmp_path / "residual", vec, residual=True)
    policy, idm = load_policy(folder, vec), load_policy("idm", vec)
    network = policy.network  # type: ignore[attr-defined]
    one = parallel_env("merge", agents=3)
    seen, _ = one.reset(seed=5)
    alone = load_policy(folder, one)
    observations, infos = vec.reset(seed=5)
    for step in range(40):
        mask = infos["mask"]
        proposed, found = (p.act_batch(observations, mask)[mask] for p in (idm, policy))
        known = np.concatenate([observations[mask], proposed], axis=1)
        own = network.outputs(known) * np.array([1.0, 0.1], dtype=np.float32)
        due = (own + proposed).clip(-1.0, 1.0)
        np.testing.assert_array_equal(found, due)
        assert step > 0 or (np.abs(due - proposed) > 0.0).any()
        by_agent = alone.act(seen)
        for row, k in zip(found, np.flatnonzero(mask[0]), strict=True):
            np.testing.assert_array_equal(by_agent[one.possible_agents[k]], row)
        seen, *_ = one.step(by_agent)
        observations, _, _, _, infos = vec.step(policy.act_batch(observations, mask))


def test_a_residual_driver_with_discrete_actions_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    with pytest.raises(ConfigError, match=r"residual with action\.kind = discrete: choices cannot"):
        save_driver(tmp_path, small_vec(action__kind="discrete"), residual=True)


def test_a_shield_refuses_discrete_actions() -> None:
    vec = small_vec(action__kind="discrete")
    observations, infos = vec.reset(seed=0)
    with pytest.raises(PolicyError, match=r"action\.kind = discrete: this driver needs throttle"):
        load_policy("shielded:idm", vec).act_batch(observations, infos["mask"])


def test_the_opponents_blind_and_phantom_braking_drive_worse_than_idm() -> None:
    vec = make_vec("merge", num_envs=4, agents=8)
    rows = {}
    for name in ("blind", "phantom_braking", "idm"):
        policy = load_policy(name, vec)
        for again in range(2 if name != "idm" else 1):
            observations, infos = vec.reset(seed=1)
            policy.reset(3)
            throttles, contacts = [], 0
            for _ in range(100):
                actions = policy.act_batch(observations, infos["mask"])
                throttles.append(actions[..., 0][infos["mask"]])
                observations, _, _, _, infos = vec.step(actions)
                contacts += int((infos["terms"][..., TERMS.index("collision")] > 0.0).sum())
            found = np.concatenate(throttles)
            if again:
                np.testing.assert_array_equal(found, rows[name][0])
            rows[name] = (found, contacts)
    assert rows["blind"][1] > 0 == rows["idm"][1]
    hard = {name: float((found < -0.35).mean()) for name, (found, _) in rows.items()}
    assert hard["phantom_braking"] > hard["idm"] + 0.02


def test_code_of_the_working_directory_runs_only_if_its_path_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of the working directory cannot replace a driver that is given by name."""
    trap = "raise SystemExit('it was run')\n"
    (tmp_path / "agents").mkdir()
    for name in ("idm.py", "mine.py"):
        (tmp_path / "agents" / name).write_text(trap)
    monkeypatch.chdir(tmp_path)
    env = parallel_env("ring", agents=1)
    with pytest.raises(PolicyError, match=r"'idm': both a driver of cavmarl and .*agents/idm\.py"):
        load_policy("idm", env)
    with pytest.raises(PolicyError, match=r"'mine': .*agents/mine\.py is code.*give its path"):
        load_policy("mine", env)
    with pytest.raises(SystemExit, match="it was run"):
        load_policy("agents/mine.py", env)
    (tmp_path / "agents" / "merge_ippo").mkdir()
    (tmp_path / "agents" / "merge_ippo" / "model.safetensors").touch()
    with pytest.raises(PolicyError, match=r"'merge_ippo': both a driver of cavmarl and"):
        load_policy("merge_ippo", env)


def test_idm_does_not_get_stuck_at_the_end_of_a_short_lane() -> None:
    """The road of 25 m is too short to finish a lane change, but the vehicle must not get stuck."""
    vec = make_vec("cities_validation", num_envs=1, agents=1, background=0)
    driver = load_policy("idm", vec)
    observations, infos = vec.reset(seed=500, options={"first_world": 89})
    driver.reset(500)
    stood_s = 0.0
    for _ in range(500):
        observations, _, _, _, infos = vec.step(driver.act_batch(observations, infos["mask"]))
        stood_s = max(stood_s, *vec.simulation.vehicles(0)["wait_s"], 0.0)
    vec.close()
    assert 0.0 < stood_s < 60.0  # only at a red light
