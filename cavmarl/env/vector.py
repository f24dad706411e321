"""`CavVectorEnv`: many worlds that are stepped together, with arrays in and out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.plan_text import describe_plan
from cavmarl.core.errors import ActionError, ConfigError, EpisodeError
from cavmarl.engine.spaces import (
    action_space,
    flat_observation_space,
    frames_space,
    sensed_observation,
)
from cavmarl.env.autoreset import known_mode, present_mode, refuse_over, with_rows
from cavmarl.env.roadside_agents import VEHICLES, RoadsideAgents
from cavmarl.env.saved_state import load_session, save_session
from cavmarl.env.step_session import StepSession
from cavmarl.env.world_arguments import WorldArguments, start_worlds
from cavmarl.env.worlds_environment import WorldsEnvironment
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.sensors.mounted.frames import SensorFrames

MAX_WORLDS = 65_536

Observations: TypeAlias = Any
"""(W, A, D) float32, or for each sensor of the rig an array (W, A, …)."""

# With agents of signals or limits, the first four items are dicts with the keys `vehicles`, and
# `signals` or `limits`.
StepResult = tuple[Observations, Any, Any, Any, dict[str, Any]]


def make_vec(
    env: str | Path = "merge",
    *,
    num_envs: int = 1,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    copy: bool = True,
    **world: Unpack[WorldArguments],
) -> CavVectorEnv:
    """Make `num_envs` worlds of one environment that are stepped together.

    Args:
        env: name of an entry of `envs/`, a folder with an env.yaml, a map file, or a .sumocfg.
        num_envs: number of worlds.
        autoreset_mode: when a world begins its next episode; see `CavVectorEnv`.
        copy: False returns observations without a copy; see `CavVectorEnv`.
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
    num_envs, mode = _checked(num_envs), known_mode(autoreset_mode)
    in_next_step = mode is not AutoresetMode.SAME_STEP
    modes = ("rgb_array",)
    worlds = start_worlds(env, num_envs, in_next_step, modes, may_be_alone=True, **world)
    made = CavVectorEnv(
        worlds,
        seed=world.get("seed"),
        copy=copy,
        disabled=mode is AutoresetMode.DISABLED,
        render_mode=world.get("render_mode"),
    )
    made.record(world.get("record"))
    return made


def _checked(num_envs: int) -> int:
    is_number = isinstance(num_envs, (int, np.integer)) and not isinstance(num_envs, bool)
    if not (is_number and 1 <= num_envs <= MAX_WORLDS):
        raise ConfigError(f"num_envs = {num_envs!r}: must be a whole number from 1 to {MAX_WORLDS}")
    return int(num_envs)


