"""Drivers in model files of other libraries: stable-baselines3, TorchScript and ONNX.

`make_policy` reads all of them. A format is a suffix in `config/driver_names.py` and a
reader in `_READERS`, which returns a `Model`, and the driver's configuration if the file states it.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from zipfile import BadZipFile

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.config.driver_names import ONNX_FILE, SB3_FILE, TORCH_SCRIPT_FILES
from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import PolicyError, require, require_all
from cavmarl.engine.spaces import (
    action_space,
    flat_observation_space,
    named_observation,
    observation_parts,
    observation_space,
)
from cavmarl.policies.driver_fit import check_fit
from cavmarl.policies.map_check import meet_map
from cavmarl.policies.other_side import OtherSide
from cavmarl.policies.policy import Environment, Policy, built_in_actions

if TYPE_CHECKING:
    from cavmarl.networks.network_files import NetworkConfig

Model = Callable[[NDArray[np.float32]], Any]
"""Maps flat observations (N, D) to actions (N, 2), choices (N,), or logits (N, choices)."""
_Read = tuple[Model, "NetworkConfig | None"]  # None: the file does not state the configuration


class ModelPolicy(Policy):
    """Drives with a model: a function of observations.

    Args:
        env: environment of the policy.
        model: see `Model`. Actions are clipped to [-1, 1]; for logits, the largest is chosen.
        name: name of the model in messages.
        is_residual: whether the model observes the built-in driver's action, too, as its last
            numbers, and returns a corrected action.
        other_side: exchanges left and right, if the model was trained on maps with traffic on the
            other side of the road.

    Raises:
        PolicyError: the model does not accept the observations of the environment, or its results
            are not actions of the environment.
    """

    def __init__(
        self,
        env: Environment,
        model: Model,
        name: str = "the model",
        is_residual: bool = False,
        other_side: OtherSide | None = None,
    ) -> None:
        super().__init__(env)
        self._model, self._name, self._is_residual = model, name, is_residual
        self._other_side = other_side
        self._actions = action_space(env.config.action)
        size = flat_observation_space(env.config).shape[0]
        size += sum(self._actions.shape or ()) if is_residual else 0
        try:
            self._decide(np.zeros((1, size), dtype=np.float32))
        except PolicyError:
            raise
        except Exception as error:  # the library of the model may raise any exception
            raise PolicyError(
                f"{name}: cannot be evaluated for the {size} numbers that an agent observes here: "
                f"{_first_line(error)}; give the environment the sensors of the training"
            ) from error

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the model's actions where `mask` is set, else 0."""
        shape, exchange = self._actions.shape or (), self._other_side
        actions = np.zeros((*mask.shape, *shape), dtype=self._actions.dtype)
        if exchange is not None:
            observations = exchange.observations(observations)
        if self._is_residual:
            proposed = built_in_actions(self.env, mask)
            if exchange is not None:
                proposed = exchange.actions(proposed)
            observations = np.concatenate([observations, proposed], axis=-1)
        if mask.any():
            decided = self._decide(observations[mask])
            actions[mask] = decided if exchange is None else exchange.actions(decided)
        return actions

    def _decide(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        found: NDArray[Any] = np.asarray(self._model(observations))
        if isinstance(self._actions, spaces.Box):
            wanted = (len(observations), *self._actions.shape)
            if found.shape == wanted and np.isfinite(found).all():
                return found.astype(np.float32).clip(-1.0, 1.0)
            raise self._refusal(found, f"finite numbers of the shape {wanted}: throttle, steering")
        choices = int(self._actions.n)
        if found.shape == (len(observations), choices) and not np.isnan(found).any():
            return np.asarray(found.argmax(axis=1), dtype=np.int64)
        whole = found.shape == (len(observations),) and np.issubdtype(found.dtype, np.integer)
        if whole and ((0 <= found) & (found < choices)).all():
            return found.astype(np.int64)
        raise self._refusal(
            found,
            f"whole numbers below {choices} of the shape ({len(observations)},), or logits of the "
            f"shape ({len(observations)}, {choices})",
        )

    def _refusal(self, found: NDArray[Any], needed: str) -> PolicyError:
        return PolicyError(
            f"{self._name}: returned {found.dtype} of the shape {found.shape}; with action.kind = "
            f"{self.env.config.action.kind}, it must return {needed}. Set action.kind as in the "
            "training"
        )


def make_policy(path: Path, env: Environment) -> Policy:
    """Return the policy in a model file; its suffix says which library reads it.

    `.zip`: a model that stable-baselines3 saved (extra `train`); if it was trained with
    VecNormalize, the file NAME.pkl beside it has the statistics. `.pt`, `.ts`: a TorchScript
    module (extra `train`). `.onnx`: an ONNX model with one input (extra `onnx`); a model that
    `export_onnx` wrote states its sensors, actions and maps. Files of the first two kinds can
    contain code, which this function runs.

    Raises:
        MissingExtraError: the library is not installed.
        PolicyError: the file cannot be read, or its model does not fit the environment.

    Warns:
        UntrainedMapWarning: the model states its maps, and was not trained on maps of this kind.
    """
    model, config = _READERS[path.suffix](path, env.config)
    if config is None:
        return ModelPolicy(env, model, str(path))
    other_side = meet_map(env, str(path), config.maps)
    return ModelPolicy(env, model, str(path), config.residual, other_side)


def model_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a model: the model, and for stable-baselines3 the statistics, if any."""
    statistics = path.with_suffix(".pkl")
    if path.suffix == SB3_FILE and statistics.is_file():
        return (path, statistics)
    return (path,)


def _read_sb3(path: Path, config: EnvConfig) -> _Read:
    require_all({"stable_baselines3": "train", "torch": "train"})
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.save_util import load_from_zip_file

    try:
        unused = dict.fromkeys(("learning_rate", "clip_range", "clip_range_vf", "_last_obs"), 0.0)
        # They may have been pickled by another version of Python, and are not needed to drive.
        data, weights, _ = load_from_zip_file(
            path, custom_objects={**unused, "lr_schedule": _no_learning}, device="cpu"
        )
        assert data is not None
        made: type[BasePolicy] = data["policy_class"]
        keywords = dict(data["policy_kwargs"])
        if data.get("use_sde"):
            keywords["use_sde"] = True
        seen, acted = data["observation_space"], data["action_space"]
        _check_spaces(path, seen, acted, config)
        policy: BasePolicy = made(seen, acted, _no_learning, **keywords)
        policy.load_state_dict(cast(dict[str, Any], weights["policy"]))
    except PolicyError:
        raise
    except (BadZipFile, AssertionError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise PolicyError(
            f"{path}: not a model that stable-baselines3 saved, or a model with a policy of "
            f"another package ({_first_line(error)}); save it with model.save, or write a .py file "
            "with make_policy(env)"
        ) from error
    policy.set_training_mode(False)
    normalize = _read_statistics(path, data.get("_last_original_obs") is not None)
    is_dict = isinstance(seen, spaces.Dict)
    parts, stack = observation_parts(config.sensors), config.sensors.stack

    def act(observations: NDArray[np.float32]) -> Any:
        shown: Any = observations
        if is_dict:
            shown = named_observation(parts, observations.reshape(len(observations), stack, -1))
        return policy.predict(normalize(shown), deterministic=True)[0]

    return act, None


def _no_learning(_: float) -> float:
    return 0.0


def _check_spaces(path: Path, seen: Any, acted: Any, config: EnvConfig) -> None:
    """Raise PolicyError if a model has other observations or actions than the environment."""
    here: spaces.Space[Any] = flat_observation_space(config)
    if isinstance(seen, spaces.Dict):
        form = config.observation
        if (form.mode, form.kind) != ("ground_truth", "dict"):
            raise PolicyError(
                f"{path}: observes a Dict; set observation.kind to dict, as in the training"
            )
        here = observation_space(config)
    pairs = (("observes", seen, here), ("acts in", acted, action_space(config.action)))
    for word, own, needed in pairs:
        if _shapes(own) != _shapes(needed):
            raise PolicyError(
                f"{path}: {word} {_shapes(own)}, but the environment has {_shapes(needed)}; give "
                "it the sensors and actions of the training (--set, --sensors-of)"
            )


def _shapes(space: Any) -> Any:
    """Return the parts of a space that a model depends on, as values that can be compared."""
    if isinstance(space, spaces.Dict):
        return {name: _shapes(part) for name, part in sorted(space.items())}
    if isinstance(space, spaces.Discrete):
        return f"{space.n} choices"
    return f"{space.shape} numbers"


def _read_statistics(path: Path, is_needed: bool) -> Callable[[Any], Any]:
    """Return the normalization of observations that belongs to a model."""
    from stable_baselines3.common.vec_env import VecNormalize

    file = path.with_suffix(".pkl")
    found: object = None
    if file.is_file():
        try:
            found = pickle.loads(file.read_bytes())
        except Exception as error:  # unpickling may raise any exception
            raise PolicyError(f"{file}: cannot be read: {_first_line(error)}") from error
    if isinstance(found, VecNormalize):
        return found.normalize_obs
    if is_needed:
        raise PolicyError(
            f"{path}: was trained with VecNormalize, whose statistics the file does not contain; "
            f"save them beside it with worlds.save('{file.name}') after the training"
        )
    return lambda observations: observations


def _read_torch_script(path: Path, _: EnvConfig) -> _Read:
    torch = require("torch", "train")
    try:
        with warnings.catch_warnings():
            # Newer versions recommend torch.export, which cannot read these files.
            warnings.simplefilter("ignore", DeprecationWarning)
            module = torch.jit.load(str(path), map_location="cpu").eval()
    except RuntimeError as error:
        raise PolicyError(
            f"{path}: not a TorchScript file ({_first_line(error)}); save the module with "
            "torch.jit.trace(module, torch.zeros(1, D)).save(FILE), D numbers per observation"
        ) from error

    def act(observations: NDArray[np.float32]) -> Any:
        with torch.inference_mode():
            return module(torch.from_numpy(observations)).numpy()

    return act, None


def _read_onnx(path: Path, here: EnvConfig) -> _Read:
    runtime = require("onnxruntime", "onnx")
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has exceptions of its own
        raise PolicyError(f"{path}: not an ONNX model: {_first_line(error)}") from error
    inputs = [entry.name for entry in session.get_inputs()]
    if len(inputs) != 1:
        raise PolicyError(
            f"{path}: has the inputs {', '.join(inputs)}; it must have one, the observations (N, D)"
        )
    from cavmarl.policies.onnx_export import read_onnx_config  # imports pydantic

    about = session.get_modelmeta()
    config = read_onnx_config(about.custom_metadata_map, path)
    if config is not None:
        check_fit(config, here, str(path), about.graph_name)
    return (lambda observations: session.run(None, {inputs[0]: observations})[0]), config


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


_READERS: Mapping[str, Callable[[Path, EnvConfig], _Read]] = {
    SB3_FILE: _read_sb3,
    **dict.fromkeys(TORCH_SCRIPT_FILES, _read_torch_script),
    ONNX_FILE: _read_onnx,
}
