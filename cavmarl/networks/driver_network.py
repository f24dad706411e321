"""`DriverNetwork`: the network of a trained driver, evaluated by a kernel, without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import PolicyError
from cavmarl.networks.kernels.inference import (
    CLAMP,
    GRU,
    LAYER_NORM,
    LINEAR,
    NORMALIZE,
    NUM_BUFFERS,
    RELU,
    RESIDUAL,
    TANH,
    TILE_ROWS,
    choose_largest,
    evaluate_network,
)
from cavmarl.networks.kernels.network_layers import PARTIAL_SUMS
from cavmarl.networks.network_files import (
    MAX_DEVIATIONS,
    RESIDUAL_PARTS,
    NetworkConfig,
    Weights,
    read_network,
)

LINE_FLOATS = 16  # float32 numbers in a cache line


class LayerTable:
    """The layers and the weights of a network, in the form that `evaluate_network` reads.

    The weights of each layer start at the beginning of a cache line.

    Attributes:
        width: number of outputs of the last layer.
    """

    def __init__(self, num_inputs: int) -> None:
        self.width = num_inputs
        self._rows: list[tuple[int, int, int, int]] = []
        self._weights: list[NDArray[np.float32]] = []
        self._num_weights = 0
        self._widest = max(num_inputs, PARTIAL_SUMS)

    def add(self, kind: int, *weights: Any, width: int = 0) -> None:
        """Add a layer.

        Args:
            kind: a constant of `kernels.inference`.
            weights: arrays in the order that the kind asks for.
            width: number of outputs of the layer; 0: as many as inputs.
        """
        inputs, self.width = self.width, width or self.width
        self._append(np.zeros(-self._num_weights % LINE_FLOATS, dtype=np.float32))
        self._rows.append((kind, inputs, self.width, self._num_weights))
        for array in weights:
            self._append(np.asarray(array, dtype=np.float32).ravel())
        gates = 3 if kind == GRU else 1
        self._widest = max(self._widest, gates * self.width)

    def _append(self, weights: NDArray[np.float32]) -> None:
        self._weights.append(weights)
        self._num_weights += weights.size

    def layers(self) -> NDArray[np.int64]:
        """Return the table (L, 4) of the layers so far."""
        return np.array(self._rows, dtype=np.int64)

    def weights(self) -> NDArray[np.float32]:
        """Return all weights, flat."""
        flat = _aligned(self._num_weights)
        return np.concatenate(self._weights, out=flat)

    def new_buffers(self) -> NDArray[np.float32]:
        """Return the buffers for `evaluate_network`."""
        return _aligned(NUM_BUFFERS * TILE_ROWS * self._widest)


def _aligned(size: int) -> NDArray[np.float32]:
    """Return an array aligned to a cache line, so that no SIMD load crosses two lines.

    The alignment makes the evaluation about a seventh faster, and changes no result.
    """
    array = np.empty(size + LINE_FLOATS, dtype=np.float32)
    first = -array.ctypes.data // array.itemsize % LINE_FLOATS
    return array[first : first + size]


class DriverNetwork:
    """The actor of an `ActorCritic`, in float32 with a fixed order of operations.

    The result of an observation is the same on every processor. It depends neither on the other
    observations of a call, nor on workers, zones or threads.

    Args:
        weights: as `read_network` returns them.
        config: the configuration of the network.

    Attributes:
        best_layers: the layers (L, 4) that end in the most likely action, for `evaluate_network`.
        weights: the weights of all layers, flat.
        new_buffers: returns buffers for `evaluate_network`.
    """

    def __init__(self, weights: Weights, config: NetworkConfig) -> None:
        self.config = config
        table = LayerTable(config.observation_size)
        table.add(NORMALIZE, weights["mean"], weights["deviation"])
        table.add(CLAMP, MAX_DEVIATIONS)
        add = _add_body if config.shared else _add_perceptron
        add(table, weights, config)
        self._layers = table.layers()  # excludes the conversion of outputs to actions
        if config.residual:
            table.add(RESIDUAL, RESIDUAL_PARTS)
        if config.action.kind == "continuous":
            table.add(CLAMP, 1.0)
        self.best_layers = table.layers()
        self.weights = table.weights()
        self.new_buffers = table.new_buffers
        self._no_states = np.empty(0, dtype=np.float32)
        self._evaluate = specialized(evaluate_network)
        self._choose = specialized(choose_largest)

    def outputs(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actor's outputs: means (N, 2) of actions, or logits (N, choices).

        Args:
            observations: (N, D).

        Raises:
            PolicyError: D is not the network's number of inputs.
        """
        return self._run(self._layers, observations)

    def best(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return the most likely actions: (N, 2) float32 in [-1, 1], or (N,) int64 choices.

        For arguments and errors, see `outputs`.
        """
        found = self._run(self.best_layers, observations)
        if self.config.action.kind == "continuous":
            return found
        choices = np.empty(len(found), dtype=np.int64)
        self._choose(found.reshape(-1), choices)
        return choices

    def _run(
        self, layers: NDArray[np.int64], observations: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        size = self.config.observation_size
        if observations.ndim != 2 or observations.shape[1] != size:
            raise PolicyError(
                f"observations of shape {observations.shape}: this network needs (N, {size})"
            )
        given = np.require(observations, np.float32, ["C", "W"]).reshape(-1)
        outputs = np.empty((len(observations), self.config.num_outputs), dtype=np.float32)
        # Each call has its own buffers, since several threads may evaluate one network.
        buffers = self.new_buffers()
        flat = outputs.reshape(-1)
        self._evaluate(layers, self.weights, given, self._no_states, buffers, flat)
        return outputs


def load_driver_network(folder: Path) -> DriverNetwork:
    """Read the network of a trained driver; raises as `read_network`."""
    return DriverNetwork(*read_network(folder))


def _add_body(table: LayerTable, weights: Weights, config: NetworkConfig) -> None:
    """Add linear layers with LayerNorm and ReLU, and the actor's head."""
    for k, width in enumerate(config.hidden):
        _add_linear(table, weights, f"body.{3 * k}", width)
        norm = f"body.{3 * k + 1}"
        table.add(LAYER_NORM, weights[f"{norm}.weight"], weights[f"{norm}.bias"])
        table.add(RELU)
    _add_linear(table, weights, "actor", config.num_outputs)


def _add_perceptron(table: LayerTable, weights: Weights, config: NetworkConfig) -> None:
    """Add the actor's linear layers, with tanh between them."""
    for k, width in enumerate(config.hidden):
        _add_linear(table, weights, f"actor.{2 * k}", width)
        table.add(TANH)
    _add_linear(table, weights, f"actor.{2 * len(config.hidden)}", config.num_outputs)


def _add_linear(table: LayerTable, weights: Weights, name: str, width: int) -> None:
    """Add a linear layer; the kernel's weights are torch's (outputs, inputs), transposed."""
    table.add(LINEAR, weights[f"{name}.weight"].T, weights[f"{name}.bias"], width=width)
