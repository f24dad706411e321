"""All agents as the rows of a `VectorEnv` of Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.adapters.observations import (
    ObservationForm,
    Observations,
    WithSpec,
    refuse_decided,
    refuse_signal_agents,
)
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.env.world_copies import OwnWorlds

DECIDED = ("agents", "population.budget")


class CavAgentRows(WithSpec, OwnWorlds, VectorEnv[Any, Any, Any]):
    """The agents of one or more worlds as rows of a vector of single-agent environments.

    A row is an agent of a world; row `w · A + a` is agent a of world w. In `respawn` worlds, the
    default, a row gets a new vehicle as soon as there is room. In `closed` worlds, it waits until
    the world resets. In `open` worlds, each row is used once per episode, from the time when its
    agent enters.

    Rows end individually (terminations), or all at the horizon (truncations).
    `infos["active"]` marks the rows that act next. Observations of the other rows are 0, and their
    actions are not read. With `NEXT_STEP` or `DISABLED`, a row that has just ended shows its last
    observation. With `SAME_STEP`, that observation is in `infos["final_obs"]`, and the row's last
    infos are in `infos["final_info"]`. Infos also have every term by its name.

    With `DISABLED`, `reset(options={"reset_mask": …})` takes a mask of rows (num_envs,). If a
    world is over, it resets if any of its rows is chosen. If a world is not over, it resets only if
    all of its rows are chosen. If only some of them are chosen, these rows must have ended. They
    then wait, with observations of 0, until they have a vehicle. The horizon truncates all rows of
    a world.

    The frame of a row is the frame of its world.

    Args:
        env: see `make_vec`.
        num_envs: number of rows in all worlds.
        num_worlds: number of worlds.
        autoreset_mode: when rows and worlds restart after they end.
        max_episode_steps: Gymnasium's name for `max_cycles`.
        render_mode: `rgb_array` or None.
        action_kind: sets action.kind: `continuous`, `discrete` or `grid`.
        overrides: values of any other keys.
        arguments: other keyword arguments of `make_vec`.

    Raises:
        ConfigError: the rows cannot be distributed over the worlds; `overrides` or `arguments` have
            a key that this view sets itself (`agents`, `population.budget`; also
            `population.agents`, unless the worlds are `open`); or a value is not allowed.
    """

    closed = True  # Gymnasium calls close() on garbage collection, even without an __init__

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
            overrides=wanted | _rows_per_world(env, wanted, num_envs, num_worlds),
            **arguments,
        )
        self.closed = False
        self._shape = (num_worlds, self._vec.num_agents)
        self._term_names = self._vec.config.terms.names
        refuse_signal_agents(self._vec.config)
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
        return self._form(shown), self._infos({"active": infos["mask"]})

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        Observations, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Run one step with the actions of all rows."""
        actions = np.asarray(actions)
        observations, rewards, ended, cut, infos = self._vec.step(
            actions.reshape(*self._shape, *actions.shape[1:])
        )
        terms = {name: infos["terms"][..., k] for k, name in enumerate(self._term_names)}
        row_infos = self._infos(
            {"active": infos["mask"], "vehicle_done": infos["vehicle_done"], **terms}
        )
        if self.autoreset_mode is AutoresetMode.DISABLED:
            # Truncate rows without a vehicle, too: a world may end when no row has a vehicle.
            cut = cut | (infos["episode_over"][:, None] & ~ended)
        over = self._rows(ended | cut)
        self._over = np.stack([over, infos["episode_over"].repeat(self._shape[1])])
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            row_infos["final_obs"] = self._last(self._rows(infos["final_observations"]), over)
            row_infos["final_info"] = {}
            for name, array in terms.items():
                rows = self._rows(array)
                row_infos["final_info"] |= {name: np.where(over, rows, 0.0), f"_{name}": over}
            row_infos["_final_obs"] = row_infos["_final_info"] = over
        return (
            self._form(self._rows(observations)),
            self._rows(rewards),
            self._rows(ended),
            self._rows(cut),
            row_infos,
        )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return the frame (height, width, 3) of its world for each row."""
        frames = self._vec.render()
        if frames is None:
            return None
        return tuple(frame for frame in frames for _ in range(self._shape[1]))

    def close_extras(self, **_: Any) -> None:
        """Close the environment; see `CavVectorEnv.close`."""
        self._vec.close()

    def _worlds_of(self, rows: NDArray[Any]) -> NDArray[np.bool_]:
        """Return the worlds (W,) that reset for these rows.

        Raises:
            ConfigError: `rows` is not a mask, or selects only some active rows of a world.
        """
        if rows.shape != (self.num_envs,) or rows.dtype != np.bool_:
            raise ConfigError(
                f"reset_mask has shape {rows.shape} and dtype {rows.dtype}: must be "
                f"({self.num_envs},) and bool, one value per row"
            )
        ended, over = self._over.reshape(2, *self._shape)
        chosen = rows.reshape(self._shape)
        worlds = np.logical_or(chosen.all(axis=1), (chosen & over).any(axis=1))
        parts = chosen & ~ended & ~worlds[:, None]
        if parts.any():
            raise ConfigError(
                f"reset_mask selects row {int(parts.argmax())}, which has not ended, but not all "
                f"rows of its world: select all {self._shape[1]} rows of the world"
            )
        return worlds

    def _infos(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Return infos of all rows with masks, as Gymnasium's wrappers expect them."""
        all_rows = np.ones(self.num_envs, dtype=np.bool_)
        infos: dict[str, Any] = {name: self._rows(array) for name, array in arrays.items()}
        return infos | {f"_{name}": all_rows for name in arrays}

    def _last(self, flat: NDArray[np.float32], over: NDArray[np.bool_]) -> NDArray[np.object_]:
        """Return the last observations (rows,) of rows that are over, None for other rows."""
        found = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(over):
            found[row] = self._form(flat[row])
        return found

    def _rows(self, batch: NDArray[Any]) -> NDArray[Any]:
        """Reshape (W, A, …) to (W · A, …)."""
        return batch.reshape(-1, *batch.shape[2:])


def _rows_per_world(
    env: str | Path, overrides: Mapping[str, Any], num_envs: int, num_worlds: int
) -> dict[str, int]:
    """Return the keys of the configuration that distribute the rows over the worlds.

    Raises:
        ConfigError: the rows cannot be divided evenly.
    """
    if min(num_envs, num_worlds) < 1 or num_envs % num_worlds:
        raise ConfigError(
            f"num_envs = {num_envs}: must be a multiple of num_worlds = {num_worlds}, because "
            "every world has the same number of rows"
        )
    rows = num_envs // num_worlds
    if overrides["population.mode"] == "open":
        agents = load_config(env, overrides=overrides)[0].population.agents
        return {"population.agents": min(agents, rows), "population.budget": rows}
    refuse_decided(["population.agents"], overrides)
    return {"population.agents": rows}
