"""Export of trained drivers to ONNX models, which give the same actions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.cli import main
from cavmarl.config.action import ActionConfig
from cavmarl.config.registry import agent_entries, load_config
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.networks.driver_network import DriverNetwork, load_driver_network
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.policies.loading import load_policy
from cavmarl.policies.map_check import UntrainedMapWarning
from cavmarl.policies.onnx_export import export_onnx, onnx_model
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

onnxruntime = pytest.importorskip("onnxruntime")

TRAINED = [name for name, path in agent_entries().items() if path.is_dir()]
CLOSE = 2e-6  # the tolerance between torch and the kernel


def run(path: Path, observations: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (outputs,) = session.run(None, {"observations": observations})
    return np.asarray(outputs)


def observations_of(size: int, rows: int = 400) -> np.ndarray:
    """Draw observations; normalisation clips some of them."""
    return np.random.default_rng(3).normal(0.0, 2.0, (rows, size)).astype(np.float32)


@pytest.mark.parametrize("name", TRAINED)
def test_the_model_of_each_driver_gives_its_actions(name: str, tmp_path: Path) -> None:
    path = tmp_path / "driver.onnx"
    config = export_onnx(name, path)
    seen = observations_of(config.observation_size)
    best = load_driver_network(agent_entries()[name]).best(seen)
    found = run(path, seen)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, best, rtol=0.0, atol=CLOSE)
    assert np.ptp(best, axis=0).min() > 0.05


@pytest.mark.parametrize("shared", [False, True])
def test_the_model_of_a_driver_with_discrete_actions_gives_its_logits(
    shared: bool, tmp_path: Path
) -> None:
    environment, _ = load_config("merge")
    action = ActionConfig(kind="discrete")
    config = NetworkConfig("merge", 30, environment.sensors, action, hidden=(24, 16), shared=shared)
    draw = np.random.default_rng(5)
    weights = {
        name: draw.normal(0.0, 0.4, shape).astype(np.float32)
        for name, shape in config.shapes.items()
    }
    weights["deviation"] = np.abs(weights["deviation"]) + np.float32(0.5)
    path = tmp_path / "driver.onnx"
    path.write_bytes(onnx_model(weights, config, "driver"))
    seen = observations_of(30)
    network = DriverNetwork(weights, config)
    found = run(path, seen)
    assert found.shape == (len(seen), action.choices)
    np.testing.assert_allclose(found, network.outputs(seen), rtol=0.0, atol=1e-5)
    assert (found.argmax(axis=1) == network.best(seen)).all()


def test_equal_drivers_give_equal_bytes(tmp_path: Path) -> None:
    for file in ("a.onnx", "b.onnx"):
        export_onnx("merge_ippo", tmp_path / file)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


def test_the_onnx_checker_accepts_the_model(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    for name in ("cities_residual", "merge_ippo"):
        export_onnx(name, tmp_path / "driver.onnx")
        onnx.checker.check_model(onnx.load(str(tmp_path / "driver.onnx")), full_check=True)


@pytest.mark.parametrize("name", ["cities_ippo", "cities_residual"])
def test_the_model_and_the_driver_give_equal_actions_in_a_world(name: str, tmp_path: Path) -> None:
    path = tmp_path / "driver.onnx"
    export_onnx(name, path)
    vec = make_vec("grid4x4", num_envs=2, agents=4, background=6, sensors_of=name)
    driver, model = load_policy(name, vec), load_policy(path, vec)
    observations, infos = vec.reset(seed=4)
    for _ in range(6):
        actions = driver.act_batch(observations, infos["mask"])
        found = model.act_batch(observations, infos["mask"])
        np.testing.assert_allclose(found, actions, rtol=0.0, atol=CLOSE)
        observations, _, _, _, infos = vec.step(actions)
    assert infos["mask"].sum() > 4
    vec.close()


@pytest.mark.integration
@pytest.mark.parametrize("name", ["cities_ippo", "cities_residual"])
def test_the_model_and_the_driver_give_equal_actions_in_left_hand_traffic(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / "driver.onnx"
    export_onnx(name, path)
    right = netgenerate(tmp_path / "right.net.xml", "--grid", "--grid.number", "3")
    left = mirror_net(right, tmp_path / "left.net.xml")
    vec = make_vec(left, agents=4, background=2, sensors_of=name)
    said = "trained in right-hand traffic, but this map has left-hand traffic"
    with pytest.warns(UntrainedMapWarning, match=said):
        driver = load_policy(name, vec)
    with pytest.warns(UntrainedMapWarning, match=rf"driver\.onnx was {said}") as warned:
        model = load_policy(path, vec)
    assert warned[0].filename == __file__
    observations, infos = vec.reset(seed=4)
    for _ in range(6):
        actions = driver.act_batch(observations, infos["mask"])
        found = model.act_batch(observations, infos["mask"])
        np.testing.assert_allclose(found, actions, rtol=0.0, atol=CLOSE)
        observations, _, _, _, infos = vec.step(actions)
    assert np.abs(actions[infos["mask"], 1]).max() > 1e-3
    vec.close()


def test_a_model_is_refused_in_a_world_with_other_sensors(tmp_path: Path) -> None:
    path = tmp_path / "driver.onnx"
    export_onnx("cities_ippo", path)
    env = parallel_env("merge", agents=2)
    with pytest.raises(PolicyError, match=r"expects different sensors .* --sensors-of cities_ippo"):
        load_policy(path, env)
    env.close()


def test_unreadable_metadata_are_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "driver.onnx"
    export_onnx("merge_ippo", path)
    path.write_bytes(path.read_bytes().replace(b'"hidden"', b'"hiddex"'))
    env = parallel_env("merge", agents=2)
    with pytest.raises(PolicyError, match=r"export the driver again: cavmarl zoo export"):
        load_policy(path, env)
    env.close()


def test_only_trained_drivers_are_exported_to_onnx_files(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="is a script or a model file; only trained drivers"):
        export_onnx("idm", tmp_path / "idm.onnx")
    with pytest.raises(ConfigError, match=r"must end in \.onnx"):
        export_onnx("merge_ippo", tmp_path / "merge.model")
    with pytest.raises(ConfigError, match=r"cannot be written .* in an existing folder"):
        export_onnx("merge_ippo", tmp_path / "nowhere" / "merge.onnx")
    with pytest.raises(PolicyError, match="no policy, folder or file 'merge_ipo'"):
        export_onnx("merge_ipo", tmp_path / "merge.onnx")


def test_the_command_writes_the_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cities.onnx"
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "export", "cities_residual", "--onnx", str(path)])
    assert ended.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "observations (N, 122) to actions (N, 2); the last two observations" in said
    assert run(path, np.zeros((1, 122), dtype=np.float32)).shape == (1, 2)
