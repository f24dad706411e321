"""Drivers that are model files of stable-baselines3, TorchScript or ONNX."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import MissingExtraError, PolicyError
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.policies.loading import load_policy, policy_files
from cavmarl.policies.model_files import ModelPolicy
from tests.support.saved_drivers import small_vec

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

SIZE = 105  # observed numbers in `merge`


def rows(**overrides: Any) -> CavSb3VecEnv:
    return CavSb3VecEnv("merge", num_worlds=1, agents=3, background=4, overrides=overrides, seed=0)


def act(policy: Any, vec: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive some steps; return the observations and actions of acting agents, and their mask."""
    observations, infos = vec.reset(seed=2)
    for _ in range(3):
        actions = policy.act_batch(observations, infos["mask"])
        observations, _, _, _, infos = vec.step(actions)
    mask = infos["mask"]
    return observations[mask], policy.act_batch(observations, mask)[mask], mask


@pytest.mark.parametrize("kind", [PPO, A2C, SAC])
def test_the_actions_of_a_model_of_stable_baselines3_equal_its_predictions(
    kind: Callable[..., BaseAlgorithm], tmp_path: Path
) -> None:
    worlds = rows()
    model = kind("MlpPolicy", worlds, seed=1)
    model.save(tmp_path / "model")
    worlds.close()
    vec = small_vec()
    seen, actions, _ = act(load_policy(tmp_path / "model.zip", vec), vec)
    np.testing.assert_array_equal(actions, model.predict(seen, deterministic=True)[0])


def test_a_model_with_discrete_actions_gives_its_predictions(tmp_path: Path) -> None:
    worlds = rows(**{"action.kind": "discrete"})
    model = DQN("MlpPolicy", worlds, seed=1, buffer_size=100)
    model.save(tmp_path / "model")
    worlds.close()
    vec = small_vec(action__kind="discrete")
    seen, actions, _ = act(load_policy(tmp_path / "model.zip", vec), vec)
    np.testing.assert_array_equal(actions, model.predict(seen, deterministic=True)[0])
    with pytest.raises(PolicyError, match=r"acts in 5 choices, but the environment has \(2,\)"):
        load_policy(tmp_path / "model.zip", small_vec())


def test_a_model_with_dict_observations_gives_its_predictions(tmp_path: Path) -> None:
    worlds = rows(**{"observation.kind": "dict"})
    model = PPO("MultiInputPolicy", worlds, seed=1)
    model.save(tmp_path / "model")
    worlds.close()
    env = parallel_env("merge", agents=3, overrides={"observation.kind": "dict"})
    policy = load_policy(tmp_path / "model.zip", env)
    observations, _ = env.reset(seed=0)
    actions = policy.act(observations)
    for agent, action in actions.items():
        expected = model.predict(observations[agent], deterministic=True)[0]
        np.testing.assert_allclose(action, expected, atol=1e-6)
    with pytest.raises(PolicyError, match="observes a Dict"):
        load_policy(tmp_path / "model.zip", small_vec())


def test_a_normalized_model_needs_its_statistics(tmp_path: Path) -> None:
    worlds = VecNormalize(rows(), norm_reward=False)
    model = PPO("MlpPolicy", worlds, n_steps=8, batch_size=8, n_epochs=1, seed=1)
    model.learn(24)
    path = tmp_path / "model.zip"
    model.save(path)
    vec = small_vec()
    with pytest.raises(PolicyError, match=r"worlds\.save\('model\.pkl'\)"):
        load_policy(path, vec)
    worlds.save(str(tmp_path / "model.pkl"))
    assert policy_files(path) == (path, tmp_path / "model.pkl")
    seen, actions, _ = act(load_policy(path, vec), vec)
    expected = model.predict(worlds.normalize_obs(seen), deterministic=True)[0]
    np.testing.assert_array_equal(actions, expected)
    assert not np.allclose(actions, model.predict(seen, deterministic=True)[0])
    worlds.close()


def save_script(path: Path, module: torch.nn.Module) -> None:
    with pytest.warns(DeprecationWarning, match="torch.export"):
        torch.jit.trace(module, torch.zeros(1, SIZE)).save(str(path))  # type: ignore[no-untyped-call]


