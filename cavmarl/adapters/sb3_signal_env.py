"""All signals of all worlds as the environments of a `VecEnv` of stable-baselines3.

Importing this module loads stable-baselines3 and torch; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cavmarl.adapters.observations import refuse_decided
from cavmarl.adapters.sb3_vec_env import DECIDED, CavSb3VecEnv
from cavmarl.core.errors import ConfigError, missing
from cavmarl.env.limit_agents import LIMITS, LimitAgents
from cavmarl.env.signal_agents import SIGNALS, SignalAgents
from cavmarl.env.vector import make_vec
from cavmarl.policies.loading import load_policy
from cavmarl.signals.green_features import MOST, GreenFeatures

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ModuleNotFoundError as error:
    raise missing(error.name, "train") from error


class CavSb3SignalEnv(CavSb3VecEnv):
    """The S signals of W worlds as W · S environments that share one policy; row w · S + s.

    A step of a row lasts from one decision to the next, `signals.decide_s`. Observations are padded
    with 0 to the longest one. All rows have as many actions as the signal with the most greens;
    an action keeps the green if the signal has no such green or the mask excludes it. The mask of
    each row is `action_mask` in its info, and `action_masks()` returns all masks.

    Agents of vehicles, if there are any, follow `drivers`.

    Args:
        env: see `make_vec`.
        num_worlds: W.
        kind: the agents of the rows: `signals`, or roadside units with speed `limits`.
        features: `lanes`: observations as the agents get them. `greens`: the rows of
            `GreenFeatures`, for `sb3_green_policy.GreenPolicy`.
        spread: whether the worlds begin their first episodes at different times, so that later
            they are at different times of their episodes. For this, the first `reset` runs the
            worlds for about an episode, in which signals follow the durations of their programs.
        drivers: policy of the agents of vehicles, see `load_policy`; empty: the built-in driver.
        overrides: values of any other keys; `signals.agents` is `all` by default.
        arguments: other keyword arguments of `make_vec`; `agents` is 0 by default.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
        PolicyError: see `load_policy`.
    """

    def __init__(
        self,
        env: str | Path = "grid4x4",
        *,
        num_worlds: int = 1,
        kind: Literal["signals", "limits"] = "signals",
        features: Literal["lanes", "greens"] = "lanes",
        spread: bool = False,
        drivers: str = "",
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        refuse_decided(DECIDED, arguments)
        if features not in ("lanes", "greens"):
            raise ConfigError(f"features = {features!r}: must be 'lanes' or 'greens'")
        if kind not in (SIGNALS, LIMITS):
            raise ConfigError(f"kind = {kind!r}: must be {SIGNALS!r} or {LIMITS!r}")
        if kind == LIMITS and features == "greens":
            raise ConfigError("features = 'greens': limits have no greens; leave it out")
        keys = {f"{kind}.agents": "all", **(overrides or {})}
        self._vec = make_vec(
            env,
            num_envs=num_worlds,
            overrides=keys,
            **{"agents": 0, **arguments, "autoreset_mode": AutoresetMode.DISABLED},
        )
        self._agents: SignalAgents | LimitAgents = (
            self._vec.limits if kind == LIMITS else self._vec.signals
        )
        greens = features == "greens"
        self._features = GreenFeatures(self._vec.signals.table) if greens else None
        self._spreads = spread
        self._drivers = load_policy(drivers, self._vec, beside_signals=True) if drivers else None
        self._seen: tuple[Any, Any] = (None, None)  # observations and mask of the vehicles
        self._size = self._features.size if self._features else self._agents.table.sizes.features
        self._shape = (num_worlds, len(self._agents.agents))
        self._actions = np.zeros(self._shape, dtype=np.int64)
        VecEnv.__init__(
            self,
            num_worlds * len(self._agents.agents),
            spaces.Box(-MOST, MOST, (self._size,), np.float32)
            if self._features
            else self._agents.padded_observation_space,
            spaces.Discrete(self._agents.most_choices),
        )
        self.metadata = self._vec.metadata
        self.spec = None

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every world; all seeds are derived from the seed of the first row."""
        self._see(*self._vec.reset(seed=self._seeds[0]))
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        if self._spreads:
            self._spreads = False
            self._spread()
        return self._signal_rows()

    def _spread(self) -> None:
        """Begin new episodes one after the other, over the length of an episode."""
        worlds = self._shape[0]
        decide_s = getattr(self._vec.config, self._agents.kind).decide_s
        per_decision = round(decide_s / self._vec.config.clock.ctrl_dt_s)
        between = self._vec.max_cycles // per_decision // worlds * per_decision
        for world in range(worlds - 1):
            for _ in range(between):
                self._vec.step(self._vec.suggest_actions())
            self._see(*self._vec.reset(options={"reset_mask": np.arange(worlds) == world}))

    @property
    def sizes(self) -> tuple[int, int]:
        """The numbers of greens, and of values of a row that do not belong to a green."""
        if self._features is None:
            raise ConfigError("sizes: only rows of greens have sizes; pass features='greens'")
        return self._features.num_greens, self._features.num_shared

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
        kind, choices = self._agents.kind, self._agents.keep_beyond(self._actions)
        rewards = np.zeros(self._shape, dtype=np.float32)
        done = np.zeros(self._shape, dtype=np.bool_)
        last = np.zeros((self.num_envs, self._size), dtype=np.float32)
        while True:
            seen, gained, _, over, infos = self._vec.step(self._vehicles() | {kind: choices})
            self._see(seen, infos)
            rewards += gained[kind]
            if infos["episode_over"].any():
                done |= over[kind]
                ends = over[kind].reshape(-1)
                last[ends] = self._signal_rows()[ends]
                self._see(*self._vec.reset(options={"reset_mask": infos["episode_over"]}))
            if arrays.signal_decides.all():
                break
        masks = self.action_masks()
        shown: list[dict[str, Any]] = [{"action_mask": mask} for mask in masks]
        for row in np.flatnonzero(done):
            shown[row] |= {
                "terminal_observation": last[row],
                "TimeLimit.truncated": True,
            }
        return self._signal_rows(), rewards.reshape(-1), done.reshape(-1), shown

    def _see(self, observations: Any, infos: Mapping[str, Any]) -> None:
        self._seen = observations["vehicles"], infos["mask"]

    def _vehicles(self) -> dict[str, NDArray[Any]]:
        """Return the next actions of the agents of vehicles, if there are any."""
        if not self._vec.config.population.agents:
            return {}
        if self._drivers is None:
            return {"vehicles": self._vec.suggest_actions()["vehicles"]}
        return {"vehicles": self._drivers.act_batch(*self._seen)}

    def _signal_rows(self) -> NDArray[np.float32]:
        """Return the current observations (W · S, D)."""
        if self._features is None:
            found = self._agents.view.observations.copy()
        else:
            found = self._features.of(self._vec.signals.view)
        return found.reshape(self.num_envs, -1)
