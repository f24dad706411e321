"""All signals of all worlds as the environments of a `VecEnv` of stable-baselines3.

Importing this module loads stable-baselines3 and torch; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.adapters.observations import refuse_decided
from cavmarl.adapters.sb3_vec_env import DECIDED, CavSb3VecEnv
from cavmarl.core.errors import missing
from cavmarl.env.vector import make_vec

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ModuleNotFoundError as error:
    raise missing(error.name, "train") from error


class CavSb3SignalEnv(CavSb3VecEnv):
    """The S signals of W worlds as W · S environments that share one policy; row w · S + s.

    A step of a row lasts from one decision to the next, `signals.decide_s`. Observations are padded
    with 0 to the longest one. All rows have as many actions as the signal with most greens; an
    action beyond a signal's greens, or that its mask excludes, keeps the green. The mask of
    each row is `action_mask` in its info, and `action_masks()` returns all of them.

    Agents of vehicles, if there are any, follow the built-in driver.

    Args:
        env: see `make_vec`.
        num_worlds: W.
        overrides: values of any other keys; `signals.agents` is `all` by default.
        arguments: other keyword arguments of `make_vec`; `agents` is 0 by default.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
    """

    def __init__(
        self,
        env: str | Path = "grid4x4",
        *,
        num_worlds: int = 1,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        refuse_decided(DECIDED, arguments)
        keys = {"signals.agents": "all", **(overrides or {})}
        self._vec = make_vec(env, num_envs=num_worlds, overrides=keys, **{"agents": 0, **arguments})
        num_signals = len(self._vec.signals.agents)
        self._shape = (num_worlds, num_signals)
        self._actions = np.zeros(self._shape, dtype=np.int64)
        VecEnv.__init__(
            self,
            num_worlds * num_signals,
            self._vec.signals.padded_observation_space,
            spaces.Discrete(self._vec.signals.most_choices),
        )
        self.metadata = self._vec.metadata
        self.spec = None

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every world; all seeds are derived from the seed of the first row."""
        observations, _ = self._vec.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return self._signal_rows(observations["signals"])

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the allowed actions (W · S, G) of the next step."""
        masks = self._vec.worlds.arrays.signal_masks.copy()
        return masks.reshape(self.num_envs, -1)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of all rows."""
        self._actions = actions.reshape(self._shape).astype(np.int64)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Run all steps of the worlds until the next decision, with the stored actions."""
        arrays = self._vec.worlds.arrays
        choices = self._vec.signals.keep_beyond(self._actions)
        rewards = np.zeros(self._shape, dtype=np.float32)
        done = np.zeros(self._shape, dtype=np.bool_)
        last = np.zeros((*self._shape, arrays.signal_observations.shape[2]), dtype=np.float32)
        while True:
            actions = {"signals": choices}
            if self._vec.config.population.agents:
                actions["vehicles"] = self._vec.suggest_actions()["vehicles"]
            observations, gained, _, over, infos = self._vec.step(actions)
            rewards += gained["signals"]
            ends = over["signals"]
            last[ends] = infos["final_observations"]["signals"][ends]
            done |= ends
            if infos["signal_decides"].all():
                break
        masks = self.action_masks()
        shown: list[dict[str, Any]] = [{"action_mask": mask} for mask in masks]
        for row in np.flatnonzero(done):
            shown[row] |= {
                "terminal_observation": last.reshape(self.num_envs, -1)[row],
                "TimeLimit.truncated": True,
            }
        rows = self._signal_rows(observations["signals"])
        return rows, rewards.reshape(-1), done.reshape(-1), shown

    def _signal_rows(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Reshape (W, S, D) to (W · S, D)."""
        return batch.reshape(self.num_envs, -1)
