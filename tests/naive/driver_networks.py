"""Layers of driver networks in plain NumPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.networks.network_files import NetworkConfig

Floats = NDArray[Any]


def linear(inputs: Floats, weights: Floats, bias: Floats) -> Floats:
    """Add the products of the inputs (N, K) and weights (M, K) to the bias, input by input."""
    sums = np.repeat(bias[None, :], len(inputs), axis=0)
    for k in range(inputs.shape[1]):
        sums = sums + inputs[:, k, None] * weights[None, :, k]
    return sums


def layer_norm(inputs: Floats, scale: Floats, shift: Floats) -> Floats:
    """Normalize each row (N, K); each sum is made of 16 partial sums that are added in order."""

    def mean(values: Floats) -> Floats:
        partial = np.zeros((len(values), 16), dtype=values.dtype)
        for i in range(values.shape[1]):
            partial[:, i % 16] += values[:, i]
        total = np.zeros(len(values), dtype=values.dtype)
        for lane in range(16):
            total += partial[:, lane]
        return (total / values.dtype.type(values.shape[1]))[:, None]

    centred = inputs - mean(inputs)
    variance = mean(centred * centred)
    factor = inputs.dtype.type(1.0) / np.sqrt(variance + inputs.dtype.type(1e-5))
    return centred * factor * scale + shift


def relu(values: Floats) -> Floats:
    return np.maximum(values, 0.0)


def exact_outputs(
    weights: Mapping[str, NDArray[np.float32]], config: NetworkConfig, observations: Floats
) -> Floats:
    """Compute `DriverNetwork.outputs` in float64 with functions of NumPy."""
    w = {name: tensor.astype(np.float64) for name, tensor in weights.items()}
    values = (observations.astype(np.float64) - w["mean"]) / w["deviation"]
    values = values.clip(-5.0, 5.0)
    body, step = ("body", 3) if config.shared else ("actor", 2)
    function: Callable[[Floats], Floats] = relu if config.shared else np.tanh
    for k in range(len(config.hidden)):
        name = f"{body}.{step * k}"
        values = linear(values, w[f"{name}.weight"], w[f"{name}.bias"])
        if config.shared:
            norm = f"{body}.{step * k + 1}"
            values = layer_norm(values, w[f"{norm}.weight"], w[f"{norm}.bias"])
        values = function(values)
    last = "actor" if config.shared else f"actor.{step * len(config.hidden)}"
    return linear(values, w[f"{last}.weight"], w[f"{last}.bias"])


def exact_actions(outputs: Floats, config: NetworkConfig, observations: Floats) -> Floats:
    """Compute continuous actions from the actor's outputs."""
    if config.residual:
        outputs = outputs * np.array([1.0, 0.1]) + observations[:, -2:]
    return outputs.clip(-1.0, 1.0)
