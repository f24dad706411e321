"""RLlib's `MultiAgentEnv`, for its new API stack.

Importing this module loads Ray and RLlib; `import cavmarl` does not import it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from cavmarl.core.errors import missing
from cavmarl.env.limit_agents import LimitAgents
from cavmarl.env.parallel import parallel_env
from cavmarl.env.roadside_agents import VEHICLES, RoadsideAgents
from cavmarl.env.signal_agents import SignalAgents
from cavmarl.env.world_copies import OwnWorlds

try:
    from ray.rllib.env.multi_agent_env import MultiAgentEnv
except ModuleNotFoundError as error:
    raise missing(error.name, "rllib") from error

Step = tuple[
    dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]

# Keys of a signal's observation, as RLlib's `ActionMaskingTorchRLModule` expects them.
ACTION_MASK, OBSERVATIONS = "action_mask", "observations"


def policy_of(agent: str, episode: object = None, worker: object = None) -> str:
    """Return the policy of an agent by its kind: `vehicles`, `signals` or `limits`.

    A `policy_mapping_fn` for one policy per kind of agents; RLlib's other arguments are not read.
    """
    for kind in (SignalAgents, LimitAgents):
        if agent.startswith(kind.prefix):
            return kind.kind
    return VEHICLES


class CavRllibEnv(OwnWorlds, MultiAgentEnv):  # type: ignore[misc] # only installed separately
    """One world; `config` has the keyword arguments of `parallel_env`.

        PPOConfig().environment(CavRllibEnv, env_config={"env": "town", "agents": 25})

    Agents enter and leave in every population. All ids of an episode are declared in advance, and
    an id that has ended does not return. The end of the episode (`__all__`) is a truncation if the
    horizon ended an agent's trip. RLlib ends an episode as soon as all agents known to it have
    ended, even if new agents enter in the same step. The next episode then continues the same world
    with the new agents.

    In `respawn` worlds an id gets one vehicle after another. `infos[agent]["vehicle_done"]` marks
    the end of a trip, but RLlib's value estimates continue across it. Learning is therefore more
    exact in `closed` and `open` worlds.

    Agents of signals act only when a decision is due: other steps have no observation,
    reward or info of signals. All signals have the same spaces, so that they can share a policy.
    The action space is `Discrete(G)`, where G is the largest number of choices of a signal. A
    choice that a signal does not have keeps its green. An observation has `action_mask` (G,) and
    `observations` (D,), padded with 0. The world advances until at least one agent is to act.

        PPOConfig().multi_agent(policies={"vehicles", "signals"}, policy_mapping_fn=policy_of)

    Each environment of an env runner has its own world, seeded by RLlib.

    Args:
        config: keyword arguments of `parallel_env`, from RLlib's `env_config`.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
    """

    def __init__(self, config: Mapping[str, Any] | None = None) -> None:
        self._env = parallel_env(**(config or {}))
        self.agents: list[str] = []
        self.observation_spaces = dict(self._env.observation_spaces)
        self.action_spaces = dict(self._env.action_spaces)
        world = self._env.config
        self._roadside = self._env.roadside
        self.possible_agents = [
            agent
            for agent in self._env.possible_agents
            if world.population.agents or self._is_roadside(agent)
        ]
        if self._roadside is not None:
            self._pad_spaces(self._roadside)
        self.render_mode = self._env.render_mode
        self._entered: tuple[dict[str, Any], dict[str, Any]] | None = None
        super().__init__()

    def _is_roadside(self, agent: str) -> bool:
        return self._roadside is not None and agent in self._roadside

    def _pad_spaces(self, roadside: RoadsideAgents) -> None:
        """Give all signals the spaces of the largest one."""
        most = roadside.most_choices
        mask = spaces.Box(0.0, 1.0, (most,), np.float32)
        seen = spaces.Dict({ACTION_MASK: mask, OBSERVATIONS: roadside.padded_observation_space})
        self.observation_spaces |= dict.fromkeys(roadside.agents, seen)
        self.action_spaces |= dict.fromkeys(roadside.agents, spaces.Discrete(most))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; without a seed, continue the world if agents have just entered."""
        if self._entered is None or seed is not None:
            observations, infos = self._env.reset(seed=seed, options=options)
            self._entered = self._padded(observations), infos
        (observations, infos), self._entered = self._entered, None
        self.agents = self._env.agents
        return observations, infos

    def step(self, action_dict: Mapping[str, Any]) -> Step:
        """Run one step with the actions of all agents that act."""
        known, step = set(self.agents), self._step(action_dict)
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

    def _step(self, actions: Mapping[str, Any]) -> Step:
        """Run steps until an agent acts next; return the results of agents that act or have left.

        Without agents of signals, this is one step.
        """
        step = self._shown(self._env.step(self._own_choices(actions)))
        while self._nobody_acts():
            step = _joined(step, self._shown(self._env.step({})))
        return step

    def _nobody_acts(self) -> bool:
        """Whether the world has no vehicles of agents, and no decision is due."""
        roadside = self._roadside
        return (
            roadside is not None
            and len(self._env.agents) == len(roadside.agents)
            and not roadside.view.decides[0]
        )

    def _own_choices(self, actions: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the actions; choices that a signal does not have keep its green."""
        roadside = self._roadside
        if roadside is None:
            return actions
        choices = np.array([[actions.get(agent, 0) for agent in roadside.agents]])
        own = dict(zip(roadside.agents, roadside.keep_beyond(choices)[0], strict=True))
        return {agent: own.get(agent, action) for agent, action in actions.items()}

    def _shown(self, step: Step) -> Step:
        """Return the results without signals that neither decide next nor end."""
        roadside = self._roadside
        if roadside is None:
            return step
        observations, rewards, ended, cut, infos = step
        if not (roadside.view.decides[0] or cut[roadside.agents[0]]):
            vehicles = [agent for agent in observations if agent not in roadside]
            observations, rewards, ended, cut, infos = (_only(vehicles, part) for part in step)
        return self._padded(observations), rewards, ended, cut, infos

    def _padded(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Return the observations; for signals, padded and with their action masks."""
        roadside = self._roadside
        if roadside is None:
            return observations
        masks, seen = roadside.view.masks[0], roadside.view.observations[0]
        return observations | {
            agent: {ACTION_MASK: masks[s].astype(np.float32), OBSERVATIONS: seen[s].copy()}
            for s, agent in enumerate(roadside.agents)
            if agent in observations
        }

    def render(self) -> Any:
        """Draw the world; see `CavEnv.render`."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment; see `CavEnv.close`."""
        self._env.close()


def _only(agents: Collection[str], part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of some agents."""
    return {agent: value for agent, value in part.items() if agent in agents}


def _joined(first: Step, second: Step) -> Step:
    """Return the results of two steps; for an id in both, the second result counts."""
    observations, rewards, ended, cut, infos = first
    more = second
    return (
        observations | more[0],
        rewards | more[1],
        ended | more[2],
        cut | more[3],
        infos | more[4],
    )
