"""Layers of driver networks, compared with tests/naive (twins), torch and recorded bytes."""

from __future__ import annotations

from hashlib import sha256
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import agent_entries
from cavmarl.networks.driver_network import DriverNetwork, LayerTable
from cavmarl.networks.kernels.inference import (
    CLAMP,
    GRU,
    LAYER_NORM,
    LINEAR,
    NORMALIZE,
    RELU,
    RESIDUAL,
    TANH,
    TILE_ROWS,
    choose_largest,
    evaluate_network,
)
from cavmarl.networks.network_files import read_network
from tests.naive.driver_networks import exact_actions, exact_outputs, layer_norm, linear

Floats = NDArray[np.float32]

ERROR = 2e-6  # largest difference to torch and to float64
# Recorded hash of `run_all_kinds`. All of its numbers are exact in float32, so the bytes are equal
# on every processor, and without the compiler.
DIGEST = "1aa005700f35a94ad5d33de69c7121b7"


def draw(seed: int, *shape: int) -> Floats:
    """Draw multiples of 1/64 in [-1, 1], which float32 represents exactly."""
    drawn = np.random.default_rng(seed).integers(-64, 65, shape)
    return (drawn / 64.0).astype(np.float32)


def run(table: LayerTable, rows: Floats, states: Floats | None = None) -> Floats:
    """Evaluate a network; write the new states of its GRU into `states`."""
    outputs = np.empty((len(rows), table.width), dtype=np.float32)
    none = np.empty(0, dtype=np.float32)
    buffers = table.new_buffers()
    buffers.fill(np.nan)
    evaluate_network(
        table.layers(),
        table.weights(),
        rows.reshape(-1),
        none if states is None else states.reshape(-1),
        buffers,
        outputs.reshape(-1),
    )
    return outputs


def run_all_kinds() -> str:
    """Evaluate a network with all kinds of layers twice; return a hash of outputs and states."""
    table = LayerTable(19)
    table.add(NORMALIZE, draw(1, 19), np.abs(draw(2, 19)) + 0.5)
    table.add(CLAMP, 1.25)
    table.add(LINEAR, draw(3, 19, 21), draw(4, 21), width=21)
    table.add(LAYER_NORM, draw(5, 21), draw(6, 21))
    table.add(RELU)
    table.add(GRU, draw(7, 21, 15), draw(8, 15), draw(9, 5, 15), draw(10, 15), width=5)
    table.add(TANH)
    table.add(LINEAR, draw(11, 5, 2), draw(12, 2), width=2)
    table.add(RESIDUAL, draw(13, 2))
    states = draw(14, 11, 5)
    found = [run(table, draw(15 + step, 11, 19), states) for step in range(2)]
    assert all(np.isfinite(array).all() for array in (*found, states))
    return sha256(b"".join(array.tobytes() for array in (*found, states))).hexdigest()[:32]


def test_the_results_of_all_layers_have_the_recorded_hash() -> None:
    assert run_all_kinds() == DIGEST


@pytest.mark.parametrize("width", [1, 2, 7, 8, 9, 16, 31])
def test_linear_layers_equal_their_twin(width: int) -> None:
    weights, bias, rows = draw(1, 6, width), draw(2, 6), draw(3, 11, width)
    weights *= np.float32(1.1)
    table = LayerTable(width)
    table.add(LINEAR, weights.T, bias, width=6)
    np.testing.assert_array_equal(run(table, rows), linear(rows, weights, bias))


@pytest.mark.parametrize("width", [1, 3, 16, 17, 40])
def test_layer_norm_equals_its_twin(width: int) -> None:
    scale, shift, rows = draw(1, width), draw(2, width), draw(3, 11, width)
    rows *= np.float32(1.1)
    table = LayerTable(width)
    table.add(LAYER_NORM, scale, shift)
    np.testing.assert_array_equal(run(table, rows), layer_norm(rows, scale, shift))


@pytest.mark.parametrize("name", ["merge_ippo", "cities_residual"])
def test_outputs_are_close_to_those_of_the_slow_twin(name: str) -> None:
    weights, config = read_network(agent_entries()[name])
    noise = 2.0 * draw(1, 2, config.observation_size)
    rows = weights["mean"] + noise * weights["deviation"]
    network = DriverNetwork(weights, config)
    exact = exact_outputs(weights, config, rows)
    np.testing.assert_allclose(network.outputs(rows), exact, rtol=0.0, atol=ERROR)
    best = exact_actions(exact, config, rows)
    np.testing.assert_allclose(network.best(rows), best, rtol=0.0, atol=ERROR)


def test_results_of_a_row_do_not_depend_on_the_batch() -> None:
    table = LayerTable(9)
    table.add(LINEAR, draw(1, 9, 12), draw(2, 12), width=12)
    table.add(GRU, draw(3, 12, 9), draw(4, 9), draw(5, 3, 9), draw(6, 9), width=3)
    rows, states = draw(7, 2 * TILE_ROWS + 3, 9), draw(8, 2 * TILE_ROWS + 3, 3)
    before = states.copy()
    together = run(table, rows, states)
    for k in range(len(rows)):
        own = before[k : k + 1].copy()
        assert run(table, rows[k : k + 1], own).tobytes() == together[k].tobytes()
        assert own.tobytes() == states[k].tobytes()


def test_a_gru_is_close_to_that_of_torch() -> None:
    torch: Any = pytest.importorskip("torch")
    torch.manual_seed(0)
    cell = torch.nn.GRUCell(20, 24)
    w = {name: tensor.detach().numpy() for name, tensor in cell.named_parameters()}
    table = LayerTable(20)
    weights = (w["weight_ih"].T, w["bias_ih"], w["weight_hh"].T, w["bias_hh"])
    table.add(GRU, *weights, width=24)
    states = np.zeros((13, 24), dtype=np.float32)
    expected = torch.zeros(13, 24)
    for step in range(20):
        rows = 3.0 * draw(step, 13, 20)
        outputs = run(table, rows, states)
        with torch.inference_mode():
            expected = cell(torch.from_numpy(rows), expected)
        np.testing.assert_allclose(states, expected.numpy(), rtol=0.0, atol=ERROR)
        np.testing.assert_array_equal(outputs, states)


def test_layer_norm_and_relu_are_close_to_those_of_torch() -> None:
    torch: Any = pytest.importorskip("torch")
    rows, scale, shift = draw(1, 30, 128), draw(2, 128), draw(3, 128)
    table = LayerTable(128)
    table.add(LAYER_NORM, scale, shift)
    table.add(RELU)
    known = [torch.from_numpy(array) for array in (rows, scale, shift)]
    expected = torch.nn.functional.layer_norm(known[0], (128,), *known[1:]).relu()
    np.testing.assert_allclose(run(table, rows), expected.numpy(), rtol=0.0, atol=ERROR)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_choice_of_the_largest_number_equals_numpys_argmax(size: int) -> None:
    rows = draw(1, 400, size).round(1)
    rows[::7, size - 1] = np.nan
    rows[::14, 0] = np.nan
    choices = np.empty(len(rows), dtype=np.int64)
    choose_largest(rows.reshape(-1), choices)
    np.testing.assert_array_equal(choices, rows.argmax(axis=1))
