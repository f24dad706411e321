"""Gymnasium's vector form: all agents as the rows of a `VectorEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.adapters.observations import ObservationForm, Observations, refuse_decided
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec

DECIDED = ("agents", "population.budget")


class CavAgentRows(VectorEnv[Any, Any, Any]):
    """The agents of one or more worlds as rows, for programs written for vectors of single agents.

    A row is an agent id of a world; row `w · A + a` is agent a of world w. In `seats` worlds, the
    default, a row whose vehicle ended gets a new one as soon as there is room. In `closed` worlds
    it waits until the world begins anew, and in `entering` worlds each row is used once an episode,
    from when its agent enters.

    Rows end singly (terminations), and all that have a vehicle at the horizon (truncations).
    `infos["active"]` says which rows act next: the others' observations are 0 and their actions are
    not read, but for a row that has just ended with `NEXT_STEP`: it shows its last observation.
    With `SAME_STEP` that is in `infos["final_obs"]`. The infos also hold every term by its name.

    Args:
        env: as for `make_vec`.
        num_envs: rows of all worlds together.
        num_worlds: how many worlds they are in.
        autoreset_mode: when rows and worlds that ended begin anew.
        overrides: values for any other key.
        arguments: other keywords of `make_vec`.

    Raises:
        ConfigError: rows that cannot be shared among the worlds, a key that this view decides, or
            that cannot work.
    """

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        num_envs: int = 1,
        num_worlds: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        self.closed = True  # until there is something to close: Gymnasium does so when it is freed
        refuse_decided(DECIDED, overrides, arguments)
        wanted = {"population.mode": "respawn", **(overrides or {})}
        self._vec = make_vec(
            env,
            num_envs=num_worlds,
            autoreset_mode=autoreset_mode,
            overrides=wanted | _rows_a_world(env, wanted, num_envs, num_worlds),
            **arguments,
        )
        self.closed = False
        self._shape = (num_worlds, self._vec.num_agents)
        self._term_names = self._vec.config.terms.names
        self._form = ObservationForm(self._vec.config)
        self._same_step = self._vec.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        self.num_envs = num_envs
        self.metadata = self._vec.metadata
        self.single_observation_space = self._form.space
        self.single_action_space = self._vec.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def vec(self) -> CavVectorEnv:
        """The worlds behind this view."""
        return self._vec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode in every world."""
        super().reset(seed=seed)
        observations, infos = self._vec.reset(seed=seed, options=options)
        return self._form(self._rows(observations)), self._told({"active": infos["mask"]})

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        Observations, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Let every row act."""
        actions = np.asarray(actions)
        observations, rewards, ended, cut, infos = self._vec.step(
            actions.reshape(*self._shape, *actions.shape[1:])
        )
        terms = {name: infos["terms"][..., k] for k, name in enumerate(self._term_names)}
        told = self._told({"active": infos["mask"], "vehicle_done": infos["vehicle_done"], **terms})
        over = self._rows(ended | cut)
        if self._same_step and over.any():
            told["final_obs"] = self._last(self._rows(infos["final_observations"]), over)
            told["_final_obs"] = over
        return (
            self._form(self._rows(observations)),
            self._rows(rewards),
            self._rows(ended),
            self._rows(cut),
            told,
        )

    def close_extras(self, **_: Any) -> None:
        """As `CavVectorEnv.close`."""
        self._vec.close()

    def _told(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Infos of all rows, each with the mask of its rows, as Gymnasium's wrappers expect."""
        everybody = np.ones(self.num_envs, dtype=np.bool_)
        told: dict[str, Any] = {name: self._rows(array) for name, array in arrays.items()}
        return told | {f"_{name}": everybody for name in arrays}

    def _last(self, flat: NDArray[np.float32], over: NDArray[np.bool_]) -> NDArray[np.object_]:
        """(rows,) the last observations of those that are over, None for the others."""
        found = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(over):
            found[row] = self._form(flat[row])
        return found

    def _rows(self, batch: NDArray[Any]) -> NDArray[Any]:
        """(W, A, …) as (W · A, …)."""
        return batch.reshape(-1, *batch.shape[2:])


def _rows_a_world(
    env: str | Path, overrides: Mapping[str, Any], num_envs: int, num_worlds: int
) -> dict[str, int]:
    """The keys that give each world its share of the rows.

    Raises:
        ConfigError: no number of agents does.
    """
    if min(num_envs, num_worlds) < 1 or num_envs % num_worlds:
        raise ConfigError(
            f"num_envs = {num_envs}: must be a multiple of num_worlds = {num_worlds}, as every "
            "world has the same number of rows"
        )
    rows = num_envs // num_worlds
    if overrides["population.mode"] == "open":
        agents = load_config(env, overrides=overrides)[0].population.agents
        return {"population.agents": min(agents, rows), "population.budget": rows}
    refuse_decided(["population.agents"], overrides)
    return {"population.agents": rows}
