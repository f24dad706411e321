"""`CavEnv`: one world as a PettingZoo parallel environment, on top of the batched simulation."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import compress
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from cavmarl.core.errors import ActionError, ConfigError, EpisodeError
from cavmarl.core.seeds import check_seed
from cavmarl.engine.spaces import (
    STATE_FEATURES,
    action_space,
    observation_spaces,
    state_space,
)
from cavmarl.env.actions import LENIENT
from cavmarl.env.agent_dicts import AgentDicts, Listed, Observation
from cavmarl.env.drawn_worlds import RENDER_MODES
from cavmarl.env.external_agents import ExternalAgents
from cavmarl.env.step_session import StepSession
from cavmarl.env.world_arguments import WorldArguments, start_worlds
from cavmarl.env.worlds_environment import WorldsEnvironment
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.shards.shard import Commands

Stepped = tuple[
    dict[str, Observation],
    dict[str, float],
    dict[str, bool],
    dict[str, bool],
    dict[str, dict[str, Any]],
]


def parallel_env(
    env: str | Path = "merge", *, lenient: bool = False, **world: Unpack[WorldArguments]
) -> CavEnv:
    """Make a PettingZoo parallel environment.

    Args:
        env: name of an entry of `envs/`, a folder with an env.yaml, a map file, or a .sumocfg.
        lenient: whether to clip values out of range, ignore actions of absent agents, and repeat an
            agent's last action (or 0) if its action is missing, as some libraries need. Sets
            action.out_of_range, .late_actions, .missing_action; traffic_stats() counts the cases.
        world: zones, zone_simulators, backend, workers, nodes, sensor_workers, agents, background,
            seed, max_cycles, sensors_of, render_mode, record and overrides, as `WorldArguments`
            describes them.

    Raises:
        ConfigError: a key, a value or a combination is not possible.
        PolicyError: `sensors_of` is not a trained driver.
        MapError: the map cannot be read, or vehicles cannot drive on it.
        WorkerError: worker processes cannot be started, or have too little memory.
        MissingExtraError, RecordingError: Ray or pyarrow is missing; `record` cannot be written.
    """
    overrides = world.get("overrides")
    if lenient and isinstance(overrides, Mapping | None):
        world["overrides"] = {**LENIENT, **(overrides or {})}
    worlds = start_worlds(env, 1, True, RENDER_MODES, **world)
    made = CavEnv(worlds, seed=world.get("seed"), render_mode=world.get("render_mode"))
    made.record(world.get("record"))
    return made


def _flags(agents: list[str], flags: NDArray[np.bool_]) -> dict[str, bool]:
    """Return one flag per agent; fast if no flag is set, as in most steps."""
    if not flags.any():
        return dict.fromkeys(agents, False)
    return dict(zip(agents, flags.tolist(), strict=True))


class CavEnv(WorldsEnvironment, ParallelEnv[str, Any, Any]):  # type: ignore[misc] # PettingZoo is not typed
    """One world as a PettingZoo parallel environment.

    docs/reference/environments.md describes observations, actions and rewards. The info of each
    agent holds every term by its name, and `active` (the agent has a vehicle), `vehicle_done` (that
    vehicle's trip ended in this step) and `vehicle_id`. All values are plain numbers.

    The world runs in this process, or its zones run in worker processes. Results are the same bit
    for bit (docs/guides/divide_a_world.md).

    Args:
        worlds: a `SteppedWorlds` with one world, made with `in_next_step=True`, so that the world
            does not reset within the step that ends an episode. `reset` begins its next episode.
        seed: seed of the first reset if that call has none.
        render_mode: `human`, `rgb_array` or None.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo declares it as an instance's attribute
        "name": "cavmarl",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self, worlds: SteppedWorlds, *, seed: int | None = None, render_mode: str | None = None
    ) -> None:
        super().__init__(
            StepSession(worlds, seed=None if seed is None else check_seed(seed)), render_mode
        )
        config = self.config
        self.metadata = {**type(self).metadata, **self.metadata}
        self.ghosts_of: int | None = None
        one_action, cars = action_space(config.action), self.possible_agents
        self.observation_spaces: dict[str, spaces.Space[Any]] = {**observation_spaces(config, cars)}
        self.action_spaces: dict[str, spaces.Space[Any]] = dict.fromkeys(cars, one_action)
        self._roadside = self._session.roadside
        if self._roadside is not None:
            self.possible_agents = [*cars, *self._roadside.agents]
            self.observation_spaces |= self._roadside.observation_spaces()
            self.action_spaces |= self._roadside.action_spaces()
        self._visitors: ExternalAgents | None = None
        if config.population.external_agents:
            self._visitors = ExternalAgents(self._session)
            self.possible_agents = [*self.possible_agents, *self._visitors.ids]
            self.observation_spaces |= self._visitors.observation_spaces()
            self.action_spaces |= self._visitors.action_spaces()
        self.state_space = state_space(worlds.arrays.states.shape[1] // STATE_FEATURES)
        self._dicts = AgentDicts(config)
        self._seats = config.population.mode == "respawn"
        self._max_cycles = config.max_steps
        self._steps = 0
        self._rows: NDArray[np.intp]
        self._listed: Listed  # the same rows as an index, a slice if possible
        self._list(np.zeros(0, dtype=np.intp))
        self.agents: list[str] = []

    @property
    def max_cycles(self) -> int:
        """Steps until truncation; can be set from 1 to the number given to `parallel_env`.

        Raises:
            ConfigError: the number is outside of this range.
        """
        return self._max_cycles

    @max_cycles.setter
    def max_cycles(self, steps: int) -> None:
        most = self.config.max_steps
        if not isinstance(steps, int | np.integer) or not 1 <= steps <= most:
            raise ConfigError(
                f"max_cycles = {steps!r}: must be a whole number from 1 to {most}, the horizon of "
                "the environment; for more, pass max_cycles to parallel_env"
            )
        self._max_cycles = int(steps)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space: the same object for all calls.

        All vehicles have the same space, unless `population.fleet` gives them different sensors.

        Raises:
            ActionError: there is no such agent.
        """
        try:
            return self.observation_spaces[agent]
        except (KeyError, TypeError):
            raise self._no_agent(agent) from None

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the action space: the same object for all vehicles and calls.

        Raises:
            ActionError: there is no such agent.
        """
        try:
            return self.action_spaces[agent]
        except (KeyError, TypeError):
            raise self._no_agent(agent) from None

    def _is_roadside(self, agent: str) -> bool:
        return self._roadside is not None and agent in self._roadside

    def _no_agent(self, agent: object) -> ActionError:
        first, last = self.possible_agents[0], self.possible_agents[-1]
        return ActionError(f"no agent {agent!r}: the ids are {first} … {last} (possible_agents)")

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode.

        Args:
            seed: seed of all random numbers; None begins the next episode of the last seed.
            options: not used; the API requires it.

        Raises:
            EpisodeError: after `close`.
        """
        self._session.reset(seed, np.ones(1, dtype=np.bool_))
        self._steps = 0
        if self._visitors is not None:
            self._visitors.reset()
        self._list(np.flatnonzero(self.worlds.arrays.mask[0] | self._seats))
        if not self.agents:
            self._wait_for_agents()
        return self._observations(), self._infos()

    def step(self, actions: Mapping[str, Any]) -> Stepped:
        """Let every agent act, and advance the world by `step_s` seconds.

        The results include agents that enter during the step, with reward 0. When all agents have
        left and more are still to enter, the world advances until one enters.

        Raises:
            EpisodeError: before the first reset, after `close`, or there are actions after all
                agents have left.
            ActionError: an action is invalid. Nothing has changed, and the step can be repeated.
        """
        self._session.refuse_idle("step()")
        if not self.agents:
            if actions and self.config.action.late_actions == "error":
                raise EpisodeError("the episode is over: call env.reset()")
            return {}, {}, {}, {}, {}
        active = self.worlds.arrays.mask[0, self._listed]
        needed = self._cars if active.all() else list(compress(self._cars, active.tolist()))
        choices = None
        if self._roadside is not None and isinstance(actions, Mapping):
            choices = self._roadside.from_dict(actions)
            actions = {
                agent: each for agent, each in actions.items() if agent not in self._roadside
            }
        visitors, driven = self._visitors, {}
        if visitors is not None and isinstance(actions, Mapping):
            driven = {agent: each for agent, each in actions.items() if agent in visitors}
            actions = {agent: each for agent, each in actions.items() if agent not in visitors}
            if self.config.action.late_actions != "error":
                driven = {agent: driven[agent] for agent in visitors.shown if agent in driven}
            visitors.check_all(driven)
        commands = self._session.decoder.from_dict(actions, self._cars, needed)
        visited: list[str] = []
        if visitors is not None:
            visited = visitors.shown
            visitors.drive(driven)
        self._advance(commands, choices)
        return self._report(visited)

    def _advance(self, commands: Commands, choices: NDArray[np.int64] | None = None) -> None:
        """Advance the world by a step, then update the sensors of external vehicles."""
        if self._visitors is not None:
            self._visitors.prepare()
        self._session.step(commands, choices)
        self._steps += 1
        if self._visitors is not None:
            self._visitors.sense()

    def _report(self, visited: list[str]) -> Stepped:
        """Return the results of a step, and drop the agents that have left.

        `visited`: ids of the observing external vehicles before the step.
        """
        arrays, truncated = self.worlds.arrays, self._steps >= self.max_cycles
        if not truncated:
            entered = arrays.vehicle_ids[0] >= 0
            entered[self._listed] = False
            if entered.any():
                self._list(np.concatenate([self._rows, np.flatnonzero(entered)]))
        shown = self._cars
        ended = arrays.terminations[0, self._listed] & (not self._seats)
        if self._visitors is not None:
            self._list(self._rows)
        observations, infos = self._observations(), self._infos()
        rewards = dict(zip(shown, arrays.rewards[0, self._listed].tolist(), strict=True))
        late = ended & arrays.truncations[0, self._listed]
        terminations = _flags(shown, ended & ~late)
        truncations = _flags(shown, late | (~ended & truncated))
        if self._roadside is not None:
            rewards |= zip(self._roadside.agents, arrays.signal_rewards[0].tolist(), strict=True)
            terminations |= dict.fromkeys(self._roadside.agents, False)
            truncations |= dict.fromkeys(self._roadside.agents, truncated)
        if self._visitors is not None:
            left = [agent for agent in visited if agent not in self._visitors.shown]
            observations |= self._visitors.observations(left)
            infos |= self._visitors.infos(left)
            agents = [*left, *self._visitors.shown]
            rewards |= dict.fromkeys(agents, 0.0)
            terminations |= {agent: agent in left for agent in agents}
            truncations |= dict.fromkeys(agents, truncated)
        if truncated:
            self._list(self._rows[:0])
            self.agents.clear()
        elif ended.any():
            self._list(self._rows[~ended])
        if not self.agents and not truncated:
            self._wait_for_agents()
            observations |= self._observations()
            infos |= self._infos()
            rewards |= dict.fromkeys(self.agents, 0.0)
            terminations |= dict.fromkeys(self.agents, False)
            truncations |= dict.fromkeys(self.agents, False)
        if self.render_mode == "human":
            self.render()
        return observations, rewards, terminations, truncations, infos

    def _list(self, rows: NDArray[np.intp]) -> None:
        """Set the agents in the episode, given by their index."""
        self._rows = rows
        self._cars = [self.possible_agents[k] for k in rows.tolist()]
        self.agents = (
            self._cars if self._roadside is None else [*self._cars, *self._roadside.agents]
        )
        if self._visitors is not None:
            self.agents = [*self.agents, *self._visitors.shown]
        # A slice takes agents in their usual order without a copy.
        in_order = bool((rows == np.arange(rows.size)).all())
        self._listed = slice(rows.size) if in_order else rows

    def _wait_for_agents(self) -> None:
        """Advance an empty world until an agent enters, or until the horizon."""
        arrays = self.worlds.arrays
        while not arrays.episode_over[0] and self._steps < self._max_cycles:
            self._advance(self._session.decoder.idle())
            if arrays.mask.any():
                self._list(np.flatnonzero(arrays.mask[0]))
                break

    def _observations(self) -> dict[str, Observation]:
        found = self._dicts.observations(self.worlds.arrays, self._cars, self._listed)
        if self._visitors is not None:
            found |= self._visitors.observations(self._visitors.shown)
        return found if self._roadside is None else {**found, **self._roadside.observations()}

    def _infos(self) -> dict[str, dict[str, Any]]:
        found = self._dicts.infos(self.worlds.arrays, self._cars, self._listed)
        if self._visitors is not None:
            found |= self._visitors.infos(self._visitors.shown)
        return found if self._roadside is None else {**found, **self._roadside.infos()}

    def declare_event(self, agent: str, cause: str) -> None:
        """Let an agent's vehicle announce an event in the next step (docs/reference/v2x.md).

        Args:
            agent: id of an agent with a vehicle.
            cause: `collision`, `obstacle`, `stationary` or `hard_braking`.

        Raises:
            ActionError: there is no such agent, or it has left.
            ConfigError: there is no such cause, or this environment sends no messages.
        """
        if agent not in self._cars:
            raise ActionError(
                f"declare_event({agent!r}, …): not in the episode; give an id of a vehicle from "
                "env.agents"
            )
        self._session.events.declare(0, self.possible_agents.index(agent), cause)

    def frames(self, agent: str) -> dict[str, SensorFrames]:
        """Return the samples of the last step of each sensor of an agent's `rig`, by sensor name.

        The arrays are as in `SensorFrames`, without the axes of worlds and agents.

        Raises:
            ActionError: there is no such agent, or it is a signal or a roadside unit, which has no
                sensors.
        """
        if agent not in self.possible_agents:
            raise self._no_agent(agent)
        if self._is_roadside(agent):
            raise ActionError(
                f"frames({agent!r}): signals and roadside units have no sensors; give a vehicle's "
                "id"
            )
        if self._visitors is not None and agent in self._visitors:
            return self._visitors.frames_of(self._visitors.ids.index(agent))
        k = self.possible_agents.index(agent)
        return {name: sensor.of(0, k) for name, sensor in self.worlds.arrays.frames.items()}

    def check_action(self, agent: str, action: Any) -> None:
        """Raise the error that `step` would raise for an action, without acting.

        Raises:
            ActionError: the shape, the dtype or a value is wrong.
        """
        if self._roadside is not None and agent in self._roadside:
            self._roadside.check(agent, action)
        elif self._visitors is not None and agent in self._visitors:
            self._visitors.check(agent, action)
        else:
            self._session.decoder.check(agent, action)

    def state(self) -> NDArray[np.float32]:
        """Return the global state, within `state_space`: see `engine.spaces.global_state`.

        Raises:
            EpisodeError: before the first reset, or after `close`.
        """
        self._session.refuse_idle("state()")
        self.worlds.write_states()
        state: NDArray[np.float32] = self.worlds.arrays.states[0].copy()
        return state

    def state_hash(self) -> str:
        """Return a hex digest of all vehicles in id order, signals, the queue and random keys."""
        return self.worlds.state_hash(0)

    def traffic_stats(self) -> dict[str, float]:
        """Return traffic counts since the reset: departed, arrived, contacts, mean speed and more.

        The keys are the fields of `engine.traffic_stats.TrafficStats`, and the numbers of actions
        that were clipped, held and ignored.
        """
        return {**self.worlds.traffic_stats(0), **self._session.decoder.tolerated()}

    def suggest_actions(self) -> dict[str, Any]:
        """Return what the built-in driver (IDM, MOBIL, lane controller) would do for each agent.

        Raises:
            EpisodeError: before the first reset, or after `close`.
        """
        self._session.refuse_idle("suggest_actions()")
        self.worlds.suggest()
        batch = self._session.decoder.encode(self.worlds.arrays.suggested)[0]
        found: dict[str, Any] = dict(zip(self._cars, batch[self._rows], strict=True))
        if self._roadside is not None:
            choices = np.maximum(self._roadside.suggest()[0], 0).tolist()
            found |= zip(self._roadside.agents, choices, strict=True)
        return found

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame (height, width, 3) for `rgb_array`; for `human`, show a window.

        A divided world is shown with its zones and owners. If `ghosts_of` is set to a zone, its
        ghosts of other zones' vehicles are shown. Without a render_mode: None, and a warning.

        Raises:
            ConfigError: there is no zone of that number.
            EpisodeError: before the first reset.
        """
        return self._picture(0, self.ghosts_of)

    def close(self) -> None:
        """Close the window and the recording, and end the worker processes, if there are any.

        Afterwards, `reset` and `step` raise an EpisodeError.
        """
        self._session.close()
