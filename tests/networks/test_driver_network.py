"""Networks of trained drivers: batches, threads, and comparison with torch."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import agent_entries
from cavmarl.networks.driver_network import load_driver_network
from cavmarl.networks.network_files import read_network
from tests.support.saved_drivers import save_driver, small_vec

DRIVERS = {name: path for name, path in sorted(agent_entries().items()) if path.is_dir()}
ROWS = 40
ERROR = 2e-6  # largest difference of outputs to those of torch

every_driver = pytest.mark.parametrize("name", DRIVERS)


def likely_observations(folder: Path, num_rows: int, seed: int = 0) -> NDArray[np.float32]:
    """Draw observations with the mean of a driver's training and twice its deviation."""
    weights, config = read_network(folder)
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 2.0, (num_rows, config.observation_size))
    return (weights["mean"] + noise * weights["deviation"]).astype(np.float32)


@every_driver
def test_the_action_for_a_row_does_not_depend_on_the_batch(name: str) -> None:
    network = load_driver_network(DRIVERS[name])
    rows = likely_observations(DRIVERS[name], ROWS)
    alone = np.concatenate([network.best(rows[k : k + 1]) for k in range(ROWS)])
    assert (np.abs(alone) < 1.0).any()
    for n in range(1, ROWS + 1):
        assert network.best(rows[:n]).tobytes() == alone[:n].tobytes()
        assert network.best(rows[-n:]).tobytes() == alone[-n:].tobytes()


def test_threads_can_share_a_network() -> None:
    network = load_driver_network(DRIVERS["cities_ippo"])
    parts = np.array_split(likely_observations(DRIVERS["cities_ippo"], 4000), 40)
    expected = [network.best(part).tobytes() for part in parts]
    with ThreadPoolExecutor(4) as pool:
        found = [best.tobytes() for best in pool.map(network.best, parts)]
    assert found == expected


@every_driver
def test_outputs_are_close_to_those_of_torch(name: str) -> None:
    torch: Any = pytest.importorskip("torch")
    from cavmarl.learning.actor_critic import load_network

    learned, _ = load_network(DRIVERS[name])
    rows = likely_observations(DRIVERS[name], 400)
    network = load_driver_network(DRIVERS[name])
    with torch.inference_mode():
        known = torch.from_numpy(rows)
        outputs, best = learned(known).numpy(), learned.best(known).numpy()
    np.testing.assert_allclose(network.outputs(rows), outputs, rtol=0.0, atol=ERROR)
    np.testing.assert_allclose(network.best(rows), best, rtol=0.0, atol=ERROR)


def test_discrete_actions_equal_those_of_torch(tmp_path: Path) -> None:
    torch: Any = pytest.importorskip("torch")
    from cavmarl.learning.actor_critic import load_network

    folder = save_driver(tmp_path / "driver", small_vec(action__kind="discrete"), shared=True)
    rows = likely_observations(folder, 300)
    with torch.inference_mode():
        expected = load_network(folder)[0].best(torch.from_numpy(rows)).numpy()
    found = load_driver_network(folder).best(rows)
    assert found.dtype == expected.dtype
    assert len(set(found)) > 1
    np.testing.assert_array_equal(found, expected)
    assert load_driver_network(folder).best(rows[:0]).shape == (0,)


def test_an_empty_batch_has_no_actions() -> None:
    network = load_driver_network(DRIVERS["merge_ippo"])
    assert network.best(np.empty((0, 105), dtype=np.float32)).shape == (0, 2)
