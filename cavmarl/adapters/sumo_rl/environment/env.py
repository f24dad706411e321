"""`SumoEnvironment` and its forms for PettingZoo: signals choose greens, as in sumo-rl."""

from __future__ import annotations

import csv
import itertools
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils import AgentSelector, wrappers
from pettingzoo.utils.conversions import parallel_wrapper_fn

from cavmarl.adapters.sumo_rl.environment.observations import (
    DefaultObservationFunction,
    ObservationFunction,
)
from cavmarl.adapters.sumo_rl.environment.signal_world import SignalWorld, WorldSettings
from cavmarl.adapters.sumo_rl.environment.traffic_signal import Rewards, signals_of
from cavmarl.core.errors import ActionError, ConfigError, EpisodeError
from cavmarl.signals.kernels.lane_counts import STANDING_MPS

RANDOM = "random"

# Arguments that change nothing here: name → usual values, and the reason.
_IGNORED: Mapping[str, tuple[tuple[Any, ...], str]] = {
    "use_gui": ((False,), "SUMO does not run; set render_mode, or record and replay a world"),
    "virtual_display": (((3200, 1800), None), "frames need no display"),
    "max_depart_delay": ((-1,), "vehicles wait to depart without a time limit"),
    "waiting_time_memory": ((1000,), "all waiting times on a lane are remembered"),
    "time_to_teleport": ((-1, 0), "no vehicle is teleported"),
    "sumo_warnings": ((True,), "SUMO does not run; set the level of the logger cavmarl"),
}


