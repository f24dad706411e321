"""Files of trained drivers: the errors for damaged and inconsistent files."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.registry import agent_entries
from cavmarl.core.errors import PolicyError
from cavmarl.networks.driver_network import DriverNetwork, load_driver_network
from cavmarl.networks.network_files import read_network
from cavmarl.policies.loading import load_policy
from tests.support.saved_drivers import save_driver, small_vec

Tensors = dict[str, NDArray[Any]]


@pytest.fixture
def driver(tmp_path: Path) -> Path:
    return Path(shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "driver"))


def test_the_error_for_a_missing_or_broken_file_names_the_file(
    driver: Path, tmp_path: Path
) -> None:
    vec = small_vec()
    for name in (WEIGHTS_FILE, CONFIG_FILE):
        for text in (None, "", "{", "[]", "{}"):
            broken = tmp_path / "broken"
            shutil.copytree(driver, broken, dirs_exist_ok=True)
            (broken / name).unlink()
            if text is not None:
                (broken / name).write_text(text)
            with pytest.raises(PolicyError, match=name.replace(".", r"\.")):
                load_policy(broken, vec)


def test_a_truncated_file_of_weights_is_refused(driver: Path) -> None:
    path = driver / WEIGHTS_FILE
    whole = path.read_bytes()
    for size in (4, 200, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(PolicyError, match=r"model\.safetensors: cannot be read"):
            read_network(driver)


def test_sizes_beyond_the_file_are_refused_without_allocating_memory(driver: Path) -> None:
    size = 10**15
    header = {"mean": {"dtype": "F32", "shape": [size], "data_offsets": [0, 4 * size]}}
    text = json.dumps(header).encode()
    (driver / WEIGHTS_FILE).write_bytes(struct.pack("<Q", len(text)) + text)
    with pytest.raises(PolicyError, match=r"model\.safetensors: cannot be read"):
        read_network(driver)
    (driver / WEIGHTS_FILE).write_bytes(struct.pack("<Q", 2**63) + b"{}")
    with pytest.raises(PolicyError, match=r"model\.safetensors: cannot be read"):
        read_network(driver)


@pytest.mark.parametrize("hidden", [[9, 8], [], [0], [10**9], "8", [8] * 100])
def test_a_config_that_does_not_fit_its_weights_is_refused(driver: Path, hidden: object) -> None:
    path = driver / CONFIG_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "hidden": hidden}))
    with pytest.raises(PolicyError, match=r"hidden|does not fit config\.json"):
        load_policy(driver, small_vec())


def _set(name: str, value: float) -> Callable[[Tensors], object]:
    return lambda tensors: tensors[name].reshape(-1).__setitem__(0, value)


DAMAGES: dict[str, Callable[[Tensors], object]] = {
    r"'actor\.0\.bias' holds numbers that are not finite": _set("actor.0.bias", np.nan),
    r"'critic\.0\.weight' holds numbers that are not finite": _set("critic.0.weight", np.inf),
    r"'deviation' holds numbers that are not greater than 0": _set("deviation", 0.0),
    r"does not fit config\.json: 'mean' is missing": lambda tensors: tensors.pop("mean"),
    r"'actor\.2\.weight' has the shape \(64, 63\), not \(64, 64\)": lambda tensors: tensors.update(
        {"actor.2.weight": tensors["actor.2.weight"][:, 1:].copy()}
    ),
    r"'actor\.0\.weight' has the shape \(105, 64\), not \(64, 105\)": lambda tensors: (
        tensors.update({"actor.0.weight": tensors["actor.0.weight"].T.copy()})
    ),
    r"'mean' has the data type F64, not F32": lambda tensors: tensors.update(
        mean=tensors["mean"].astype(np.float64)
    ),
    r"'more' is not a tensor of this network": lambda tensors: tensors.update(
        more=np.zeros(1, dtype=np.float32)
    ),
}


@pytest.mark.parametrize("message", DAMAGES)
def test_weights_that_do_not_fit_are_refused(driver: Path, message: str) -> None:
    tensors = load_file(driver / WEIGHTS_FILE)
    DAMAGES[message](tensors)
    save_file(tensors, driver / WEIGHTS_FILE)
    with pytest.raises(PolicyError, match=message):
        load_policy(driver, small_vec())


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"hidden": (5, 7, 9)},
        {"shared": True},
        {"state_size": 11},
        {"residual": True, "shared": True},
    ],
)
@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_an_actor_critic_has_the_shapes_of_its_config(
    tmp_path: Path, kind: str, form: dict[str, Any]
) -> None:
    pytest.importorskip("torch")
    from cavmarl.learning.actor_critic import load_network

    if form.get("residual") and kind == "discrete":
        pytest.skip("choices cannot be corrected")
    folder = save_driver(tmp_path / "driver", small_vec(action__kind=kind), **form)
    network, config = load_network(folder)
    held = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert held == config.shapes
    assert load_driver_network(folder).config == config


def test_observations_of_another_size_are_refused(driver: Path) -> None:
    network: DriverNetwork = load_driver_network(driver)
    for shape in ((3, 104), (105,), (1, 3, 105)):
        with pytest.raises(PolicyError, match=r"this network needs \(N, 105\)"):
            network.best(np.zeros(shape, dtype=np.float32))
