"""Evaluation of a whole driver network in one call.

A network is a table of layers, int64 (L, 4), and one flat array of all weights. A row of the table
holds the kind of the layer, the widths of its input and its output, and the index of its first
weight. The weights of each kind of layer are:

| kind | weights | effect on a row |
|---|---|---|
| `NORMALIZE` | means, deviations | subtract the mean, divide by the deviation |
| `CLAMP` | one limit | restrict each number to [-limit, limit] |
| `LINEAR` | weights (inputs, outputs), biases | bias + row @ weights |
| `TANH`, `RELU` | none | apply the function to each number |
| `LAYER_NORM` | scales, shifts | mean 0 and variance 1, then scale and shift |
| `GRU` | `LINEAR` of the input, `LINEAR` of the state, with 3 · outputs each | the next state |
| `RESIDUAL` | one factor per output | multiply, then add the last numbers of the observation |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.networks.kernels.activations import Float32s, apply_clamp, apply_relu, apply_tanh
from cavmarl.networks.kernels.network_layers import gru_gates, layer_norm, linear, normalize

NORMALIZE = 0
CLAMP = 1
LINEAR = 2
TANH = 3
RELU = 4
LAYER_NORM = 5
GRU = 6
RESIDUAL = 7

TILE_ROWS = 8  # rows that are evaluated together, so that each weight is read once for all of them
NUM_BUFFERS = 3  # for the input and the output of a layer, and for partial sums


@kernel
def evaluate_network(
    layers: NDArray[np.int64],  # (L, 4): see above
    weights: Float32s,  # all weights, flat
    observations: Float32s,  # (rows · inputs,)
    states: Float32s,  # (rows · units,) of the network's GRU, overwritten; empty without a GRU
    buffers: Float32s,  # (NUM_BUFFERS · TILE_ROWS · width of the widest layer,), overwritten
    outputs: Float32s,  # (rows · outputs,), overwritten
) -> None:
    """Evaluate a network for rows of observations.

    The result of a row does not depend on the other rows. In the size of `buffers`, the width of
    a GRU layer is three times its units, and the widest layer counts as at least PARTIAL_SUMS wide.
    """
    num_inputs = layers[0, 1]
    num_outputs = layers[layers.shape[0] - 1, 2]
    num_rows = outputs.shape[0] // num_outputs
    num_units = states.shape[0] // max(num_rows, 1)
    for first in range(0, num_rows, TILE_ROWS):
        last = min(first + TILE_ROWS, num_rows)
        _evaluate_tile(
            layers,
            weights,
            observations[first * num_inputs : last * num_inputs],
            states[first * num_units : last * num_units],
            buffers,
            outputs[first * num_outputs : last * num_outputs],
        )


@kernel
def _evaluate_tile(
    layers: NDArray[np.int64],
    weights: Float32s,
    observations: Float32s,
    states: Float32s,
    buffers: Float32s,
    outputs: Float32s,
) -> None:
    """Evaluate a network for up to TILE_ROWS rows."""
    num_rows = observations.shape[0] // layers[0, 1]
    size = buffers.shape[0] // NUM_BUFFERS
    front, back, third = buffers[:size], buffers[size : 2 * size], buffers[2 * size :]
    _copy(observations, front)
    for k in range(layers.shape[0]):
        kind, num_in, num_out = layers[k, 0], layers[k, 1], layers[k, 2]
        own = weights[layers[k, 3] :]
        values = front[: num_rows * num_in]
        if kind == LINEAR:
            _linear(own, values, num_in, num_out, back[: num_rows * num_out])
            front, back = back, front
        elif kind == GRU:
            gates = 3 * num_out
            from_input, from_state = back[: num_rows * gates], third[: num_rows * gates]
            _linear(own, values, num_in, gates, from_input)
            _linear(own[(num_in + 1) * gates :], states, num_out, gates, from_state)
            gru_gates(from_input, from_state, states, num_out)
            _copy(states, front)
        elif kind == LAYER_NORM:
            layer_norm(values, own[:num_in], own[num_in : 2 * num_in], third)
        elif kind == NORMALIZE:
            normalize(values, own[:num_in], own[num_in : 2 * num_in])
        elif kind == RESIDUAL:
            _add_observed(own[:num_in], observations, values)
        elif kind == TANH:
            apply_tanh(values)
        elif kind == RELU:
            apply_relu(values)
        else:
            apply_clamp(values, own[0])
    _copy(front[: outputs.shape[0]], outputs)


@kernel
def _copy(source: Float32s, target: Float32s) -> None:
    """Copy `source` (n,) to the first n items of `target`."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@kernel
def _linear(own: Float32s, inputs: Float32s, num_in: int, num_out: int, outputs: Float32s) -> None:
    """Call `linear` with weights and biases that are stored one after the other."""
    num_weights = num_in * num_out
    linear(inputs, own[:num_weights], own[num_weights : num_weights + num_out], outputs)


@kernel
def _add_observed(factors: Float32s, observations: Float32s, values: Float32s) -> None:
    """Multiply each row of `values` by `factors`; add the last numbers of its observation."""
    size = factors.shape[0]
    num_rows = values.shape[0] // size
    width = observations.shape[0] // num_rows
    for r in range(num_rows):
        observed = observations[(r + 1) * width - size : (r + 1) * width]
        row = values[r * size : (r + 1) * size]
        for j in range(size):
            row[j] = row[j] * factors[j] + observed[j]


@kernel
def choose_largest(outputs: Float32s, choices: NDArray[np.int64]) -> None:
    """Set `choices` (rows,) to the index of each row's largest number, the first one on a tie.

    A NaN counts as the largest number, as in NumPy and torch.
    """
    size = outputs.shape[0] // choices.shape[0]
    for r in range(choices.shape[0]):
        row = outputs[r * size : (r + 1) * size]
        best = 0
        for j in range(1, size):
            if row[best] == row[best] and not row[j] <= row[best]:
                best = j
        choices[r] = best
