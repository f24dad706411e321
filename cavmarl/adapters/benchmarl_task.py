"""BenchMARL's tasks: every entry of `envs/`, through `cavmarl.adapters.torchrl_env`.

Importing this module loads BenchMARL and torch; nothing that `import cavmarl` loads imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cavmarl.adapters.observations import refuse_decided
from cavmarl.adapters.torchrl_env import GROUP, CavTorchRLEnv
from cavmarl.config.registry import load_config
from cavmarl.core.errors import missing

try:
    from benchmarl.environments.common import Task, TaskClass
    from torchrl.data import Composite
except ModuleNotFoundError as error:
    raise missing(error.name, "benchmarl") from error

DECIDED = ("num_envs", "device", "action.kind")


class CavTaskClass(TaskClass):  # type: ignore[misc] # found in an environment of its own only
    """One environment; BenchMARL says how many worlds, where, and which kind of action.

    In `respawn` worlds, the default, a seat whose vehicle ended gets a new one. BenchMARL's losses
    know no mask: they also count the steps in which an agent has no vehicle, whose observation and
    reward are 0. These are few in `respawn`, and many in `closed` and `open` worlds.

    Args:
        name: of the task; in lower case it is that of the environment, unless `config` has `env`.
        config: keywords of `CavTorchRLEnv`.

    Raises:
        ConfigError: a keyword that BenchMARL decides.
    """

    def __init__(self, name: str, config: Mapping[str, Any] | None = None) -> None:
        super().__init__(name, {"env": name.lower(), **(config or {})})
        refuse_decided(DECIDED, self.config, self.config.get("overrides"))

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], CavTorchRLEnv]:
        """What makes `num_envs` worlds."""
        overrides = {
            "population.mode": "respawn",
            **self.config.get("overrides", {}),
            "action.kind": "continuous" if continuous_actions else self._choices,
        }
        arguments = {**self.config, "overrides": overrides, "num_envs": num_envs, "device": device}

        def make() -> CavTorchRLEnv:
            worlds = CavTorchRLEnv(**arguments)
            worlds.set_seed(seed)
            return worlds

        return make

    @property
    def _choices(self) -> str:
        """The kind of action with choices that the environment has; without one: meta-actions."""
        kind = load_config(self.config["env"])[0].action.kind
        return "discrete" if kind == "continuous" else kind

    def supports_continuous_actions(self) -> bool:
        """Throttle and steering."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Meta-actions, or the grid of an environment that has one."""
        return True

    def max_steps(self, env: CavTorchRLEnv) -> int:
        """Steps to the horizon."""
        return int(env.max_cycles)

    def has_render(self, env: CavTorchRLEnv) -> bool:
        """Batches of worlds are not drawn."""
        return False

    def group_map(self, env: CavTorchRLEnv) -> dict[str, list[str]]:
        """All agents are of one group."""
        return dict(env.group_map)

    def observation_spec(self, env: CavTorchRLEnv) -> Composite:
        """Of one world: what its agents observe."""
        return self._of_agents(env, "observation")

    def info_spec(self, env: CavTorchRLEnv) -> Composite:
        """Of one world: its agents' terms, by name."""
        return self._of_agents(env, "info")

    def state_spec(self, env: CavTorchRLEnv) -> None:
        """None: central critics read the observations of all agents."""

    def action_spec(self, env: CavTorchRLEnv) -> Composite:
        """Of one world."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: CavTorchRLEnv) -> None:
        """None: every agent can do everything."""

    @staticmethod
    def env_name() -> str:
        """What BenchMARL calls the environments together."""
        return "cavmarl"

    @staticmethod
    def _of_agents(env: CavTorchRLEnv, part: str) -> Composite:
        """The spec of one world that has only this part of what the agents are told."""
        spec = env.full_observation_spec_unbatched.clone()
        for other in set(spec[GROUP].keys()) - {part}:
            del spec[GROUP, other]
        return spec


class CavTask(Task):  # type: ignore[misc] # found in an environment of its own only
    """The entries of `envs/`; `CavTaskClass` takes other folders and maps."""

    GRID4X4 = None
    MERGE = None
    RING = None
    RUSH = None
    TOWN = None

    @staticmethod
    def associated_class() -> type[CavTaskClass]:
        """What `get_task` makes."""
        return CavTaskClass

    def get_from_yaml(self, path: str | None = None) -> CavTaskClass:
        """The task as its entry describes it, or with the keywords of a YAML file."""
        if path is None:
            return CavTaskClass(self.name)
        found: CavTaskClass = super().get_from_yaml(path)
        return found
