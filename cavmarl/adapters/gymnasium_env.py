"""Gymnasium's two forms: one vehicle as an `Env`, all agents as the rows of a `VectorEnv`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.cav_env import CavEnv, parallel_env
from cavmarl.errors import ConfigError
from cavmarl.registry import load_config
from cavmarl.vector_env import make_vec

__all__ = ["CavAgentRows", "CavEgoEnv"]

EGO = "car_0"


def _without(
    overrides: dict[str, Any] | None, arguments: dict[str, Any], fixed: tuple[str, ...]
) -> dict[str, Any]:
    """The overrides, or an error for a key that the view itself decides."""
    given = overrides or {}
    for key in fixed:
        if key in given or key in arguments:
            raise ConfigError(
                f"{key}: this view decides it; cavmarl.parallel_env and make_vec leave it to you"
            )
    return given


class CavEgoEnv(gymnasium.Env[Any, Any]):
    """One vehicle of a world; the built-in drivers drive all others.

    The entry's other agents become background vehicles, so that the traffic is as dense as there.

    Args:
        env: as for `parallel_env`.
        render_mode: `human`, `rgb_array` or None.
        background: other vehicles; None: all of the entry but one.
        overrides: as for `parallel_env`.
        arguments: other keywords of `parallel_env`.
    """

    metadata: dict[str, Any] = CavEnv.metadata

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        render_mode: str | None = None,
        background: int | None = None,
        overrides: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        wanted = _without(overrides, arguments, ("agents", "population.agents", "population.mode"))
        population = load_config(env, overrides=overrides)[0].population
        if background is None and "population.background" not in wanted:
            background = population.background + population.agents - 1
        self._env = parallel_env(
            env,
            agents=1,
            background=background,
            render_mode=render_mode,
            overrides={**wanted, "population.mode": "closed"},
            **arguments,
        )
        self.render_mode = render_mode
        self.metadata = self._env.metadata
        self.observation_space = self._env.observation_space(EGO)
        self.action_space = self._env.action_space(EGO)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        observations, infos = self._env.reset(seed=seed, options=options)
        return observations[EGO], dict(infos[EGO])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Let the vehicle act."""
        observations, rewards, terminations, truncations, infos = self._env.step({EGO: action})
        return (
            observations[EGO],
            rewards[EGO],
            terminations[EGO],
            truncations[EGO],
            dict(infos[EGO]),
        )

    def render(self) -> Any:
        """As `CavEnv.render`."""
        return self._env.render()

    def close(self) -> None:
        """As `CavEnv.close`."""
        self._env.close()


class CavAgentRows(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """The agents of one world as rows, for programs written for vectors of single agents.

    Always in `seats`: a row whose vehicle ended gets a new one. Rows end singly (terminations), all
    of them at the horizon (truncations). `infos["active"]` says which rows have a vehicle; the
    others' observations are 0 and their actions are not read. Rows that ended carry their last
    observation in `infos["final_obs"]`.

    Args:
        env: as for `make_vec`.
        num_envs: rows, so agents.
        arguments: other keywords of `make_vec`.
    """

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        num_envs: int = 1,
        overrides: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        wanted = _without(overrides, arguments, ("agents", "population.agents", "population.mode"))
        self._vec = make_vec(
            env,
            num_envs=1,
            agents=num_envs,
            overrides={**wanted, "population.mode": "seats"},
            **arguments,
        )
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = self._vec.single_observation_space
        self.single_action_space = self._vec.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        observations, infos = self._vec.reset(seed=seed, options=options)
        return observations[0], {"active": infos["mask"][0]}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float32],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Let every row act."""
        observations, rewards, terminations, truncations, infos = self._vec.step(
            np.asarray(actions)[None]
        )
        ended = terminations[0] | truncations[0]
        shown: dict[str, Any] = {"active": infos["mask"][0]}
        if ended.any():
            shown["final_obs"] = infos["final_observations"][0]
            shown["_final_obs"] = ended
        return observations[0], rewards[0], terminations[0], truncations[0], shown
