"""One vehicle of a world as a single-agent environment of Gymnasium."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium

from cavmarl.adapters.observations import WithSpec, refuse_decided, refuse_signal_agents
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.world_copies import OwnWorlds

EGO = "car_0"
DECIDED = ("agents", "population.agents", "population.budget")


class CavEgoEnv(WithSpec, OwnWorlds, gymnasium.Env[Any, Any]):
    """One vehicle of a world; the built-in drivers drive all other vehicles.

    The entry's other agents become background vehicles, so that the traffic has the same density.
    Infos also contain highway-env's `speed` in m/s and `crashed`, and `is_success` (the vehicle has
    arrived). After the vehicle has left, `speed` is its last speed.

    An episode is the trip of one vehicle. In `closed` worlds, the default, the other vehicles leave
    one by one; in `open` and `respawn` worlds, new vehicles replace them.

    Args:
        env: see `parallel_env`.
        render_mode: `human`, `rgb_array` or None.
        background: number of other vehicles; None: one less than the entry has.
        overrides: see `parallel_env`.
        config: more overrides, nested as in an env.yaml: `{"sensors": {"lidar": {"rays": 8}}}`.
        action_kind: sets action.kind: `continuous`, `discrete` or `grid`.
        arguments: other keyword arguments of `parallel_env`.

    Raises:
        ConfigError: `overrides`, `config` or `arguments` have a key that this view sets itself
            (`agents`, `population.agents`, `population.budget`), or a value is not allowed.
    """

    metadata: dict[str, Any] = CavEnv.metadata

    def __init__(
        self,
        env: str | Path = "merge",
        *,
        render_mode: str | None = None,
        background: int | None = None,
        overrides: dict[str, Any] | None = None,
        config: Mapping[str, Any] | None = None,
        action_kind: str | None = None,
        **arguments: Any,
    ) -> None:
        wanted: Any = overrides or {}
        if config is not None and isinstance(wanted, Mapping):
            wanted = {**dict(_dotted(config)), **wanted}
        if action_kind is not None and isinstance(wanted, Mapping):
            wanted = {"action.kind": action_kind, **wanted}
        refuse_decided(DECIDED, wanted, arguments)
        population = load_config(env, overrides=wanted)[0].population
        if background is None and "population.background" not in wanted:
            background = population.background + population.agents - 1
        self._env = parallel_env(
            env,
            agents=1,
            background=background,
            render_mode=render_mode,
            overrides={"population.mode": "closed", **wanted, "population.budget": 1},
            **arguments,
        )
        refuse_signal_agents(self._env.config)
        self._horizon = self._env.max_cycles
        self.render_mode = render_mode
        self.metadata = self._env.metadata
        self.observation_space = self._env.observation_space(EGO)
        self.action_space = self._env.action_space(EGO)
        self._speed_mps = 0.0

    @property
    def parallel_env(self) -> CavEnv:
        """The world behind this view."""
        return self._env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        observations, infos = self._env.reset(seed=seed, options=options)
        return observations[EGO], self._info(infos[EGO])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one step with the vehicle's action."""
        observations, rewards, _, truncations, infos = self._env.step({EGO: action})
        ended = bool(infos[EGO]["vehicle_done"])  # agents do not terminate in `respawn` worlds
        cut = truncations[EGO] and not ended
        return observations[EGO], rewards[EGO], ended, cut, self._info(infos[EGO])

    def render(self) -> Any:
        """Draw the world; see `CavEnv.render`."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment; see `CavEnv.close`."""
        self._env.close()

    def _info(self, info: Mapping[str, float]) -> dict[str, Any]:
        for vehicle in self._env.worlds.driven(0, [0]):
            self._speed_mps = vehicle.speed_mps
        return {
            **info,
            "speed": self._speed_mps,
            "crashed": info["collision"] > 0.0,
            "is_success": info["arrival"] > 0.0,
        }


def _dotted(keys: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield nested keys as dotted keys.

    Raises:
        ConfigError: `keys` is not a mapping.
    """
    if not isinstance(keys, Mapping):
        raise ConfigError(
            f"config = {keys!r}: must be a mapping from keys to values, as in an env.yaml"
        )
    for key, value in keys.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
