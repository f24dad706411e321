"""Layers of driver networks, each evaluated for a tile of rows in a fixed order of operations.

A tile is a flat array (rows · width,). Every sum of a row runs in an order that depends on the
layer's width alone, and no result of a row depends on other rows. The compiler may not reorder
sums (no fastmath), nor fuse a multiplication with an addition.
"""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.networks.kernels.activations import ONE, ZERO, Float32s, sigmoid, tanh

PARTIAL_SUMS = 16  # number of partial sums, so that the processor adds several numbers at once
NORM_EPSILON = np.float32(1e-5)  # added to a variance, as torch's LayerNorm does


@kernel
def normalize(values: Float32s, mean: Float32s, deviation: Float32s) -> None:
    """Subtract `mean` (width,) from each row of `values` (rows · width,); divide by `deviation`."""
    width = mean.shape[0]
    for first in range(0, values.shape[0], width):
        row = values[first : first + width]
        for i in range(width):
            row[i] = (row[i] - mean[i]) / deviation[i]


@kernel
def linear(
    inputs: Float32s,  # (rows · width of a row,)
    weights: Float32s,  # (width of a row, outputs) flat
    bias: Float32s,  # (outputs,)
    outputs: Float32s,  # (rows · outputs,), overwritten
) -> None:
    """Compute bias + inputs @ weights; each sum begins with the bias and runs over the inputs.

    Eight inputs are added per pass: the processor then loads and stores an output once for eight
    sums. The loop over outputs is contiguous, so that SIMD needs no reordering.
    """
    size = bias.shape[0]
    num_rows = outputs.shape[0] // size
    width = inputs.shape[0] // num_rows
    for r in range(num_rows):
        sums = outputs[r * size : (r + 1) * size]
        for j in range(size):
            sums[j] = bias[j]
    first = 0
    while first + 8 <= width:
        _add_eight(inputs, first, width, weights[first * size : (first + 8) * size], outputs, size)
        first += 8
    for k in range(first, width):
        column = weights[k * size : (k + 1) * size]
        for r in range(num_rows):
            sums = outputs[r * size : (r + 1) * size]
            x = inputs[r * width + k]
            for j in range(size):
                sums[j] = sums[j] + x * column[j]


@kernel
def _add_eight(
    inputs: Float32s,  # (rows · width,)
    first: int,  # first of the eight inputs in each row
    width: int,
    weights: Float32s,  # (8 · size,) weights of the eight inputs
    outputs: Float32s,  # (rows · size,)
    size: int,
) -> None:
    """Add the products of eight inputs of each row with their weights to the outputs."""
    w0 = weights[:size]
    w1 = weights[size : 2 * size]
    w2 = weights[2 * size : 3 * size]
    w3 = weights[3 * size : 4 * size]
    w4 = weights[4 * size : 5 * size]
    w5 = weights[5 * size : 6 * size]
    w6 = weights[6 * size : 7 * size]
    w7 = weights[7 * size : 8 * size]
    for r in range(outputs.shape[0] // size):
        sums = outputs[r * size : (r + 1) * size]
        x = inputs[r * width + first : r * width + first + 8]
        x0, x1, x2, x3, x4, x5, x6, x7 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
        for j in range(size):
            half = (((sums[j] + x0 * w0[j]) + x1 * w1[j]) + x2 * w2[j]) + x3 * w3[j]
            sums[j] = (((half + x4 * w4[j]) + x5 * w5[j]) + x6 * w6[j]) + x7 * w7[j]


@kernel
def layer_norm(
    values: Float32s,  # (rows · width,), overwritten
    scale: Float32s,  # (width,)
    shift: Float32s,  # (width,)
    partial: Float32s,  # (PARTIAL_SUMS,), overwritten
) -> None:
    """Bring each row to mean 0 and variance 1, then scale and shift it (Ba et al. 2016)."""
    width = scale.shape[0]
    size = np.float32(width)
    for first in range(0, values.shape[0], width):
        row = values[first : first + width]
        mean = _sum(row, partial) / size
        for i in range(width):
            row[i] = row[i] - mean
        variance = _sum_of_squares(row, partial) / size
        factor = ONE / np.sqrt(variance + NORM_EPSILON)
        for i in range(width):
            row[i] = row[i] * factor * scale[i] + shift[i]


@kernel
def _sum(values: Float32s, partial: Float32s) -> np.float32:
    """Return the sum of `values`; element i is added to partial sum i modulo their number."""
    for lane in range(PARTIAL_SUMS):
        partial[lane] = ZERO
    whole = values.shape[0] // PARTIAL_SUMS * PARTIAL_SUMS
    for first in range(0, whole, PARTIAL_SUMS):
        block = values[first : first + PARTIAL_SUMS]
        for lane in range(PARTIAL_SUMS):
            partial[lane] = partial[lane] + block[lane]
    for i in range(whole, values.shape[0]):
        partial[i - whole] = partial[i - whole] + values[i]
    return _total(partial)


@kernel
def _sum_of_squares(values: Float32s, partial: Float32s) -> np.float32:
    """Return the sum of the squares of `values`, in the order of `_sum`."""
    for lane in range(PARTIAL_SUMS):
        partial[lane] = ZERO
    whole = values.shape[0] // PARTIAL_SUMS * PARTIAL_SUMS
    for first in range(0, whole, PARTIAL_SUMS):
        block = values[first : first + PARTIAL_SUMS]
        for lane in range(PARTIAL_SUMS):
            partial[lane] = partial[lane] + block[lane] * block[lane]
    for i in range(whole, values.shape[0]):
        partial[i - whole] = partial[i - whole] + values[i] * values[i]
    return _total(partial)


@kernel
def _total(partial: Float32s) -> np.float32:
    """Return the sum of the partial sums, in their order."""
    total = ZERO
    for lane in range(PARTIAL_SUMS):
        total = total + partial[lane]
    return total


@kernel
def gru_gates(
    from_input: Float32s,  # (rows · 3 · size,): reset, update and candidate for the input
    from_state: Float32s,  # (rows · 3 · size,): the same for the state
    states: Float32s,  # (rows · size,), overwritten by the next states
    size: int,  # units of a row
) -> None:
    """Compute the next states of gated recurrent units (Cho et al. 2014), as torch's GRUCell does.

    The gates are linear in the input and in the state; `linear` computes both parts.
    """
    for r in range(states.shape[0] // size):
        state = states[r * size : (r + 1) * size]
        inputs = from_input[3 * r * size : 3 * (r + 1) * size]
        recurrent = from_state[3 * r * size : 3 * (r + 1) * size]
        for j in range(size):
            reset = sigmoid(inputs[j] + recurrent[j])
            update = sigmoid(inputs[size + j] + recurrent[size + j])
            candidate = tanh(inputs[2 * size + j] + reset * recurrent[2 * size + j])
            state[j] = (ONE - update) * candidate + update * state[j]
