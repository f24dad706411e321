"""The entries of `envs/` as tasks of BenchMARL, via `cavmarl.adapters.torchrl_env`.

Importing this module loads BenchMARL and torch; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cavmarl.adapters.observations import refuse_decided
from cavmarl.adapters.torchrl_env import CavTorchRLEnv
from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import entries, load_config
from cavmarl.core.errors import missing

try:
    from benchmarl.environments.common import Task, TaskClass
    from torchrl.data import Composite
except ModuleNotFoundError as error:
    raise missing(error.name, "benchmarl") from error

DECIDED = ("num_envs", "device", "action.kind")


class CavTaskClass(TaskClass):  # type: ignore[misc] # only installed in a separate environment
    """An environment; BenchMARL chooses the number of worlds, the device and the kind of action.

    The groups are `vehicles` and `signals`, each with its own policy. If signals have agents,
    all actions are discrete, because BenchMARL cannot train continuous and discrete actions
    together: vehicles then have meta-actions.

    In `respawn` worlds, the default, an agent gets a new vehicle when its trip has ended.
    BenchMARL's losses have no mask: steps without a vehicle count, too, with an observation and a
    reward of 0. They are rare in `respawn` worlds, and frequent in `closed` and `open` worlds. For
    the same reason, set `clock.ctrl_dt_s` to `signals.decide_s` if only signals have agents, so
    that each step is a decision.

    Args:
        name: name of the task. Unless `config` has `env`, this must be the environment's name in
            upper case, with `_` for `-`.
        config: keyword arguments of `CavTorchRLEnv`.

    Raises:
        ConfigError: BenchMARL sets one of the keyword arguments.
    """

    def __init__(self, name: str, config: Mapping[str, Any] | None = None) -> None:
        named = {entry.upper().replace("-", "_"): entry for entry in entries()}
        super().__init__(name, {"env": named.get(name, name.lower()), **(config or {})})
        refuse_decided(DECIDED, self.config, self.config.get("overrides"))

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], CavTorchRLEnv]:
        """Return a function that makes `num_envs` worlds."""
        overrides = {
            **self._overrides,
            "action.kind": "continuous" if continuous_actions else self._choices,
        }
        arguments = {**self.config, "overrides": overrides, "num_envs": num_envs, "device": device}

        def make() -> CavTorchRLEnv:
            worlds = CavTorchRLEnv(**arguments)
            worlds.set_seed(seed)
            return worlds

        return make

    @property
    def _overrides(self) -> dict[str, Any]:
        return {"population.mode": "respawn", **self.config.get("overrides", {})}

    @property
    def _choices(self) -> str:
        """The environment's kind of action; `discrete` (meta-actions) instead of `continuous`."""
        kind = self._world.action.kind
        return "discrete" if kind == "continuous" else kind

    @property
    def _world(self) -> EnvConfig:
        named = {key: self.config.get(key) for key in ("agents", "background", "max_cycles")}
        return load_config(self.config["env"], overrides=self._overrides, **named)[0]

    def supports_continuous_actions(self) -> bool:
        """Return whether all actions can be continuous: only vehicles have agents."""
        return self._world.roadside is None

    def supports_discrete_actions(self) -> bool:
        """Return True: vehicles can have meta-actions, or the environment's grid of actions."""
        return True

    def max_steps(self, env: CavTorchRLEnv) -> int:
        """Return the number of steps to the horizon."""
        return int(env.max_cycles)

    def has_render(self, env: CavTorchRLEnv) -> bool:
        """Return False: batches of worlds are not drawn."""
        return False

    def group_map(self, env: CavTorchRLEnv) -> dict[str, list[str]]:
        """Return the ids of the agents of each group."""
        return dict(env.group_map)

    def observation_spec(self, env: CavTorchRLEnv) -> Composite:
        """Return the spec of the observations of one world's agents."""
        return self._of_agents(env, "observation")

    def info_spec(self, env: CavTorchRLEnv) -> Composite:
        """Return the spec of the terms of one world's agents, by name."""
        return self._of_agents(env, "info")

    def state_spec(self, env: CavTorchRLEnv) -> None:
        """Return None: central critics read the observations of all agents."""

    def action_spec(self, env: CavTorchRLEnv) -> Composite:
        """Return the action spec of one world."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: CavTorchRLEnv) -> Composite | None:
        """Return the spec of the action masks of one world; None if only vehicles have agents."""
        return None if self._world.roadside is None else self._of_agents(env, "action_mask")

    @staticmethod
    def env_name() -> str:
        """Return BenchMARL's name for all environments."""
        return "cavmarl"

    @staticmethod
    def _of_agents(env: CavTorchRLEnv, part: str) -> Composite:
        """Return the spec of one world with only the entry `part` of the agents."""
        spec = env.full_observation_spec_unbatched.clone()
        for group in env.group_map:
            for other in set(spec[group].keys()) - {part}:
                del spec[group, other]
        return spec


class CavTask(Task):  # type: ignore[misc] # only installed in a separate environment
    """The entries of `envs/`; `CavTaskClass` accepts other folders and maps."""

    BLIND_JUNCTION = None
    BOTTLENECK = None
    CITIES = None
    CITIES_VALIDATION = None
    EXIT = None
    GRID4X4 = None
    HIGHWAY = None
    INTERSECTION = None
    LANE_DROP = None
    MERGE = None
    RING = None
    RING22 = None
    ROUNDABOUT = None
    RUSH = None
    TOLLGATE = None
    TOWN = None
    TWO_WAY = None
    U_TURN = None

    @staticmethod
    def associated_class() -> type[CavTaskClass]:
        """Return the class of the results of `get_task`."""
        return CavTaskClass

    def get_from_yaml(self, path: str | None = None) -> CavTaskClass:
        """Return the task with the defaults of its entry, or with the arguments in a YAML file."""
        if path is None:
            return CavTaskClass(self.name)
        found: CavTaskClass = super().get_from_yaml(path)
        return found
