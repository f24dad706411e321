"""Gymnasium's vector form: all agents as the rows of a `VectorEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.adapters.observations import ObservationForm, Observations, WithSpec, refuse_decided
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.env.world_copies import OwnWorlds

DECIDED = ("agents", "population.budget")


class CavAgentRows(WithSpec, OwnWorlds, VectorEnv[Any, Any, Any]):
    """The agents of one or more worlds as rows, for programs written for vectors of single agents.

    A row is an agent id of a world; row `w · A + a` is agent a of world w. In `respawn` worlds, the
    default, a row whose vehicle ended gets a new one as soon as there is room. In `closed` worlds
    it waits until the world begins anew, and in `open` worlds each row is used once an episode,
    from when its agent enters.

    Rows end singly (terminations), and all that have a vehicle at the horizon (truncations).
    `infos["active"]` says which rows act next: the others' observations are 0 and their actions are
    not read, but for a row that has just ended with `NEXT_STEP` or `DISABLED`: it shows its last
    observation. With `SAME_STEP` that is in `infos["final_obs"]`, and what the infos said of it in
    `infos["final_info"]`. The infos also hold every term by its name.

    With `DISABLED`, `reset(options={"reset_mask": …})` takes (num_envs,) rows: a world that is over
    begins anew with any of its rows, one that goes on with all of them. A row that ended while its
    world goes on waits as ever, and shows 0 until it has a vehicle. The horizon truncates every row
    of a world, also those without a vehicle.

    A frame of a row is that of its world.

    Args:
        env: as for `make_vec`.
        num_envs: rows of all worlds together.
        num_worlds: how many worlds they are in.
        autoreset_mode: when rows and worlds that ended begin anew.
        max_episode_steps: Gymnasium's name of `max_cycles`.
        render_mode: `rgb_array` or None.
        action_kind: shadows action.kind, `continuous`, `discrete` or `grid`.
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
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        action_kind: str | None = None,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        self.closed = True  # until there is something to close: Gymnasium does so when it is freed
        refuse_decided(DECIDED, overrides, arguments)
        wanted = {"population.mode": "respawn", **(overrides or {})}
        if action_kind is not None:
            wanted.setdefault("action.kind", action_kind)
        if max_episode_steps is not None and arguments.get("max_cycles") is None:
            arguments["max_cycles"] = max_episode_steps
        self._vec = make_vec(
            env,
            num_envs=num_worlds,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
            overrides=wanted | _rows_a_world(env, wanted, num_envs, num_worlds),
            **arguments,
        )
        self.closed = False
        self._shape = (num_worlds, self._vec.num_agents)
        self._term_names = self._vec.config.terms.names
        self._form = ObservationForm(self._vec.config)
        self.autoreset_mode: AutoresetMode = self._vec.metadata["autoreset_mode"]
        self._horizon = self._vec.max_cycles
        self.render_mode = render_mode
        self.num_envs = num_envs
        self._over = np.zeros((2, num_envs), dtype=np.bool_)  # the row itself, and its world
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
        chosen = (options or {}).get("reset_mask")
        if chosen is not None:
            options = {**(options or {}), "reset_mask": self._worlds_of(np.asarray(chosen))}
        observations, infos = self._vec.reset(seed=seed, options=options)
        waits: NDArray[np.bool_] = np.zeros(self.num_envs, dtype=np.bool_)
        if chosen is None:
            self._over[:] = False
        else:
            ended, over = self._over
            waits = chosen & ended & ~over
            self._over[:, chosen] = False
        shown = self._rows(observations)
        if waits.any():
            shown = np.where(waits[:, None], np.float32(0.0), shown)
        return self._form(shown), self._told({"active": infos["mask"]})

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
        if self.autoreset_mode is AutoresetMode.DISABLED:
            # Rows without a vehicle have to say so as well: a world may end when none has one.
            cut = cut | (infos["episode_over"][:, None] & ~ended)
        over = self._rows(ended | cut)
        self._over = np.stack([over, infos["episode_over"].repeat(self._shape[1])])
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            told["final_obs"] = self._last(self._rows(infos["final_observations"]), over)
            told["final_info"] = {}
            for name, array in terms.items():
                rows = self._rows(array)
                told["final_info"] |= {name: np.where(over, rows, 0.0), f"_{name}": over}
            told["_final_obs"] = told["_final_info"] = over
        return (
            self._form(self._rows(observations)),
            self._rows(rewards),
            self._rows(ended),
            self._rows(cut),
            told,
        )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A frame (height, width, 3) a row, that of its world."""
        frames = self._vec.render()
        if frames is None:
            return None
        return tuple(frame for frame in frames for _ in range(self._shape[1]))

    def close_extras(self, **_: Any) -> None:
        """As `CavVectorEnv.close`."""
        self._vec.close()

    def _worlds_of(self, rows: NDArray[Any]) -> NDArray[np.bool_]:
        """(W,) the worlds that begin anew for these rows.

        Raises:
            ConfigError: not a mask of rows, or only a part of a world that goes on.
        """
        if rows.shape != (self.num_envs,) or rows.dtype != np.bool_:
            raise ConfigError(
                f"reset_mask has shape {rows.shape} and dtype {rows.dtype}: must be "
                f"({self.num_envs},) and bool, one a row"
            )
        ended, over = self._over.reshape(2, *self._shape)
        chosen = rows.reshape(self._shape)
        worlds = np.logical_or(chosen.all(axis=1), (chosen & over).any(axis=1))
        parts = chosen & ~ended & ~worlds[:, None]
        if parts.any():
            raise ConfigError(
                f"reset_mask has row {int(parts.argmax())}, which has not ended: its world goes on "
                f"for the other rows; choose all {self._shape[1]} of the world"
            )
        return worlds

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
