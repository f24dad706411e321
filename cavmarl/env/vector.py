"""`CavVectorEnv`: many worlds, arrays in and out."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.plan_text import describe_plan
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.engine.spaces import (
    action_space,
    flat_observation_space,
    frames_space,
    sensed_observation,
)
from cavmarl.env.autoreset import known_mode, present_mode, refuse_over, with_rows
from cavmarl.env.saved_state import load_session, save_session
from cavmarl.env.step_session import StepSession
from cavmarl.env.world_arguments import WorldArguments, start_worlds
from cavmarl.env.worlds_environment import WorldsEnvironment
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.sensors.mounted.frames import SensorFrames

MAX_WORLDS = 65_536

Observations: TypeAlias = Any
"""(W, A, D) float32, or an array (W, A, …) a sensor of the rig."""

StepResult = tuple[
    Observations, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], dict[str, NDArray[Any]]
]


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
        env: name of an entry of `envs/`, a folder with an env.yaml, or a map file.
        num_envs: number of worlds.
        autoreset_mode: when a world that is over begins anew; see `CavVectorEnv`.
        copy: False returns observations without a copy.
        world: zones, backend, workers, nodes, sensor_workers, agents, background, seed, max_cycles,
            sensors_of, render_mode, record and overrides, as `WorldArguments` describes them.

    Raises:
        ConfigError: a key, value or combination that cannot work.
        PolicyError: `sensors_of` is no trained driver.
        MapError: the map cannot be read or driven.
        WorkerError: worker processes cannot be started, or have no memory.
        MissingExtraError, RecordingError: no Ray, or pyarrow; `record` cannot be written.
    """
    num_envs, mode = _checked(num_envs), known_mode(autoreset_mode)
    in_next_step = mode is not AutoresetMode.SAME_STEP
    worlds = start_worlds(env, num_envs, in_next_step, ("rgb_array",), **world)
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
    """W worlds with A agent seats each; ground truth is flat, whatever `observation.kind` says.

    With `observation.mode: sensors` and `observation.kind: dict`, observations are dicts: an array
    (num_envs, num_agents, …) a sensor of the rig.

    Arrays have the shape (num_envs, num_agents, …). `infos["mask"]` says which agents have a
    vehicle and will be asked for the next action; the others' observations are 0 and their actions
    are not read. A world whose episode is over (truncated, or all agents gone and none to come) is
    begun anew as Gymnasium's `AutoresetMode` says:

    - `SAME_STEP`: in the same step. The observations returned are those of the new episode,
      `infos["final_observations"]` keeps the last ones of the old, and of each agent that left.
    - `NEXT_STEP`: in the next step. The observations returned are the last ones, those of agents
      that leave too; in the next step the world's actions are not read, its rewards are 0 and the
      observations are those of the new episode.
    - `DISABLED`: by `reset(options={"reset_mask": infos["episode_over"]})` before the next step,
      and never by itself. What a step returns is that of `NEXT_STEP`.

    Worlds run here, or over processes, which changes no bit of what comes out
    (docs/guides/divide_a_world.md).

    Args:
        worlds: that are stepped.
        seed: of the first reset, if that is given none.
        copy: False returns observations as a read-only view that the next step or reset overwrites;
            large ones are copied for longer than they are made.
        disabled: worlds that are over wait for a reset; they are those of the next step.
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
        self.metadata |= {
            "autoreset_mode": present_mode(worlds.in_next_step, disabled),
            "render_modes": ["rgb_array"],
        }
        self._disabled = disabled
        self._over = np.zeros(num_envs, dtype=np.bool_)  # and not begun anew yet
        self._mask = np.zeros((num_envs, self.num_agents), dtype=np.bool_)
        self._copy = copy

    @property
    def max_cycles(self) -> int:
        """Steps until truncation."""
        return self.config.max_steps

    @property
    def state_size(self) -> int:
        """Numbers in the global state of a world."""
        return int(self.worlds.arrays.states.shape[1])

    @property
    def simulated_s(self) -> float:
        """Time that all steps have taken up to now, without that for actions and for copying."""
        return self._session.simulated_s

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Which worker hosts which worlds, or zones of each world; empty without workers.

        See docs/explanation/balance.md; where worlds or zones move, it is the present plan.
        """
        return self.worlds.plans

    def plan_text(self) -> str:
        """The plans as tables; each full reset logs them (`cavmarl.workers`, INFO)."""
        return "\n\n".join(map(describe_plan, self.plans))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, NDArray[Any]]]:
        """Begin an episode in every world, or in some.

        Args:
            seed: root of all random numbers; world w's episodes depend on (seed, w) alone. None
                goes on with the next episodes of the last seed.
            options: `first_world`, with a seed: these are the worlds from that number on, so that
                many worlds can be run a part at a time. `reset_mask`, without one: (W,) which
                worlds begin anew; the others stay as they are. Others are not used.

        Returns:
            observations (W, A, D) and infos.

        Raises:
            ConfigError: a reset_mask of another shape or dtype, or one that comes with a seed.
            EpisodeError: a reset_mask before the first reset.
        """
        options = options or {}
        chosen = self._chosen(options.get("reset_mask"), seed)
        first_world = int(options.get("first_world", 0))
        self._session.reset(seed, chosen, first_world)
        self._mask = self.worlds.arrays.mask.copy()
        self._over = self._over & ~chosen
        return self._observations(), {"mask": self._mask.copy()}

    def _chosen(self, reset_mask: Any, seed: int | None) -> NDArray[np.bool_]:
        """(W,) the worlds that a reset begins anew."""
        if reset_mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        chosen = np.asarray(reset_mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_:
            raise ConfigError(
                f"reset_mask has shape {chosen.shape} and dtype {chosen.dtype}: must be "
                f"({self.num_envs},) and bool, one a world"
            )
        if seed is not None:
            raise ConfigError(
                "reset_mask with a seed: a seed is that of all worlds; leave one of the two out"
            )
        if not self._session.is_ready:
            raise EpisodeError("reset_mask before the first reset: call vec.reset(seed=…)")
        return chosen

    def step(self, actions: NDArray[Any]) -> StepResult:
        """Let every agent of every world act.

        Args:
            actions: (W, A, 2) floats in [-1, 1], or (W, A) meta-actions. Not read where the mask is
                False.

        Returns:
            observations (W, A, D), rewards (W, A), terminations (W, A): the agent's vehicle ended;
            truncations (W, A): its trip was cut at the episode's horizon, or its own; and infos:
            `mask` (W, A) agents that act next; `acted` (W, A) agents that acted in this step, so
            their rewards count; `terms` (W, A, T) in the order of `config.terms.TERMS`;
            `arrivals` (W,) vehicles that reached their goal since the reset, agents included;
            `episode_over` (W,) which worlds are over;
            `final_observations` (W, A, D) before a reset and with the last ones of agents that
            left: the same array as the observations in a step where none did.

        Raises:
            EpisodeError: before the first reset, or, with `DISABLED`, before that of a world that
                is over.
            ActionError: wrong shape, dtype or value; nothing has changed.
        """
        if not self._session.is_ready:
            raise EpisodeError("step() before reset(): call vec.reset(seed=…) first")
        if self._disabled:
            refuse_over(self._over)
        session = self._session
        session.step(session.decoder.from_array(actions, self._mask))
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
        terminations &= ~arrays.truncations  # a trip that its own horizon cut has no end
        return observations, arrays.rewards.copy(), terminations, arrays.truncations.copy(), infos

    def _observations(self) -> Observations:
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
        """A copy, or a view that cannot be written."""
        if self._copy:
            return array.copy()
        view = array.view()
        view.flags.writeable = False
        return view

    def declare_event(self, world: int, agent: int, cause: str) -> None:
        """Let the vehicle of an agent, by index, tell others of an event in the next step.

        Args:
            world: in which it drives.
            agent: index in `possible_agents`.
            cause: as of `CavEnv.declare_event`.

        Raises:
            ActionError: no such agent.
            ConfigError: no such cause, or no messages are sent in this environment.
        """
        self._session.events.declare(world, agent, cause)

    def _final_observations(self, ended: NDArray[np.bool_]) -> Observations:
        """The observations, and of the worlds (W,) where something ended those before that."""
        arrays = self.worlds.arrays
        if not self._senses:
            return with_rows(arrays.observations, arrays.final_observations, ended)
        last = sensed_observation(arrays.final_frames)
        return {
            name: with_rows(data, last[name], ended)
            for name, data in sensed_observation(arrays.frames).items()
        }

    def frames(self) -> dict[str, SensorFrames]:
        """What the sensors of `rig` have got in the last step, by name.

        See docs/reference/sensors.md. Agents whose vehicle ended in the step have its last samples.
        Of a world that begins anew in the same step it is what the new episode begins with. With
        `copy=False` they are arrays that the next step overwrites.
        """
        frames = self.worlds.arrays.frames
        return {name: sensor.copy() if self._copy else sensor for name, sensor in frames.items()}

    def final_frames(self) -> dict[str, SensorFrames]:
        """As `frames`, of the worlds where something ended in the last step, before the reset.

        Those of other worlds are older, or zeros.
        """
        frames = self.worlds.arrays.final_frames
        return {name: sensor.copy() for name, sensor in frames.items()}

    def suggest_actions(self) -> NDArray[Any]:
        """What the built-in driver (IDM, MOBIL, lane controller) would do in each agent's place."""
        self.worlds.suggest()
        return self._session.decoder.encode(self.worlds.arrays.suggested)

    def state(self) -> NDArray[np.float32]:
        """The global states (W, S), each as `CavEnv.state`; what a central critic may see.

        Of a world that begins anew in the same step it is the new episode's.
        """
        self.worlds.write_states()
        return self.worlds.arrays.states.copy()

    def state_hash(self, world: int = 0) -> str:
        """Hex digest of one world, as `CavEnv.state_hash`."""
        return self.worlds.state_hash(world)

    def traffic_stats(self, world: int = 0) -> dict[str, float]:
        """Traffic of one world since its reset, as `CavEnv.traffic_stats`."""
        return {**self.worlds.traffic_stats(world), **self._session.decoder.tolerated(world)}

    def save_state(self) -> bytes:
        """All that later steps depend on: of the worlds, of actions held, of what is shown.

        Raises:
            EpisodeError: before the first reset.
            ConfigError: worlds have processes of their own: SUMO's.
        """
        return save_session(self._session, self._mask)

    def load_state(self, saved: bytes) -> None:
        """Go on from what `save_state` gave; zones and workers may be others than they were.

        Raises:
            ConfigError: it is damaged, of other worlds, of another number of them, or of another
                version.
        """
        load_session(self._session, self._mask, saved)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A frame (height, width, 3) of each world; None and a warning without a render_mode.

        Raises:
            EpisodeError: before the first reset.
        """
        drawn = range(self.num_envs if self.render_mode else 1)  # one is enough to warn
        frames = [self._picture(world) for world in drawn]
        return tuple(frame for frame in frames if frame is not None) or None

    def close(self) -> None:
        """End recording and worker processes, if there are any; arrays that were returned stay."""
        self._session.close()