class SumoEnvironment(gymnasium.Env[Any, Any], EzPickle):
    """An environment with the arguments and results of sumo-rl 1.4.5.

    With `single_agent`, a Gymnasium environment of the first signal. Otherwise, `reset` returns
    observations by id, and `step` returns observations, rewards and dones by id, and one info. The
    arguments are also attributes.

    Args:
        net_file: SUMO's network.
        route_file: SUMO's routes; several files are separated by commas.
        out_csv_name: start of the names of CSV files, one for each episode; None: no files.
        use_gui: ignored.
        virtual_display: ignored.
        begin_time: time in s at which the episode begins.
        num_seconds: duration of an episode in s.
        max_depart_delay: ignored.
        waiting_time_memory: ignored.
        time_to_teleport: ignored.
        delta_time: time between two decisions in s.
        yellow_time: duration of yellow in s, within `delta_time`.
        min_green: shortest duration of a green in s.
        max_green: only read with `enforce_max_green`.
        enforce_max_green: whether the next green begins if an action would exceed `max_green`.
        single_agent: whether only the first signal has an agent; other signals keep their greens.
        reward_fn: a name in `TrafficSignal.reward_fns`, a function of a TrafficSignal, a list of
            these, or a mapping from the id of each signal to one of these.
        reward_weights: weights of a list of rewards; None: rewards are arrays.
        observation_class: subclass of ObservationFunction.
        add_system_info: whether infos have the values of all vehicles.
        add_per_agent_info: whether infos have the values of each signal.
        sumo_seed: seed of every episode, or `random`.
        fixed_ts: whether signals follow the programs of the map; actions are not read.
        sumo_warnings: ignored.
        additional_sumo_cmd: further options of SUMO; docs/guides/demand.md lists supported options.
        render_mode: `human`, `rgb_array` or None.
        overrides: keys of env.yaml.

    Attributes:
        ts_ids: ids of the signals with two or more greens, sorted.
        traffic_signals: the signals by id.
        label: number of the environment in the names of CSV files.
        episode: number of the episode, from 1.
        metrics: infos of the episode, the rows of its CSV file.
        observations: last observations by id.
        rewards: last rewards by id.

    Raises:
        ConfigError: an argument is not possible, or no signal of the map has two greens.
        MapError, DemandError, RouteError: a file is missing or wrong.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 - Gymnasium
    CONNECTION_LABEL = itertools.count()

    # Arguments; see `__getattr__`.
    net_file: str
    route_file: str
    out_csv_name: str | None
    begin_time: float
    num_seconds: float
    delta_time: float
    yellow_time: float
    min_green: float
    max_green: float
    enforce_max_green: bool
    single_agent: bool
    reward_fn: Rewards | Mapping[str, Rewards]
    reward_weights: Sequence[float] | None
    observation_class: type[ObservationFunction]
    add_system_info: bool
    add_per_agent_info: bool
    fixed_ts: bool
    additional_sumo_cmd: str | None
    overrides: Mapping[str, Any] | None

    def __init__(
        self,
        net_file: str,
        route_file: str,
        out_csv_name: str | None = None,
        use_gui: bool = False,
        virtual_display: tuple[int, int] | None = (3200, 1800),
        begin_time: float = 0,
        num_seconds: float = 20000,
        max_depart_delay: float = -1,
        waiting_time_memory: float = 1000,
        time_to_teleport: float = -1,
        *,
        delta_time: float = 5,
        yellow_time: float = 2,
        min_green: float = 5,
        max_green: float = 50,
        enforce_max_green: bool = False,
        single_agent: bool = False,
        reward_fn: Rewards | Mapping[str, Rewards] = "diff-waiting-time",
        reward_weights: Sequence[float] | None = None,
        observation_class: type[ObservationFunction] = DefaultObservationFunction,
        add_system_info: bool = True,
        add_per_agent_info: bool = True,
        sumo_seed: str | int = RANDOM,
        fixed_ts: bool = False,
        sumo_warnings: bool = True,
        additional_sumo_cmd: str | None = None,
        render_mode: str | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        given = dict(locals())
        self._given = {name: given[name] for name in given if name not in ("self", "__class__")}
        EzPickle.__init__(self, **self._given)
        self.render_mode = render_mode
        self._seed = _seed(sumo_seed)
        _check_times(delta_time, yellow_time, num_seconds)
        for name, (usual, reason) in _IGNORED.items():
            if self._given[name] not in usual:
                text = f"{name} = {self._given[name]!r} is ignored: {reason}"
                warnings.warn(text, UserWarning, stacklevel=2)
        self.label = str(next(self.CONNECTION_LABEL))
        self.episode = 0
        self.metrics: list[dict[str, Any]] = []
        self._world: SignalWorld | None = self._make_world()
        self.ts_ids = sorted(self._world.table.ids)
        self.traffic_signals = signals_of(self, self._world, reward_fn)
        self.observations: dict[str, Any] = dict.fromkeys(self.ts_ids)
        self.rewards: dict[str, Any] = dict.fromkeys(self.ts_ids)

    def __getattr__(self, name: str) -> Any:
        given = self.__dict__.get("_given", {})
        if name in given:
            return given[name]
        if name in ("sumo", "vehicles"):
            raise NoSumoError(
                f"{name}: SUMO does not run, so there is no TraCI; read the methods of "
                "TrafficSignal, or the vehicles of env.world.simulation"
            )
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _make_world(self) -> SignalWorld:
        return SignalWorld(
            WorldSettings(
                net_file=self.net_file,
                route_file=self.route_file,
                begin_s=self.begin_time,
                horizon_s=self.num_seconds,
                decide_s=self.delta_time,
                yellow_s=self.yellow_time,
                min_green_s=self.min_green,
                follows_programs=self.fixed_ts,
                sumo_options=self.additional_sumo_cmd or "",
                render_mode=self.render_mode,
                overrides=self.overrides or {},
            )
        )

    @property
    def world(self) -> SignalWorld:
        """The world, whose `simulation` has the vehicles.

        Raises:
            EpisodeError: after `close`.
        """
        if self._world is None:
            raise EpisodeError("the environment is closed: call reset() first")
        return self._world

    @property
    def sim_max_time(self) -> float:
        """Time at which the episode ends, in s."""
        return self.begin_time + self.num_seconds

    @property
    def sim_step(self) -> float:
        """Current time in s."""
        passed_s = 0.0 if self._world is None else self._world.time_s
        return float(round(self.begin_time + passed_s, 6))

    @property
    def observation_space(self) -> spaces.Space[Any]:  # type: ignore[override] # depends on the map
        """The observation space of the first signal."""
        return self.traffic_signals[self.ts_ids[0]].observation_space

    @property
    def action_space(self) -> spaces.Discrete:  # type: ignore[override] # depends on the map
        """The action space of the first signal."""
        return self.traffic_signals[self.ts_ids[0]].action_space

    @property
    def reward_space(self) -> spaces.Box:
        """The space of the first signal's rewards."""
        return self.traffic_signals[self.ts_ids[0]].reward_space

    @property
    def reward_dim(self) -> int:
        """Number of the first signal's rewards."""
        return self.traffic_signals[self.ts_ids[0]].reward_dim

    def observation_spaces(self, ts_id: str) -> spaces.Space[Any]:
        """Return the observation space of a signal."""
        return self.traffic_signals[ts_id].observation_space

    def action_spaces(self, ts_id: str) -> spaces.Discrete:
        """Return the action space of a signal."""
        return self.traffic_signals[ts_id].action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode, and write the CSV file of the last one.

        Args:
            seed: replaces `sumo_seed`.
            options: not used.

        Returns:
            Observations by id; with `single_agent`, the observation of the first signal and infos.
        """
        super().reset(seed=seed)
        if self.episode:
            self.save_csv(self.out_csv_name, self.episode)
        self.episode += 1
        self.metrics = []
        if seed is not None:
            self._seed = _seed(seed)
        if self._world is None:
            self._world = self._make_world()
        self._world.reset(self._seed)
        self.traffic_signals = signals_of(self, self._world, self.reward_fn)
        observations = self.compute_observations()
        if self.single_agent:
            return observations[self.ts_ids[0]], self.compute_info()
        return observations

    def step(self, action: Any) -> Any:
        """Let signals begin greens, and advance the world by `delta_time`.

        Args:
            action: greens by id; with `single_agent`, a green of the first signal. A signal without
                an action keeps its green.

        Returns:
            Observations, rewards and dones by id, and infos; `dones["__all__"]`: episode over.
            With `single_agent`, the results of a Gymnasium environment.

        Raises:
            ActionError: an id or an action is not possible; nothing has changed.
            EpisodeError: before `reset`, after `close`, or the episode is over.
        """
        if self.single_agent and action is not None:
            action = {self.ts_ids[0]: action}
        self.advance({} if self.fixed_ts or action is None else action)
        observations, rewards = self.compute_observations(), self.compute_rewards()
        is_over, info = self.is_over, self.compute_info()
        if self.render_mode == "human":
            self.render()
        if self.single_agent:
            first = self.ts_ids[0]
            return observations[first], rewards[first], False, is_over, info
        return observations, rewards, dict.fromkeys(self.ts_ids, False) | {"__all__": is_over}, info

    def advance(self, actions: Mapping[str, Any]) -> None:
        """Apply actions by id, and advance the world by `delta_time`; see `step`."""
        world = self.world
        if not self.episode:
            raise EpisodeError("step() before reset(): call reset() first")
        if world.is_over:
            raise EpisodeError("the episode is over: call reset()")
        if not isinstance(actions, Mapping):
            raise ActionError(f"the actions are {actions!r}: must be a dict of greens by id")
        choices = world.no_choices()
        for ts, action in actions.items():
            if ts not in self.traffic_signals:
                raise ActionError(
                    f"no signal {ts!r} with two greens; choose from {', '.join(self.ts_ids[:8])}"
                )
            choices[world.table.ids.index(ts)] = self.traffic_signals[ts].choice(action)
        world.step(choices)

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self.sim_step >= self.sim_max_time

    def compute_observations(self) -> dict[str, Any]:
        """Observe all signals; return copies of the observations by id."""
        self.observations = {
            ts: signal.compute_observation() for ts, signal in self.traffic_signals.items()
        }
        return {ts: observation.copy() for ts, observation in self.observations.items()}

    def compute_rewards(self) -> dict[str, Any]:
        """Return the rewards of all signals by id."""
        self.rewards = {ts: signal.compute_reward() for ts, signal in self.traffic_signals.items()}
        return dict(self.rewards)

    def compute_info(self) -> dict[str, Any]:
        """Return the values of all vehicles and of each signal, and add them to `metrics`."""
        info: dict[str, Any] = {"step": self.sim_step}
        if self.add_system_info:
            info |= self._system_info()
        if self.add_per_agent_info:
            info |= self._per_agent_info()
        self.metrics.append(info.copy())
        return info

    def _system_info(self) -> dict[str, Any]:
        speeds, waits_s = self.world.vehicles()
        return {
            "system_total_stopped": int(np.count_nonzero(speeds < STANDING_MPS)),
            "system_total_waiting_time": float(waits_s.sum()),
            "system_mean_waiting_time": float(waits_s.mean()) if waits_s.size else 0.0,
            "system_mean_speed": float(speeds.mean()) if speeds.size else 0.0,
        }

    def _per_agent_info(self) -> dict[str, Any]:
        info: dict[str, Any] = {}
        total_stopped, total_waited = 0, 0.0
        for ts, signal in self.traffic_signals.items():
            stopped = signal.get_total_queued()
            waited = float(sum(signal.get_accumulated_waiting_time_per_lane()))
            info[f"{ts}_stopped"] = stopped
            info[f"{ts}_accumulated_waiting_time"] = waited
            info[f"{ts}_average_speed"] = signal.get_average_speed()
            total_stopped += stopped
            total_waited += waited
        info["agents_total_stopped"] = total_stopped
        info["agents_total_accumulated_waiting_time"] = total_waited
        return info

    def save_csv(self, out_csv_name: str | None, episode: int) -> None:
        """Write the infos of the episode to `<out_csv_name>_conn<label>_ep<episode>.csv`."""
        if out_csv_name is None:
            return
        path = Path(f"{out_csv_name}_conn{self.label}_ep{episode}.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        names = list(self.metrics[0]) if self.metrics else []
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.metrics)

    def encode(self, state: NDArray[np.float32], ts_id: str) -> tuple[Any, ...]:
        """Return a default observation as a key of a Q-table.

        The key has the green, whether the green may end, and tenths of the densities.
        """
        greens = self.traffic_signals[ts_id].num_green_phases
        densities = [min(int(value * 10), 9) for value in state[greens + 1 :]]
        return (int(np.argmax(state[:greens])), state[greens], *densities)

    def render(self) -> Any:
        """Return a frame for `rgb_array`, show a window for `human`, else return None."""
        if self._world is None or self.render_mode is None:
            return None
        return self._world.picture(self.render_mode)

    def close(self) -> None:
        """End the world; `reset` makes another one."""
        if self._world is not None:
            self._world.close()
            self._world = None


class NoSumoError(ConfigError, AttributeError):
    """An attribute of sumo-rl that needs SUMO."""


class SumoEnvironmentPZ(AECEnv, EzPickle):  # type: ignore[misc] # PettingZoo is not typed
    """The signals of a `SumoEnvironment` as a PettingZoo AEC environment.

    Args:
        arguments: as for `SumoEnvironment`.

    Attributes:
        env: the environment.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "sumo_rl_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
    }

    def __init__(self, **arguments: Any) -> None:
        EzPickle.__init__(self, **arguments)
        super().__init__()
        self.env = SumoEnvironment(**arguments)
        self.render_mode = self.env.render_mode
        self.possible_agents = list(self.env.ts_ids)
        self.agents = list(self.env.ts_ids)
        self.action_spaces = {ts: self.env.action_spaces(ts) for ts in self.agents}
        self.observation_spaces = {ts: self.env.observation_spaces(ts) for ts in self.agents}
        self._actions: dict[str, Any] = {}
        self._begin()

    def _begin(self) -> None:
        self.agents = list(self.possible_agents)
        self._turn = AgentSelector(self.agents)
        self.agent_selection = self._turn.reset()
        self.rewards = dict.fromkeys(self.agents, 0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {ts: {} for ts in self.agents}
        self._actions.clear()

    def observation_space(self, agent: str) -> Any:
        """Return the observation space of a signal."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return the action space of a signal."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode; see `SumoEnvironment.reset`."""
        self.env.reset(seed=seed, options=options)
        self._begin()
        self._inform()

    def _inform(self) -> None:
        """Set the info of each signal as in sumo-rl: values of all vehicles and of the signal."""
        infos = self.env.compute_info()
        self.infos = {
            ts: {name: value for name, value in infos.items() if name.startswith((ts, "system"))}
            for ts in self.agents
        }

    def observe(self, agent: str) -> Any:
        """Return the last observation of a signal."""
        return self.env.observations[agent].copy()

    def step(self, action: Any) -> None:
        """Take the action of the selected signal; the last one advances the world.

        Raises:
            ActionError: the action is not possible; the signal can act again.
        """
        agent = self.agent_selection
        if self.truncations[agent] or self.terminations[agent]:
            self._was_dead_step(action)
            return
        self.env.traffic_signals[agent].choice(action)
        self._actions[agent] = action
        if self._turn.is_last():
            self.env.advance({} if self.env.fixed_ts else self._actions)
            self._actions.clear()
            self.env.compute_observations()
            self.rewards = self.env.compute_rewards()
            self._inform()
            self.truncations = dict.fromkeys(self.agents, self.env.is_over)
        else:
            self._clear_rewards()
        self.agent_selection = self._turn.next()
        self._cumulative_rewards[agent] = 0
        self._accumulate_rewards()

    def save_csv(self, out_csv_name: str | None, episode: int) -> None:
        """Write the infos of the episode; see `SumoEnvironment.save_csv`."""
        self.env.save_csv(out_csv_name, episode)

    def render(self) -> Any:
        """Draw the world; see `SumoEnvironment.render`."""
        return self.env.render()

    def close(self) -> None:
        """End the world."""
        self.env.close()


def env(**arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the signals as a PettingZoo AEC environment; arguments of `SumoEnvironment`."""
    checked = wrappers.AssertOutOfBoundsWrapper(SumoEnvironmentPZ(**arguments))
    return wrappers.OrderEnforcingWrapper(checked)


parallel_env = parallel_wrapper_fn(env)


def _seed(value: Any) -> int | None:
    """Return a seed as a number; None if it is random."""
    if value == RANDOM:
        return None
    try:
        return int(value)
    except (TypeError, ValueError):
        raise ConfigError(f"sumo_seed = {value!r}: must be a whole number, or {RANDOM!r}") from None


def _check_times(delta_time: float, yellow_time: float, num_seconds: float) -> None:
    if not delta_time > yellow_time:
        raise ConfigError(
            f"delta_time = {delta_time:g}: must be above yellow_time = {yellow_time:g}"
        )
    if not num_seconds > 0:
        raise ConfigError(f"num_seconds = {num_seconds:g}: must be above 0, in s")
