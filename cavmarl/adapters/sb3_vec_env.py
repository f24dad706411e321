"""All agents of all worlds as the environments of a `VecEnv` of stable-baselines3.

Importing this module loads stable-baselines3 and torch; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cavmarl.adapters.observations import (
    ObservationForm,
    Observations,
    WithSpec,
    refuse_decided,
    refuse_signal_agents,
)
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import missing
from cavmarl.env.vector import make_vec
from cavmarl.env.world_copies import OwnWorlds

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ModuleNotFoundError as error:
    raise missing(error.name, "train") from error

DECIDED = ("autoreset_mode", "copy")  # stable-baselines3 resets in the same step and keeps arrays
ARRIVAL = TERMS.index("arrival")

Indices = int | Iterable[int] | None


class CavSb3VecEnv(WithSpec, OwnWorlds, VecEnv):
    """W worlds with A agents each as W · A environments that share one policy; row w · A + a.

    In `respawn` worlds, the default, a row gets a new vehicle as soon as there is room. In `closed`
    worlds, it waits until the world resets. In `open` worlds, each row is used once per episode,
    from the time when its agent enters.

    A row that ended is `done`. Its info has its last observation as `terminal_observation`, whether
    the horizon ended it as `TimeLimit.truncated`, and whether it arrived as `is_success`. While a
    row waits for a vehicle, its observation and reward are 0, its actions are not read, and its
    info has `inactive`. With `render_mode="rgb_array"`, a picture has one tile per world.

    Args:
        env: see `make_vec`.
        num_worlds: W.
        overrides: values of any other keys.
        arguments: other keyword arguments of `make_vec`.

    Attributes:
        spec: Gymnasium's spec of the entry's rows; None if the entry has no id in Gymnasium.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
    """

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        num_worlds: int = 1,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        refuse_decided(DECIDED, arguments)
        self._vec = make_vec(
            env,
            num_envs=num_worlds,
            overrides={"population.mode": "respawn", **(overrides or {})},
            **arguments,
        )
        refuse_signal_agents(self._vec.config)
        self._form = ObservationForm(self._vec.config)
        self._shape = (num_worlds, self._vec.num_agents)
        self._actions: NDArray[Any] = np.zeros(0)
        super().__init__(
            num_worlds * self._vec.num_agents, self._form.space, self._vec.single_action_space
        )
        self.metadata = self._vec.metadata
        self._horizon = self._vec.max_cycles
        self.spec = gymnasium.registry.get(f"cavmarl/{env}Agents-v{self._vec.config.version}")

    def reset(self) -> Observations:
        """Begin an episode in every world; all seeds are derived from the seed of the first row."""
        observations, infos = self._vec.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} if active else {"inactive": True} for active in infos["mask"].flat]
        return self._form(self._rows(observations))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of all rows."""
        self._actions = actions.reshape(*self._shape, *actions.shape[1:])

    def step_wait(
        self,
    ) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Run one step with the stored actions."""
        observations, rewards, ended, cut, infos = self._vec.step(self._actions)
        done = self._rows(ended | cut)
        shown: list[dict[str, Any]] = [
            {} if acted else {"inactive": True} for acted in infos["acted"].flat
        ]
        last = self._rows(infos["final_observations"])
        arrived = self._rows(infos["terms"])[:, ARRIVAL] > 0.0
        truncated = self._rows(cut)
        for row in np.flatnonzero(done):
            shown[row] = {
                "terminal_observation": self._form(last[row]),
                "TimeLimit.truncated": bool(truncated[row]),
                "is_success": bool(arrived[row]),
            }
        return self._form(self._rows(observations)), self._rows(rewards), done, shown

    def close(self) -> None:
        """Close the environment; see `CavVectorEnv.close`."""
        self._vec.close()

    def get_images(self) -> tuple[NDArray[np.uint8], ...]:
        """Return a frame (height, width, 3) per world; `render` combines them in one picture."""
        return self._vec.render() or ()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the worlds, the same for every row."""
        value = self.spec if attr_name == "spec" else getattr(self._vec, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Raise an error: rows share their worlds.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"{attr_name}: cannot be set, because rows share their worlds")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the worlds once, and return its result for every row."""
        found = getattr(self._vec, method_name)(*method_args, **method_kwargs)
        return [found for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Indices = None) -> list[bool]:
        """Return False for each row, because rows cannot be wrapped individually."""
        return [False for _ in self._get_indices(indices)]

    def _rows(self, batch: NDArray[Any]) -> NDArray[Any]:
        """Reshape (W, A, …) to (W · A, …)."""
        return batch.reshape(-1, *batch.shape[2:])
