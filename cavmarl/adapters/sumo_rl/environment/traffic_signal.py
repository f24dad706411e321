"""`TrafficSignal`: the interface of a signal for sumo-rl's reward functions and observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from gymnasium import spaces

from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.signals.agent_programs import between_greens
from cavmarl.signals.kernels.lane_counts import LENGTH_MM, SPEED_PPM, STANDING, VEHICLES

if TYPE_CHECKING:
    from cavmarl.adapters.sumo_rl.environment.env import SumoEnvironment
    from cavmarl.adapters.sumo_rl.environment.signal_world import SignalWorld

RewardFunction: TypeAlias = Callable[["TrafficSignal"], Any]
OneReward: TypeAlias = str | RewardFunction
Rewards: TypeAlias = OneReward | Sequence[OneReward]

GREEN_S = 60.0  # duration of a green in `all_phases`; not used, as greens are chosen
WAIT_SCALE_S = 100.0  # scale of the reward diff-waiting-time


class SignalPhase(NamedTuple):
    """A phase of a signal."""

    duration: float  # in s
    state: str  # letters


class TrafficSignal:
    """A signal whose greens are chosen: its lanes, vehicles and rewards.

    Counts refer to the last decision.

    Args:
        env: the environment.
        ts_id: id of the signal.
        world: the world of the environment.
        reward_fn: name, function, or a list of these.

    Attributes:
        id: id of the signal.
        env: the environment.
        lanes: ids of the lanes before the signal, in the order of its links.
        out_lanes: ids of the lanes after the signal.
        lanes_length: length of each of these lanes in m.
        green_phases: the greens.
        all_phases: the greens, and the yellow phase of each ordered pair of greens.
        yellow_dict: pair of greens → index of its yellow phase in `all_phases`.
        num_green_phases: number of greens; with `fixed_ts`, half the number of phases.
        observation_fn: an object of the observation class.
        observation_space: space of the observations.
        action_space: Discrete space of the greens.
        reward_dim: number of rewards.
        last_measure: sum of waiting times at the last decision, in 100 s.
        last_reward: reward of the last decision; None before the first one.

    Raises:
        ConfigError: there is no reward of that name.
    """

    MIN_GAP = 2.5  # m between stopped vehicles, for the number of vehicles that a lane holds

    def __init__(
        self, env: SumoEnvironment, ts_id: str, world: SignalWorld, reward_fn: Rewards
    ) -> None:
        self.id = ts_id
        self.env = env
        self._world = world
        self._signal = world.table.ids.index(ts_id)
        arrays = world.table.arrays
        incoming = arrays.incoming[self._signal]
        self._in: list[int] = incoming[incoming >= 0].tolist()
        self._out = world.out_lanes(ts_id)
        names, lengths = world.table.lanes, arrays.length_m.tolist()
        self.lanes = [names[n] for n in self._in]
        self.out_lanes = [names[n] for n in self._out]
        self.lanes_length = {names[n]: lengths[n] for n in (*self._in, *self._out)}
        self._lengths = lengths
        self._make_phases()
        self._rewards = self._functions(reward_fn)
        self.last_measure = 0.0
        self.last_reward: Any = None
        self.observation_fn = env.observation_class(self)
        self.observation_space = self.observation_fn.observation_space()
        self.action_space = spaces.Discrete(self.num_green_phases)

    def _make_phases(self) -> None:
        greens = [
            "".join(SIGNAL_STATES[code] for code in letters)
            for letters in self._world.table.greens[self._signal].tolist()
        ]
        self.green_phases = [SignalPhase(GREEN_S, letters) for letters in greens]
        self.all_phases = [*self.green_phases]
        self.yellow_dict: dict[tuple[int, int], int] = {}
        for i, before in enumerate(greens):
            for j, after in enumerate(greens):
                if i != j:
                    self.yellow_dict[i, j] = len(self.all_phases)
                    yellow = between_greens(before, after)
                    self.all_phases.append(SignalPhase(self.env.yellow_time, yellow))
        self.num_green_phases = len(greens)
        if self.env.fixed_ts:
            self.num_green_phases = self._world.num_phases(self.id) // 2

    def _functions(self, reward_fn: Rewards) -> list[RewardFunction]:
        given = [reward_fn] if isinstance(reward_fn, str) or callable(reward_fn) else reward_fn
        found: list[RewardFunction] = []
        for one in given:
            if callable(one):
                found.append(one)
            elif one in self.reward_fns:
                found.append(self.reward_fns[one])
            else:
                raise ConfigError(
                    f"reward_fn = {one!r}: must be a function of a TrafficSignal, or one of "
                    f"{', '.join(self.reward_fns)}"
                )
        return found

    @property
    def delta_time(self) -> float:
        """Time between two decisions in s."""
        return self.env.delta_time

    @property
    def yellow_time(self) -> float:
        """Duration of yellow in s."""
        return self.env.yellow_time

    @property
    def min_green(self) -> float:
        """Shortest duration of a green in s."""
        return self.env.min_green

    @property
    def max_green(self) -> float:
        """Longest duration of a green in s, if `enforce_max_green` is set."""
        return self.env.max_green

    @property
    def green_phase(self) -> int:
        """Index of the current green, or of the green that begins after yellow."""
        return self._world.greens(self._signal)[1]

    @property
    def time_since_last_phase_change(self) -> float:
        """Time in s since the last change of the green, yellow included."""
        return self._world.greens(self._signal)[2]

    @property
    def is_yellow(self) -> bool:
        """Whether the signal shows yellow."""
        before, green, since_s = self._world.greens(self._signal)
        return before != green and since_s < self.yellow_time

    @property
    def next_action_time(self) -> float:
        """Time of the next decision in s: all signals decide at once, after each step."""
        return self.env.sim_step

    @property
    def time_to_act(self) -> bool:
        """Whether the next action counts; always true between two steps."""
        return True

    @property
    def sumo(self) -> Any:
        """SUMO's connection, which does not exist here.

        Raises:
            ConfigError: always.
        """
        return self.env.sumo

    @property
    def reward_dim(self) -> int:
        """Number of rewards; 1 if they are weighted."""
        return 1 if self.env.reward_weights is not None else len(self._rewards)

    @property
    def reward_space(self) -> spaces.Box:
        """The space of the rewards."""
        return spaces.Box(-np.inf, np.inf, (self.reward_dim,), np.float32)

    def choice(self, action: Any) -> int:
        """Return the green of an action, or the next green if the action would exceed `max_green`.

        Raises:
            ActionError: the action is not the index of a green.
        """
        shape = np.shape(action)
        if shape not in ((), (1,)) or np.asarray(action).dtype.kind not in "iu":
            raise ActionError(f"{self.id}: the action is {action!r}, must be a whole number")
        green = int(np.asarray(action).reshape(()))
        if not 0 <= green < self.num_green_phases:
            raise ActionError(
                f"{self.id}: the action is {green}, must be from 0 to {self.num_green_phases - 1}"
            )
        is_due = self.env.enforce_max_green and self.time_since_last_phase_change >= self.max_green
        if is_due and green == self.green_phase:
            return (green + 1) % self.num_green_phases
        return green

    def compute_observation(self) -> Any:
        """Return the observation."""
        return self.observation_fn()

    def compute_reward(self) -> Any:
        """Return the reward of the interval since the last decision, and keep it.

        With a list of rewards, return an array of them, or their sum weighted by `reward_weights`.
        """
        values = [function(self) for function in self._rewards]
        weights = self.env.reward_weights
        if weights is not None:
            self.last_reward = float(np.dot(np.array(values, dtype=np.float32), weights))
        else:
            self.last_reward = values[0] if len(values) == 1 else np.array(values, np.float32)
        return self.last_reward

    def _pressure_reward(self) -> int:
        return self.get_pressure()

    def _average_speed_reward(self) -> float:
        return self.get_average_speed()

    def _queue_reward(self) -> int:
        return -self.get_total_queued()

    def _diff_waiting_time_reward(self) -> float:
        waited = sum(self.get_accumulated_waiting_time_per_lane()) / WAIT_SCALE_S
        reward = self.last_measure - waited
        self.last_measure = waited
        return reward

    def get_accumulated_waiting_time_per_lane(self) -> list[float]:
        """Return for each incoming lane how long its vehicles have been stopped on it, in s."""
        return self._world.stood_s(self._in)

    def get_average_speed(self) -> float:
        """Return the mean speed on incoming lanes, as a share of the speed limit; 1 if empty."""
        counts = self._world.counts[self._in].sum(axis=0)
        vehicles = int(counts[VEHICLES])
        return float(counts[SPEED_PPM]) * 1e-6 / vehicles if vehicles else 1.0

    def get_pressure(self) -> int:
        """Return the number of vehicles on outgoing lanes minus the number on incoming lanes."""
        vehicles = self._world.counts[:, VEHICLES]
        return int(vehicles[self._out].sum()) - int(vehicles[self._in].sum())

    def get_lanes_density(self) -> list[float]:
        """Return the vehicles on each incoming lane as a share of the lane's capacity."""
        return self._shares(self._in, VEHICLES)

    def get_lanes_queue(self) -> list[float]:
        """Return the stopped vehicles on each incoming lane as a share of the lane's capacity."""
        return self._shares(self._in, STANDING)

    def get_out_lanes_density(self) -> list[float]:
        """Return the vehicles on each outgoing lane as a share of the lane's capacity."""
        return self._shares(self._out, VEHICLES)

    def get_total_queued(self) -> int:
        """Return the number of stopped vehicles on incoming lanes."""
        return int(self._world.counts[self._in, STANDING].sum())

    def _shares(self, lanes: list[int], column: int) -> list[float]:
        """Return a count of vehicles on each lane as a share of the lane's capacity, at most 1."""
        found = []
        for lane, counts in zip(lanes, self._world.counts[lanes].tolist(), strict=True):
            vehicles = counts[VEHICLES]
            mean_m = counts[LENGTH_MM] * 1e-3 / vehicles if vehicles else 0.0
            room = self._lengths[lane] / (self.MIN_GAP + mean_m)
            found.append(min(1.0, counts[column] / room))
        return found

    @classmethod
    def register_reward_fn(cls, fn: RewardFunction) -> None:
        """Register a function, so that `reward_fn` can name it.

        Raises:
            ConfigError: the name exists already.
        """
        name = fn.__name__
        if name in cls.reward_fns:
            raise ConfigError(f"register_reward_fn: a reward {name!r} exists already; rename it")
        cls.reward_fns[name] = fn

    reward_fns: ClassVar[dict[str, RewardFunction]] = {
        "diff-waiting-time": _diff_waiting_time_reward,
        "average-speed": _average_speed_reward,
        "queue": _queue_reward,
        "pressure": _pressure_reward,
    }


def signals_of(
    env: SumoEnvironment, world: SignalWorld, reward_fn: Rewards | Mapping[str, Rewards]
) -> dict[str, TrafficSignal]:
    """Return the signals of an environment by their ids, as at the start of an episode.

    Raises:
        ConfigError: a mapping of rewards lacks a signal or has an unknown one.
    """
    if not isinstance(reward_fn, Mapping):
        reward_fn = dict.fromkeys(env.ts_ids, reward_fn)
    if wrong := set(env.ts_ids) ^ set(reward_fn):
        name = min(wrong)
        problem = "has no reward" if name in env.ts_ids else "is not a signal of this map"
        raise ConfigError(
            f"reward_fn: {name!r} {problem}; give one to each of {', '.join(env.ts_ids[:8])}"
        )
    return {ts: TrafficSignal(env, ts, world, reward_fn[ts]) for ts in env.ts_ids}
