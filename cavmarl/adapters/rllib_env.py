"""RLlib's `MultiAgentEnv`, for its new API stack.

Importing this module loads Ray and RLlib; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from cavmarl.core.errors import missing
from cavmarl.env.parallel import parallel_env
from cavmarl.env.world_copies import OwnWorlds

try:
    from ray.rllib.env.multi_agent_env import MultiAgentEnv
except ModuleNotFoundError as error:
    raise missing(error.name, "rllib") from error

Step = tuple[
    dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, float]]
]


class CavRllibEnv(OwnWorlds, MultiAgentEnv):  # type: ignore[misc] # only installed separately
    """One world; `config` has the keyword arguments of `parallel_env`.

        PPOConfig().environment(CavRllibEnv, env_config={"env": "town", "agents": 25})

    Agents enter and leave in every population. All ids of an episode are declared in advance, and
    an id that has ended does not return. The end of the episode (`__all__`) is a truncation if the
    horizon cut an agent. RLlib ends an episode as soon as all agents known to it have ended, even
    if new agents enter in the same step. The next episode then continues the same world with the
    new agents.

    In `respawn` worlds an id is a seat: its vehicle ends with `infos[agent]["vehicle_done"]`, but
    RLlib's value estimates continue across it. Learning is therefore more exact in `closed` and
    `open` worlds.

    Each environment of an env runner has its own world, seeded by RLlib.

    Args:
        config: keyword arguments of `parallel_env`, from RLlib's `env_config`.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
    """

    def __init__(self, config: Mapping[str, Any] | None = None) -> None:
        self._env = parallel_env(**(config or {}))
        self.possible_agents = list(self._env.possible_agents)
        self.agents: list[str] = []
        self.observation_spaces = dict(self._env.observation_spaces)
        self.action_spaces = dict(self._env.action_spaces)
        self.render_mode = self._env.render_mode
        self._entered: tuple[dict[str, Any], dict[str, Any]] | None = None
        super().__init__()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; without a seed, continue the world if agents have just entered."""
        if self._entered is None or seed is not None:
            self._entered = self._env.reset(seed=seed, options=options)
        (observations, infos), self._entered = self._entered, None
        self.agents = self._env.agents
        return observations, infos

    def step(self, action_dict: Mapping[str, Any]) -> Step:
        """Run one step with the actions of all agents."""
        known, step = set(self.agents), self._env.step(action_dict)
        self.agents = self._env.agents
        if self.agents and known.isdisjoint(self.agents):
            observations, _, _, _, infos = (_only(self.agents, part) for part in step)
            self._entered = observations, infos
            observations, rewards, ended, cut, infos = (_only(known, part) for part in step)
            over = True
        else:
            observations, rewards, ended, cut, infos = step
            over = not self.agents
        at_horizon = over and any(cut.values())
        ends = {**ended, "__all__": over and not at_horizon}
        return observations, rewards, ends, {**cut, "__all__": at_horizon}, infos

    def render(self) -> Any:
        """Draw the world; see `CavEnv.render`."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment; see `CavEnv.close`."""
        self._env.close()


def _only(agents: Collection[str], part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of some agents."""
    return {agent: value for agent, value in part.items() if agent in agents}