class CavVectorEnv(WorldsEnvironment):
    """W worlds with A agents each, as arrays of the shape (num_envs, num_agents, …).

    Observations are flat arrays. With `observation.mode: sensors` and `observation.kind: dict`
    they are dicts with an array (num_envs, num_agents, …) for each sensor of the rig.

    `infos["mask"]` marks the agents that have a vehicle and act in the next step. Observations of
    the other agents are 0, and their actions are not read. The episode of a world is over if it was
    truncated, or if all agents have left and none is still to enter. The world then begins its next
    episode according to Gymnasium's `AutoresetMode`:

    - `SAME_STEP`: in the same step. The step returns the first observations of the new episode.
      `infos["final_observations"]` has the last ones of the old episode and of agents that left.
    - `NEXT_STEP`: in the next step. The step returns the last observations, also of agents that
      leave. The next step does not read the world's actions, and returns rewards of 0 and the first
      observations of the new episode.
    - `DISABLED`: never by itself. Before the next step, call
      `reset(options={"reset_mask": infos["episode_over"]})`. Steps return the same
      observations as with `NEXT_STEP`.

    Worlds run in this process or in other processes, with the same results bit for bit
    (docs/guides/divide_a_world.md).

    Args:
        worlds: the worlds to step.
        seed: seed of the first reset if that call has none.
        copy: False returns observations as a read-only view that the next step or reset overwrites.
            Copying large observations takes longer than computing them.
        disabled: mode `DISABLED`; `worlds` must be worlds that reset in the next step.
        render_mode: `rgb_array` or None.
    """

    def __init__(
        self,
        worlds: SteppedWorlds,
        *,
        seed: int | None = None,
        copy: bool = True,
        disabled: bool = False,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(StepSession(worlds, in_place=True, seed=seed), render_mode)
        config, form = self.config, self.config.observation
        self.num_envs = num_envs = len(worlds.arrays.mask)
        self.num_agents = len(self.possible_agents)
        self._senses = form.mode == "sensors" and form.kind == "dict"
        self.single_observation_space: Any = (
            frames_space(config) if self._senses else flat_observation_space(config)
        )
        self.single_action_space = action_space(config.action)
        self.observation_space = batch_space(
            batch_space(self.single_observation_space, self.num_agents), num_envs
        )
        self.action_space = batch_space(
            batch_space(self.single_action_space, self.num_agents), num_envs
        )
        if self._session.roadside is not None:
            self._add_roadside(self._session.roadside)
        self.metadata |= {
            "autoreset_mode": present_mode(worlds.in_next_step, disabled),
            "render_modes": ["rgb_array"],
        }
        self._disabled = disabled
        self._over = np.zeros(num_envs, dtype=np.bool_)  # over, and not yet reset
        self._mask = np.zeros((num_envs, self.num_agents), dtype=np.bool_)
        self._copy = copy

    def _add_roadside(self, agents: RoadsideAgents) -> None:
        """Add the spaces of roadside agents, padded to the largest one."""
        counts = agents.num_choices.astype(np.int64)
        choices = np.broadcast_to(counts, (self.num_envs, len(counts)))
        seen = batch_space(agents.padded_observation_space, len(counts))
        self.observation_space = spaces.Dict(
            {VEHICLES: self.observation_space, agents.kind: batch_space(seen, self.num_envs)}
        )
        self.action_space = spaces.Dict(
            {VEHICLES: self.action_space, agents.kind: spaces.MultiDiscrete(choices.copy())}
        )

    @property
    def max_cycles(self) -> int:
        """Steps until truncation."""
        return self.config.max_steps

    @property
    def carriers(self) -> dict[str, NDArray[np.bool_]]:
        """(A,) the agents that carry each sensor of `rig`; the frames of the others are 0."""
        return {name: self.config.population.carriers(name) for name in self.config.rig}

    @property
    def state_size(self) -> int:
        """Length of the global state of a world."""
        return int(self.worlds.arrays.states.shape[1])

    @property
    def simulated_s(self) -> float:
        """Wall time of all steps so far, without decoding actions and copying results."""
        return self._session.simulated_s

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Assignments of worlds, or of each world's zones, to workers; empty without workers.

        See docs/explanation/balance.md. If worlds or zones move, this is the current assignment.
        """
        return self.worlds.plans

    def plan_text(self) -> str:
        """Return the plans as tables; each full reset logs them (`cavmarl.workers`, INFO)."""
        return "\n\n".join(map(describe_plan, self.plans))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, NDArray[Any]]]:
        """Begin an episode in all worlds, or in some of them.

        Args:
            seed: seed of all random numbers; episodes of world w depend on (seed, w) alone. None
                begins the next episodes of the last seed.
            options: `first_world` (with a seed): number of the first world, to run many worlds in
                several parts. `reset_mask` (without a seed): (W,) the worlds that begin an episode;
                the other worlds do not change. Other options are ignored.

        Returns:
            observations (W, A, D) and infos.

        Raises:
            ConfigError: reset_mask has another shape or dtype, or is given with a seed.
            EpisodeError: after `close`, or reset_mask is given before the first reset.
        """
        options = options or {}
        chosen = self._chosen(options.get("reset_mask"), seed)
        first_world = int(options.get("first_world", 0))
        self._session.reset(seed, chosen, first_world)
        self._mask = self.worlds.arrays.mask.copy()
        self._over = self._over & ~chosen
        infos = {"mask": self._mask.copy()}
        if self._session.roadside is not None:
            infos |= self._session.roadside.infos_of_worlds()
        return self._observations(), infos

    def _chosen(self, reset_mask: Any, seed: int | None) -> NDArray[np.bool_]:
        """Return the worlds (W,) that a reset affects."""
        if reset_mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        chosen = np.asarray(reset_mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_:
            raise ConfigError(
                f"reset_mask has shape {chosen.shape} and dtype {chosen.dtype}: must be "
                f"({self.num_envs},) and bool, one value per world"
            )
        if seed is not None:
            raise ConfigError(
                "reset_mask with a seed: a seed applies to all worlds; leave one of the two out"
            )
        if not self._session.is_ready:
            raise EpisodeError("reset_mask before the first reset: call vec.reset(seed=…)")
        return chosen

    def step(self, actions: Any) -> StepResult:
        """Let every agent of every world act.

        Args:
            actions: (W, A, 2) floats in [-1, 1], or (W, A) meta-actions. Not read where the mask is
                False. With agents of signals, a dict: `vehicles`, and `signals` (W, S).

        Returns:
            observations (W, A, D), rewards (W, A), terminations (W, A): the vehicle's trip ended;
            truncations (W, A): the horizon of the episode or of the trip was reached; and infos:
            `mask` (W, A) agents that act next; `acted` (W, A) agents that acted in this step, so
            their rewards count; `vehicle_done` (W, A) agents whose vehicle's trip ended for any
            reason; `terms` (W, A, T) in the order of `TermsConfig.names`; `arrivals` (W,) vehicles
            that reached their goal since the reset, agents included; `episode_over` (W,) worlds
            whose episode is over;
            `final_observations` (W, A, D) observations before a reset, including the last ones of
            agents that left: the same array as the observations if no agent left in the step.

            With agents of signals, observations, rewards, terminations and truncations are dicts:
            `vehicles`, and `signals` (W, S, …). Their infos are `signal_mask` (W, S, G) allowed
            choices, `signal_decides` (W,) whether the next choices count, `signal_terms`
            (W, S, T) and `signal_refused` (W, S) choices of the episode that were not allowed.
            With agents of speed limits, the names have `limits` and `limit_` instead.

        Raises:
            EpisodeError: before the first reset, after `close`, or with `DISABLED` if a world's
                episode is over.
            ActionError: the shape, the dtype or a value is wrong; nothing has changed.
        """
        self._session.refuse_idle("step()")
        if self._disabled:
            refuse_over(self._over)
        session = self._session
        choices = None
        if session.roadside is not None:
            actions, choices = self._split(actions, session.roadside)
        session.step(session.decoder.from_array(actions, self._mask), choices)
        arrays = self.worlds.arrays
        over = self._over = arrays.episode_over.copy()
        terminations = arrays.terminations.copy()
        observations = final_observations = self._observations()
        if np.count_nonzero(over) or np.count_nonzero(terminations):
            final_observations = self._final_observations(over | terminations.any(axis=1))
            session.forget(over)
        self._mask = arrays.mask.copy()
        infos: dict[str, NDArray[Any]] = {
            "acted": arrays.acted.copy(),
            "terms": arrays.terms.copy(),
            "vehicle_done": arrays.vehicle_done.copy(),
            "final_observations": final_observations,
            "arrivals": arrays.arrivals.copy(),
            "mask": self._mask.copy(),
            "episode_over": over.copy(),
        }
        terminations &= ~arrays.truncations  # a trip that reaches its own horizon is truncated
        rewards, truncations = arrays.rewards.copy(), arrays.truncations.copy()
        roadside = session.roadside
        if roadside is None:
            return observations, rewards, terminations, truncations, infos
        over_all = over[:, None].repeat(len(roadside.agents), axis=1)
        return (
            observations,
            {VEHICLES: rewards, roadside.kind: arrays.signal_rewards.copy()},
            {VEHICLES: terminations, roadside.kind: np.zeros_like(over_all)},
            {VEHICLES: truncations, roadside.kind: over_all},
            infos | roadside.infos_of_worlds(),
        )

    def _split(self, actions: Any, roadside: RoadsideAgents) -> tuple[Any, NDArray[np.int64]]:
        """Return the actions of vehicles and the choices of roadside agents."""
        kind = roadside.kind
        if not isinstance(actions, Mapping) or actions.keys() - {VEHICLES, kind}:
            raise ActionError(
                f"with agents of {kind}, actions must be a dict with the keys 'vehicles' and "
                f"{kind!r}"
            )
        if kind not in actions or (VEHICLES not in actions and self.config.population.agents):
            raise ActionError(f"actions lack {kind if VEHICLES in actions else VEHICLES}")
        choices = roadside.from_array(actions[kind])
        idle = np.zeros_like(self.worlds.arrays.suggested)  # if no agents drive vehicles
        return actions.get(VEHICLES, self._session.decoder.encode(idle)), choices

    def _observations(self) -> Observations:
        found = self._vehicle_observations()
        roadside = self._session.roadside
        if roadside is None:
            return found
        return {VEHICLES: found, roadside.kind: self.worlds.arrays.signal_observations.copy()}

    def _vehicle_observations(self) -> Observations:
        arrays = self.worlds.arrays
        if not self._senses:
            return self._given(arrays.observations)
        left = arrays.terminations & ~arrays.episode_over[:, None]
        if self.worlds.in_next_step or not left.any():
            sensed = sensed_observation(arrays.frames)
            return {name: self._given(data) for name, data in sensed.items()}
        found = {name: data.copy() for name, data in sensed_observation(arrays.frames).items()}
        for data in found.values():
            data[left] = 0
        return found

    def _given(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a copy, or a read-only view."""
        if self._copy:
            return array.copy()
        view = array.view()
        view.flags.writeable = False
        return view

    def declare_event(self, world: int, agent: int, cause: str) -> None:
        """Let the vehicle of an agent, given by its index, announce an event in the next step.

        Args:
            world: number of the world.
            agent: index in `possible_agents`.
            cause: see `CavEnv.declare_event`.

        Raises:
            ActionError: there is no such agent.
            ConfigError: there is no such cause, or this environment sends no messages.
        """
        self._session.events.declare(world, agent, cause)

    def _final_observations(self, ended: NDArray[np.bool_]) -> Observations:
        """Return the observations; for worlds in `ended` (W,), from before the reset."""
        found, arrays = self._final_vehicle_observations(ended), self.worlds.arrays
        roadside = self._session.roadside
        if roadside is None:
            return found
        last, over = arrays.final_signal_observations, arrays.episode_over
        return {
            VEHICLES: found,
            roadside.kind: with_rows(arrays.signal_observations, last, over),
        }

    def _final_vehicle_observations(self, ended: NDArray[np.bool_]) -> Observations:
        """Return the observations of vehicles, as `_final_observations` does."""
        arrays = self.worlds.arrays
        if not self._senses:
            return with_rows(arrays.observations, arrays.final_observations, ended)
        last = sensed_observation(arrays.final_frames)
        return {
            name: with_rows(data, last[name], ended)
            for name, data in sensed_observation(arrays.frames).items()
        }

    def frames(self) -> dict[str, SensorFrames]:
        """Return the samples of the last step of each sensor of `rig`, by sensor name.

        See docs/reference/sensors.md. If a vehicle's trip ended in the step, these are its last
        samples. If a world resets in the same step, these are the first samples of the new episode.
        With `copy=False`, the next step overwrites the arrays.
        """
        frames = self.worlds.arrays.frames
        return {name: sensor.copy() if self._copy else sensor for name, sensor in frames.items()}

    def final_frames(self) -> dict[str, SensorFrames]:
        """Return the samples before the reset, for worlds where a trip or the episode ended.

        The arrays are as in `frames`. Samples of other worlds are older, or zeros.
        """
        frames = self.worlds.arrays.final_frames
        return {name: sensor.copy() for name, sensor in frames.items()}

    def suggest_actions(self) -> Any:
        """Return what the built-in driver (IDM, MOBIL, lane controller) would do for each agent.

        With agents of signals or limits, return a dict; signals follow the durations of the map's
        programs, and limits rise to the highest one.

        Raises:
            EpisodeError: before the first reset, or after `close`.
        """
        self._session.refuse_idle("suggest_actions()")
        self.worlds.suggest()
        found = self._session.decoder.encode(self.worlds.arrays.suggested)
        roadside = self._session.roadside
        if roadside is None:
            return found
        return {VEHICLES: found, roadside.kind: np.maximum(roadside.suggest(), 0)}

    def state(self) -> NDArray[np.float32]:
        """Return the global states (W, S), each as from `CavEnv.state`; input of a central critic.

        For a world that resets in the same step, this is the state of the new episode.

        Raises:
            EpisodeError: before the first reset, or after `close`.
        """
        self._session.refuse_idle("state()")
        self.worlds.write_states()
        return self.worlds.arrays.states.copy()

    def state_hash(self, world: int = 0) -> str:
        """Return a hex digest of one world; see `CavEnv.state_hash`."""
        return self.worlds.state_hash(world)

    def traffic_stats(self, world: int = 0) -> dict[str, float]:
        """Return traffic counts of one world since its reset; see `CavEnv.traffic_stats`."""
        return {**self.worlds.traffic_stats(world), **self._session.decoder.tolerated(world)}

    def save_state(self) -> bytes:
        """Return the state of the worlds, of actions and of the current results, as bytes.

        All later steps depend on this state alone.

        Raises:
            EpisodeError: before the first reset.
            ConfigError: the worlds use processes of their own, such as SUMO's.
        """
        return save_session(self._session, self._mask)

    def load_state(self, saved: bytes) -> None:
        """Restore a state that `save_state` returned. The number of zones and workers may differ.

        Raises:
            ConfigError: the state is damaged, or belongs to other worlds, another number of worlds
                or another version.
        """
        load_session(self._session, self._mask, saved)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a frame (height, width, 3) of each world; without a render_mode, warn.

        Raises:
            EpisodeError: before the first reset.
        """
        drawn = range(self.num_envs if self.render_mode else 1)  # one call is enough to warn
        frames = [self._picture(world) for world in drawn]
        return tuple(frame for frame in frames if frame is not None) or None

    def close(self) -> None:
        """End the recording and the worker processes, if any. Returned arrays stay valid.

        Afterwards, `reset` and `step` raise an EpisodeError.
        """
        self._session.close()
