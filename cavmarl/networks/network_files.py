"""The files of a trained driver: the configuration of its network, and the weights.

The folder of a driver holds `model.safetensors` (weights, no code) and `config.json` (a
`NetworkConfig`). The configuration contains the observations and actions of the training, so that
an environment that does not fit is refused.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from cavmarl.config.action import ActionConfig
from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.io import validate
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.roads.road_kinds import RoadKind

CONTINUOUS_ACTIONS = 2
# Factors of a residual driver's throttle and steering. That of steering is small, so that the
# vehicle stays in the built-in driver's lane.
RESIDUAL_PARTS = (1.0, 0.1)
MAX_LAYERS = 8
MAX_WIDTH = 4096
MAX_OBSERVATION_SIZE = 65_536
MAX_STATE_SIZE = 1_048_576
MAX_DEVIATIONS = 5.0  # observations further from the mean are clipped

Weights = Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True)
class NetworkConfig:
    """The configuration of a trained driver's network.

    Attributes:
        environment: name of the environment of the training.
        observation_size: numbers in one flat observation.
        sensors: the sensors of the observation.
        action: the kind of actions.
        hidden: widths of the hidden layers of actor and critic.
        seed: seed of the training.
        agent_steps: number of decisions used for learning.
        state_size: length of the world's state, which the critic gets in addition to the
            observation, and the actor does not.
        shared: one body with LayerNorm and ReLU for actor and critic; else each is a tanh network.
        residual: the output, scaled by `RESIDUAL_PARTS`, is added to the built-in driver's action,
            which is observed last (residual learning: Silver et al. 2018, Johannink et al. 2019).
        maps: kinds of the maps of the training, see `road_kinds`. Drivers without this key were
            trained on right-hand maps without stop signs.
    """

    environment: str
    observation_size: int
    sensors: SensorsConfig
    action: ActionConfig
    hidden: tuple[int, ...] = (128, 128)
    seed: int = 0
    agent_steps: int = 0
    state_size: int = 0
    shared: bool = False
    residual: bool = False
    maps: tuple[RoadKind, ...] = ("right_hand",)

    def __post_init__(self) -> None:
        if not 1 <= self.observation_size <= MAX_OBSERVATION_SIZE:
            raise ConfigError(
                f"observation_size = {self.observation_size}: must be from 1 to "
                f"{MAX_OBSERVATION_SIZE}"
            )
        if not {"right_hand", "left_hand"} & set(self.maps):
            raise ConfigError(f"maps = {list(self.maps)}: must contain right_hand or left_hand")
        if self.residual and self.action.kind != "continuous":
            raise ConfigError(
                f"residual with action.kind = {self.action.kind}: choices cannot be added to the "
                "action of the built-in driver; use action.kind = continuous"
            )
        if self.shared and self.state_size:
            raise ConfigError("shared: not possible with state_size; set one of them")
        if not 0 <= self.state_size <= MAX_STATE_SIZE:
            raise ConfigError(f"state_size = {self.state_size}: must be from 0 to {MAX_STATE_SIZE}")
        if not 1 <= len(self.hidden) <= MAX_LAYERS or not all(
            1 <= width <= MAX_WIDTH for width in self.hidden
        ):
            raise ConfigError(
                f"hidden = {list(self.hidden)}: must be 1 to {MAX_LAYERS} widths from 1 to "
                f"{MAX_WIDTH}"
            )

    @property
    def sensed(self) -> int:
        """Number of observed elements from sensors; the others are the built-in driver's action."""
        return self.observation_size - (CONTINUOUS_ACTIONS if self.residual else 0)

    @property
    def num_outputs(self) -> int:
        """Number of outputs of the actor: one for each action or choice."""
        return self.action.choices or CONTINUOUS_ACTIONS

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The tensors of an `ActorCritic` by name, with their shapes."""
        size, last = self.observation_size, self.hidden[-1]
        shapes: dict[str, tuple[int, ...]] = {"mean": (size,), "deviation": (size,)}
        if self.action.kind == "continuous":
            shapes["log_std"] = (CONTINUOUS_ACTIONS,)
        if self.shared:
            for k, widths in enumerate(pairwise((size, *self.hidden))):
                shapes |= _linear_shapes(f"body.{3 * k}", *widths)
                norm = f"body.{3 * k + 1}"
                shapes |= {f"{norm}.weight": widths[1:], f"{norm}.bias": widths[1:]}
            return (
                shapes
                | _linear_shapes("actor", last, self.num_outputs)
                | _linear_shapes("critic", last, 1)
            )
        seen = {"actor": (size, self.num_outputs), "critic": (size + self.state_size, 1)}
        for head, (inputs, outputs) in seen.items():
            for k, widths in enumerate(pairwise((inputs, *self.hidden, outputs))):
                shapes |= _linear_shapes(f"{head}.{2 * k}", *widths)
        return shapes


def _linear_shapes(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def read_network(folder: Path) -> tuple[Weights, NetworkConfig]:
    """Read the weights and the configuration of a trained driver.

    Raises:
        PolicyError: a file is missing or broken, the weights do not fit the configuration, or a
            weight is not finite.
    """
    for name in (WEIGHTS_FILE, CONFIG_FILE):
        if not (folder / name).is_file():
            raise PolicyError(f"no {name} in {folder}; give the folder of a trained driver")
    config = _read_config(folder / CONFIG_FILE)
    path = folder / WEIGHTS_FILE
    weights = _read_weights(path, config)
    for name, tensor in weights.items():
        if not np.isfinite(tensor).all():
            raise PolicyError(f"{path}: '{name}' holds numbers that are not finite")
    if not (weights["deviation"] > 0.0).all():
        raise PolicyError(f"{path}: 'deviation' holds numbers that are not greater than 0")
    return weights, config


def read_network_config(folder: Path) -> NetworkConfig:
    """Read the configuration of a trained driver's network, without its weights.

    Raises:
        PolicyError: the file is missing or broken.
    """
    return _read_config(folder / CONFIG_FILE)


def _read_weights(path: Path, config: NetworkConfig) -> dict[str, NDArray[np.float32]]:
    """Read all tensors; the header is checked against the configuration before loading."""
    try:
        with safe_open(path, framework="numpy") as file:
            names = list(file.keys())
            slices = {name: file.get_slice(name) for name in names}
            held = {name: (one.get_dtype(), tuple(one.get_shape())) for name, one in slices.items()}
            if unlike := next(_misfits(held, config), None):
                raise PolicyError(f"{path}: does not fit {CONFIG_FILE}: {unlike}")
            return {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error


def _misfits(
    held: Mapping[str, tuple[str, tuple[int, ...]]], config: NetworkConfig
) -> Iterator[str]:
    """Yield how a file's tensors, each a data type and a shape, differ from `config`."""
    shapes = config.shapes
    for name, shape in shapes.items():
        if name not in held:
            yield f"'{name}' is missing"
        elif held[name][1] != shape:
            yield f"'{name}' has the shape {held[name][1]}, not {shape}"
        elif held[name][0] != "F32":
            yield f"'{name}' has the data type {held[name][0]}, not F32"
    for name in held:
        if name not in shapes:
            yield f"'{name}' is not a tensor of this network"


def _read_config(path: Path) -> NetworkConfig:
    try:
        raw: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # JSON also raises errors of other types
        raise _unreadable(path, error) from error
    try:
        return validate(NetworkConfig, raw, str(path))
    except ConfigError as error:
        raise PolicyError(str(error)) from error


def _unreadable(path: Path, error: Exception) -> PolicyError:
    reason = error.strerror if isinstance(error, OSError) else None  # str(error) repeats the path
    return PolicyError(f"{path}: cannot be read ({reason or error})")
