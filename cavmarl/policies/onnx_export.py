"""Export of trained drivers as ONNX models.

The model computes what `DriverNetwork` computes. Its sums have another order, so its results differ
in the last bits. Its metadata contain the driver's configuration, see `read_onnx_config`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from cavmarl.config.driver_names import ONNX_FILE, find_driver
from cavmarl.config.io import validate
from cavmarl.core.atomic_file import write_whole
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.networks.kernels.network_layers import NORM_EPSILON
from cavmarl.networks.network_files import (
    CONTINUOUS_ACTIONS,
    MAX_DEVIATIONS,
    RESIDUAL_PARTS,
    NetworkConfig,
    Weights,
    read_network,
)
from cavmarl.policies.onnx_format import OnnxGraph

OBSERVATIONS, ACTIONS, LOGITS = "observations", "actions", "logits"
CONFIG_FACT = "cavmarl.config"  # key of the metadata


def export_onnx(policy: str | Path, path: Path) -> NetworkConfig:
    """Write a trained driver as an ONNX model and return its configuration.

    The input `observations` is float32 (N, D). The output is `actions` (N, 2) within [-1, 1], or,
    for a driver with discrete actions, `logits` (N, choices). D includes the built-in driver's
    action if the driver corrects it.

    Raises:
        PolicyError: there is no such driver, it is not trained, or its files are broken.
        ConfigError: the file cannot be written, or its name does not end in `.onnx`.
    """
    if path.suffix != ONNX_FILE:
        raise ConfigError(f"{path}: the name of an ONNX model must end in {ONNX_FILE}")
    folder = find_driver(policy)
    if not folder.is_dir():
        raise PolicyError(
            f"{policy}: is a script or a model file; only trained drivers, which are folders with "
            "model.safetensors, can be exported"
        )
    weights, config = read_network(folder)
    content = onnx_model(weights, config, folder.name)
    try:
        write_whole(path, content)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written ({error.strerror or error}); give the path of a file in "
            "an existing folder that you can write"
        ) from error
    return config


def onnx_model(weights: Weights, config: NetworkConfig, name: str) -> bytes:
    """Return a driver's network as the bytes of an ONNX file."""
    graph = OnnxGraph(OBSERVATIONS, config.observation_size)
    graph.add("Sub", graph.constant("mean", weights["mean"]))
    graph.add("Div", graph.constant("deviation", weights["deviation"]))
    _clip(graph, "deviations", MAX_DEVIATIONS)
    if config.shared:
        for k in range(len(config.hidden)):
            _linear(graph, weights, f"body.{3 * k}")
            scale, shift = (f"body.{3 * k + 1}.{part}" for part in ("weight", "bias"))
            graph.add(
                "LayerNormalization",
                graph.constant(scale, weights[scale]),
                graph.constant(shift, weights[shift]),
                axis=1,
                epsilon=float(NORM_EPSILON),
            )
            graph.add("Relu")
        _linear(graph, weights, "actor")
    else:
        for k in range(len(config.hidden)):
            _linear(graph, weights, f"actor.{2 * k}")
            graph.add("Tanh")
        _linear(graph, weights, f"actor.{2 * len(config.hidden)}")
    if config.residual:
        _add_proposed(graph, config)
    is_continuous = config.action.kind == "continuous"
    if is_continuous:
        _clip(graph, "actions", 1.0)
    facts = {CONFIG_FACT: json.dumps(asdict(config), sort_keys=True)}
    return graph.model(ACTIONS if is_continuous else LOGITS, config.num_outputs, name, facts)


def read_onnx_config(facts: Mapping[str, str], path: Path) -> NetworkConfig | None:
    """Return the configuration in the metadata of a model; None: another program wrote it.

    Raises PolicyError: this version cannot read the configuration.
    """
    if CONFIG_FACT not in facts:
        return None
    try:
        return validate(NetworkConfig, json.loads(facts[CONFIG_FACT]), str(path))
    except (ValueError, RecursionError, ConfigError) as error:
        raise PolicyError(
            f"{path}: its metadata '{CONFIG_FACT}' cannot be read by this version ({error}); "
            "export the driver again: cavmarl zoo export DRIVER --onnx FILE"
        ) from error


def _linear(graph: OnnxGraph, weights: Weights, name: str) -> None:
    factors, bias = (f"{name}.{part}" for part in ("weight", "bias"))
    graph.add(
        "Gemm",
        graph.constant(factors, weights[factors]),
        graph.constant(bias, weights[bias]),
        transB=1,  # as in torch, the weights are (outputs, inputs)
    )


def _clip(graph: OnnxGraph, name: str, limit: float) -> None:
    ends = [
        graph.constant(f"{end}_{name}", np.array(value, dtype=np.float32))
        for end, value in (("least", -limit), ("greatest", limit))
    ]
    graph.add("Clip", *ends)


def _add_proposed(graph: OnnxGraph, config: NetworkConfig) -> None:
    """Scale the result, and add the built-in driver's action, the last part of the observation."""
    parts = np.array(RESIDUAL_PARTS, dtype=np.float32)
    correction = graph.add("Mul", graph.constant("residual_parts", parts))
    size = config.observation_size
    first, last, axis = (
        graph.constant(name, np.array([value], dtype=np.int64))
        for name, value in (
            ("first", size - CONTINUOUS_ACTIONS),
            ("last", size),
            ("axis", 1),
        )
    )
    graph.add("Slice", first, last, axis, of=OBSERVATIONS)
    graph.add("Add", correction)
