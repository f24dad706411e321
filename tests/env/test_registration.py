"""Ids of environments in Gymnasium and PettingZoo, and arguments of their environments."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest

import cavmarl
from cavmarl.config.registry import entries, load_config
from cavmarl.core.seeds import check_seed, first_seed

ALL = sorted(entries())


@pytest.mark.parametrize("name", ALL)
def test_every_environment_is_registered_under_its_ids(name: str) -> None:
    version = load_config(name)[0].version
    assert f"cavmarl/{name}-v{version}" in gymnasium.registry
    assert f"cavmarl/{name}Agents-v{version}" in gymnasium.registry
    assert f"cavmarl/{name}Discrete-v{version}" in gymnasium.registry
    assert f"cavmarl/{name}DiscreteAgents-v{version}" in gymnasium.registry
    ours = [spec for spec in gymnasium.registry if spec.startswith("cavmarl/")]
    assert len(ours) == 4 * len(ALL)
    if not hasattr(pettingzoo, "make"):
        pytest.skip("this PettingZoo has no registry")
    for kind in ("parallel", "aec"):
        world = pettingzoo.make(kind, f"cavmarl/{name}-v{version}", max_cycles=3)
        world.reset(seed=0)
        assert world.agents


def test_ids_that_contain_discrete_select_meta_actions_even_with_other_overrides() -> None:
    """Programs such as those of CleanRL take an id only, so the id must select the actions."""
    five = gymnasium.spaces.Discrete(5)
    assert gymnasium.make("cavmarl/ringDiscrete-v5").action_space == five
    assert gymnasium.make("cavmarl/ring-v5").action_space != five
    more = {"overrides": {"sensors.lidar.rays": 8}}
    assert gymnasium.make("cavmarl/ringDiscrete-v5", **more).action_space == five
    rows = gymnasium.make_vec("cavmarl/ringDiscreteAgents-v5", num_envs=2, **more)
    assert rows.single_action_space == five


def test_an_aec_environment_refuses_a_wrong_action_and_continues() -> None:
    world = cavmarl.env("ring", agents=2, background=0)
    world.reset(seed=0)
    before = world.agent_selection
    with pytest.raises(cavmarl.ActionError, match="car_0"):
        world.step(np.array([np.nan, 0.0]))
    assert world.agent_selection == before
    for _ in range(4):
        world.step(np.zeros(2))
    assert world.agent_selection == "car_0"


@pytest.mark.parametrize("seed", [-1, 1 << 63, True, 1.0, "a"])
def test_a_wrong_seed_is_refused_when_the_world_is_made(seed: object) -> None:
    with pytest.raises(cavmarl.ConfigError, match="seed"):
        cavmarl.parallel_env("ring", seed=seed)
    with pytest.raises(cavmarl.ConfigError, match="seed"):
        cavmarl.make_vec("ring", seed=seed)


def test_first_resets_without_a_seed_use_different_seeds() -> None:
    assert first_seed(None, None) != first_seed(None, None)
    assert first_seed(None, 5) == 5
    assert first_seed(7, 5) == 7
    assert check_seed(np.uint64(9)) == 9


def test_numpy_numbers_are_accepted_as_settings() -> None:
    world = cavmarl.parallel_env(
        "ring",
        agents=np.int64(3),
        background=np.int32(2),
        max_cycles=np.int16(7),
        overrides={"sensors.lidar.rays": np.uint8(16), "traffic.goals": np.int64(4)},
    )
    assert world.config.population.agents == 3
    assert world.max_cycles == 7
    assert world.config.sensors.lidar.rays == 16


@pytest.mark.parametrize("env", [None, 3, ["ring"]])
def test_invalid_names_are_refused(env: object) -> None:
    with pytest.raises(cavmarl.UnknownEnvironmentError, match="must be the name"):
        cavmarl.parallel_env(env)


@pytest.mark.parametrize("overrides", [[1, 2], "sensors", 3])
def test_overrides_that_are_not_a_mapping_are_refused(overrides: object) -> None:
    with pytest.raises(cavmarl.ConfigError, match="must map dotted keys"):
        cavmarl.parallel_env("ring", overrides=overrides)


def test_keys_of_overrides_that_are_not_text_are_refused() -> None:
    with pytest.raises(cavmarl.ConfigError, match="3 is not a key"):
        cavmarl.parallel_env("ring", overrides={3: 3})


def test_a_horizon_that_is_not_a_whole_number_of_steps_is_refused() -> None:
    with pytest.raises(cavmarl.ConfigError, match=r"horizon_s = 1\.04.*try 1$"):
        cavmarl.parallel_env("ring", overrides={"horizon_s": 1.04})


def test_unusual_folders_do_not_break_the_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders with unusual names in the user's `envs` can be used, and have an id if possible."""
    odd = [b"a space", b"not\xffutf8", b"two\nlines", b"-dash", b"latin", b"fine"]
    for name in odd:
        folder = Path(os.fsdecode(bytes(tmp_path) + b"/envs/" + name))
        folder.mkdir(parents=True)
        (folder / "env.yaml").write_bytes(b"name: \xe9\nversion: 99999999999999999999\n")
    (tmp_path / "envs" / "hollow" / "env.yaml").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-W", "error", "-m", "cavmarl", "list"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "a space" in done.stdout
    assert "not" not in {name[:3] for name in entries()}
    assert {"a space", "-dash", "latin", "fine", "ring"} <= set(entries())
    told = "import gymnasium, cavmarl; print('\\n'.join(gymnasium.registry))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", told], capture_output=True, text=True, check=True
    )
    ids = set(done.stdout.splitlines())
    assert {"cavmarl/fine-v999999999", "cavmarl/ring-v5"} <= ids
    assert not any(" " in name or "-dash" in name for name in ids)
    with pytest.raises(cavmarl.ConfigError, match="latin"):
        cavmarl.parallel_env("latin")