def test_a_torch_script_gives_its_outputs_as_actions(tmp_path: Path) -> None:
    module = torch.nn.Linear(SIZE, 2)
    save_script(tmp_path / "model.pt", module)
    vec = small_vec()
    seen, actions, mask = act(load_policy(tmp_path / "model.pt", vec), vec)
    expected = module(torch.from_numpy(seen)).detach().numpy()
    np.testing.assert_allclose(actions, expected.clip(-1.0, 1.0), atol=1e-6)
    assert mask.any()


def test_a_torch_script_with_logits_chooses_the_largest(tmp_path: Path) -> None:
    module = torch.nn.Linear(SIZE, 5)
    save_script(tmp_path / "model.ts", module)
    vec = small_vec(action__kind="discrete")
    seen, actions, _ = act(load_policy(tmp_path / "model.ts", vec), vec)
    np.testing.assert_array_equal(actions, module(torch.from_numpy(seen)).argmax(axis=1).numpy())
    with pytest.raises(PolicyError, match=r"shape \(1, 5\); with action.kind = continuous"):
        load_policy(tmp_path / "model.ts", small_vec())


def test_a_model_for_other_sensors_is_refused(tmp_path: Path) -> None:
    save_script(tmp_path / "model.pt", torch.nn.Linear(SIZE, 2))
    vec = make_vec("merge", agents=1, overrides={"sensors.stack": 2})
    with pytest.raises(PolicyError, match="210 numbers that an agent observes here"):
        load_policy(tmp_path / "model.pt", vec)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("model.zip", "not a model that stable-baselines3 saved"),
        ("model.pt", "not a TorchScript file"),
        ("model.txt", r"not a policy; .*\.onnx"),
    ],
)
def test_files_that_are_no_models_are_refused(tmp_path: Path, name: str, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"nothing")
    with pytest.raises(PolicyError, match=message):
        load_policy(path, small_vec())


def test_a_state_dict_is_refused_as_torch_script(tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(SIZE, 2).state_dict(), tmp_path / "model.pt")
    with pytest.raises(PolicyError, match=r"save the module with torch\.jit\.trace"):
        load_policy(tmp_path / "model.pt", small_vec())


def test_onnx_needs_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model.onnx").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"'onnxruntime' is not installed: .*\[onnx\]"):
        load_policy(tmp_path / "model.onnx", small_vec())


class FakeSession:
    """A substitute for the inference session of onnxruntime; its model always brakes."""

    def __init__(self, path: str, providers: list[str]) -> None:
        if not Path(path).read_bytes():
            raise ValueError("no protobuf\nin here")

    def get_inputs(self) -> list[Any]:
        return [SimpleNamespace(name="seen")]

    def get_modelmeta(self) -> Any:
        return SimpleNamespace(custom_metadata_map={}, graph_name="")

    def run(self, outputs: None, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        return [np.full((len(feed["seen"]), 2), -0.5, dtype=np.float32)]


def test_an_onnx_model_gets_observations_under_the_name_of_its_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.onnx"
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(InferenceSession=FakeSession))
    path.write_bytes(b"model")
    vec = small_vec()
    _, actions, _ = act(load_policy(path, vec), vec)
    assert (actions == -0.5).all()
    path.write_bytes(b"")
    with pytest.raises(PolicyError, match=r"not an ONNX model: no protobuf$"):
        load_policy(path, vec)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the exporter warns about itself
def test_a_real_onnx_model_gives_its_outputs_as_actions(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    module = torch.nn.Linear(SIZE, 2)
    path = tmp_path / "model.onnx"
    torch.onnx.export(
        module, (torch.zeros(1, SIZE),), str(path), dynamic_axes={"seen": {0: "rows"}},
        input_names=["seen"], dynamo=False,
    )  # fmt: skip
    vec = small_vec()
    seen, actions, _ = act(load_policy(path, vec), vec)
    expected = module(torch.from_numpy(seen)).detach().numpy()
    np.testing.assert_allclose(actions, expected.clip(-1.0, 1.0), atol=1e-5)


def test_a_function_can_be_a_model() -> None:
    vec = small_vec()
    policy = ModelPolicy(vec, lambda seen: np.full((len(seen), 2), 3.0))
    _, actions, _ = act(policy, vec)
    assert (actions == 1.0).all()
    with pytest.raises(PolicyError, match="must return finite numbers"):
        ModelPolicy(vec, lambda seen: np.full((len(seen), 2), np.nan))
