"""highway-env's tasks: scripts for highway-env only have to change the id of the environment.

`gymnasium.make("cavmarl-highway/merge-v0", config={...})` accepts highway-env's `config` with its
names and units, and returns its observations, actions, rewards and infos. Cars drive on maps of
`envs/` with the models of this package. Leurent: "An environment for autonomous driving
decision-making", 2018.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np

from cavmarl.adapters.gymnasium_env import CavEgoEnv
from cavmarl.adapters.highway_tasks import COMMON, DRAWING_KEYS, REWARDS, TASKS, HighwayTask
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import DRIVER_AGENT

# highway-env's type of observation → the sensor, and highway-env's default settings for it.
OBSERVATIONS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "Kinematics": ("kinematics", {"vehicles_count": 5}),
    "OccupancyGrid": (
        "occupancy_grid", {"features": ["presence", "vx", "vy", "on_road"]}
    ),
    "LidarObservation": ("lidar_observation", {"cells": 16}),
}  # fmt: skip
_UNITS = {
    "grid_size": "grid_size_m",
    "grid_step": "grid_step_m",
    "maximum_range": "maximum_range_m",
}
_META = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
_OFF: Mapping[str, Any] = {
    "sensors.ego.enabled": False,
    "sensors.route.points": 0,
    "sensors.neighbors.count": 0,
    "sensors.signal.enabled": False,
    "sensors.lanes.range_m": 0.0,
    "sensors.lidar.rays": 0,
    "sensors.way.distances_m": [],
    "sensors.way.lines": 0,
    "sensors.conflicts.count": 0,
    "sensors.history.steps": 0,
}


class HighwayEnv(CavEgoEnv):
    """A task of highway-env as a Gymnasium environment.

    The reward is the sum of highway-env's named rewards, weighted by its keys; `info["rewards"]`
    has each named reward. In all tasks, `reward_speed_range` scales the speed for
    `high_speed_reward`. If the vehicle leaves the road, the episode ends; `offroad_terminal` is
    ignored.

    Args:
        task: a key of `TASKS`.
        config: highway-env's keys, which replace the defaults of the task.
        render_mode: see `CavEgoEnv`.
        arguments: other keyword arguments of `parallel_env`; `overrides` has keys of env.yaml.

    Attributes:
        config: all keys of highway-env with their values.
        action_type: has `actions_indexes`, the number of each named action.

    Raises:
        ConfigError: a key or a type is unknown; the message lists all known keys or types.
    """

    def __init__(
        self,
        task: str,
        *,
        config: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        self._task = TASKS[task]
        self.config = _whole_config(task, self._task, config)
        name, observed = _observation(self.config["observation"])
        actions = _Actions(self.config["action"])
        super().__init__(
            self._task.entry,
            render_mode=render_mode,
            background=int(self.config["vehicles_count"]),
            overrides={
                **_OFF,
                **_clock(self.config),
                **self._task.keys,
                **_map(self._task, self.config),
                **observed,
                **actions.keys,
                "observation.kind": "dict",
                **(overrides or {}),
            },
            **arguments,
        )
        self._seen = name
        self.observation_space = cast(gymnasium.spaces.Dict, self.observation_space)[name]
        self._actions = actions
        self.action_space = actions.space
        self.action_type = SimpleNamespace(actions_indexes=actions.numbers)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = super().reset(seed=seed, options=options)
        return observation[self._seen], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one step with the vehicle's action; the reward is highway-env's."""
        taken = self._actions.translate(action)
        changes = self._actions.changes_lane(action)
        observation, _, ended, cut, info = super().step(taken)
        named = self._named_rewards(info, changes)
        on_road = info["off_road"] == 0.0
        infos = {**info, "action": action, "rewards": {**named, "on_road_reward": float(on_road)}}
        return observation[self._seen], self._reward(named) * on_road, ended, cut, infos

    def _named_rewards(self, info: Mapping[str, Any], changes_lane: bool) -> dict[str, float]:
        """Return the named rewards of this step, each about from 0 to 1."""
        low, high = self.config["reward_speed_range"]
        fast = float(np.clip((info["speed"] - low) / (high - low), 0.0, 1.0))
        right, merging_mps = self._lane_and_merging()
        arrived = float(info["arrival"])
        named = {
            "collision_reward": float(info["crashed"]),
            "right_lane_reward": right,
            "left_lane_reward": 1.0 - right,
            "high_speed_reward": fast,
            "lane_change_reward": float(changes_lane),
            "merging_speed_reward": merging_mps,
            "arrived_reward": arrived,
            "goal_reward": arrived,
        }
        return {name: named[name] for name in REWARDS if name in self.config}

    def _reward(self, named: Mapping[str, float]) -> float:
        total = sum(self.config[name] * value for name, value in named.items())
        if not self.config["normalize_reward"]:
            return float(total)
        worst = sum(min(self.config[name], 0.0) for name in self._task.worst)
        best = sum(self.config[name] for name in self._task.best)
        return float((total - worst) / (best - worst)) if best > worst else float(total)

    def _lane_and_merging(self) -> tuple[float, float]:
        """Return the place of the agent's lane, and the sum of the merging cars' speed deficits.

        The place is from 0 (leftmost lane) to 1 (rightmost lane). A car's deficit is the difference
        from the speed limit, as a share of the limit.
        """
        network = self._env.network
        rows = self._env.worlds.simulation.vehicles(0)
        own = rows[rows["driver"] == DRIVER_AGENT]
        right = 1.0
        if len(own):
            edge = network.edges[network.lanes["edge"][own["lane"][0]]]
            from_right = int(own["lane"][0]) - int(edge["first_lane"])
            right = 1.0 - from_right / max(int(edge["num_lanes"]) - 1, 1)
        merging = 0.0
        if self._task.merging:
            edge_row = network.edge_ids.index(self._task.merging)
            on_ramp = rows[network.lanes["edge"][rows["lane"]] == edge_row]
            limits = network.lanes["speed_mps"][on_ramp["lane"]]
            merging = float(np.sum((limits - on_ramp["speed"]) / limits))
        return right, merging


class _Actions:
    """highway-env's actions, translated to this package's.

    Args:
        settings: highway-env's settings, including `type`.

    Attributes:
        keys: keys of env.yaml.
        space: the action space.
        numbers: named action → its number.

    Raises ConfigError: a type or a setting is unknown.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        kind = settings.get("type")
        known = {
            "DiscreteMetaAction": ("longitudinal", "lateral", "target_speeds"),
            "ContinuousAction": ("longitudinal", "lateral", "acceleration_range", "steering_range",
                                 "clip"),
            "DiscreteAction": ("longitudinal", "lateral", "acceleration_range", "steering_range",
                               "actions_per_axis"),
        }  # fmt: skip
        if kind not in known:
            raise ConfigError(f"action.type = {kind!r}: must be one of {', '.join(known)}")
        _refuse_unknown("action", settings, ("type", *known[kind]))
        self._pedals = bool(settings.get("longitudinal", True))
        self._wheel = bool(settings.get("lateral", True))
        if not (self._pedals or self._wheel):
            raise ConfigError("action.longitudinal, action.lateral: at least one must be true")
        self.numbers: dict[str, int] = {}
        self._meta: list[int] = []
        self._choices: list[tuple[float, float]] = []
        self.space: gymnasium.Space[Any]
        if kind == "DiscreteMetaAction":
            self._make_meta(settings)
            return
        self.keys: dict[str, Any] = {
            "action.kind": "continuous",
            "action.out_of_range": "clip",
            "action.acceleration_mps2": _half("acceleration_range", settings, 5.0),
            "action.steering_rad": _half("steering_range", settings, np.pi / 4.0),
        }
        size = self._pedals + self._wheel
        if kind == "ContinuousAction":
            self.space = gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
            return
        steps = np.linspace(-1.0, 1.0, int(settings.get("actions_per_axis", 3)))
        mesh = np.stack(np.meshgrid(*[steps] * size, indexing="ij"), axis=-1).reshape(-1, size)
        self._choices = [self._pair(choice) for choice in mesh]
        self.space = gymnasium.spaces.Discrete(len(self._choices))

    def translate(self, action: Any) -> Any:
        """Return this package's action for an action of highway-env."""
        if isinstance(self.space, gymnasium.spaces.Discrete) and not self.space.contains(action):
            raise ConfigError(f"action = {action!r}: must be one of 0 to {self.space.n - 1}")
        if self._meta:
            return self._meta[int(action)]
        pair = self._choices[int(action)] if self._choices else self._pair(np.asarray(action))
        return np.array(pair, dtype=np.float32)

    def changes_lane(self, action: Any) -> bool:
        """Return whether a meta-action requests a lane change."""
        return bool(self._meta) and self._meta[int(action)] in (0, 2)

    def _make_meta(self, settings: Mapping[str, Any]) -> None:
        names: Iterable[str] = _META
        if not self._wheel:
            names = ("SLOWER", "IDLE", "FASTER")
        elif not self._pedals:
            names = _META[:3]
        self._meta = [_META.index(name) for name in names]
        self.numbers = {name: number for number, name in enumerate(names)}
        self.space = gymnasium.spaces.Discrete(len(self._meta))
        speeds = settings.get("target_speeds", [20, 25, 30])
        self.keys = {
            "action.kind": "discrete",
            "action.target_speeds_mps": [float(speed) for speed in speeds],
        }

    def _pair(self, action: Any) -> tuple[float, float]:
        """Return throttle and steering; highway-env's steering is positive to the right."""
        values = [float(value) for value in action]
        throttle = values.pop(0) if self._pedals else 0.0
        return throttle, -values.pop(0) if self._wheel else 0.0


def _whole_config(
    task: str, found: HighwayTask, config: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return all keys of a task with their values, some of them replaced by the caller."""
    if config is not None and not isinstance(config, Mapping):
        raise ConfigError(f"config = {config!r}: must be a mapping of highway-env's keys")
    whole = {**COMMON, **found.config}
    for key, value in (config or {}).items():
        if key in ("other_vehicles_type", "offroad_terminal", *DRAWING_KEYS):
            continue
        _refuse_unknown(f"{task}: config", {key: value}, (*whole, *REWARDS))
        is_same = isinstance(value, Mapping) and value.get("type") == whole[key].get("type")
        whole[key] = {**whole[key], **value} if is_same else value
    if whole["controlled_vehicles"] != 1:
        raise ConfigError(
            f"controlled_vehicles = {whole['controlled_vehicles']!r}: must be 1 in this view; "
            f"use cavmarl.parallel_env({found.entry!r}) for several agents"
        )
    return whole


def _observation(settings: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the sensor of an observation type, and its keys of env.yaml."""
    kind = str(settings.get("type"))
    if kind not in OBSERVATIONS:
        raise ConfigError(f"observation.type = {kind!r}: must be one of {', '.join(OBSERVATIONS)}")
    sensor, usual = OBSERVATIONS[kind]
    keys = {**usual, **settings}
    for name in ("type", "include_obstacles", "flatten"):
        keys.pop(name, None)
    return sensor, {f"sensors.{sensor}.{_UNITS.get(k, k)}": value for k, value in keys.items()}


def _clock(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys for the durations of ticks, steps and episodes."""
    policy, ticks = float(config["policy_frequency"]), float(config["simulation_frequency"])
    if policy <= 0.0 or ticks < policy:
        raise ConfigError(
            f"policy_frequency = {policy:g}, simulation_frequency = {ticks:g}: must be above 0, "
            "and simulation_frequency must not be below policy_frequency"
        )
    duration = float(config["duration"])
    if not 0.0 < duration < math.inf:
        raise ConfigError(f"duration = {duration:g}: must be above 0, in s")
    per_step = max(1, round(ticks / policy))
    step_s = 1.0 / policy
    return {
        "clock.sim_dt_s": step_s / per_step,
        "clock.ctrl_dt_s": step_s,
        "horizon_s": max(1, round(duration * policy)) * step_s,
    }


def _map(task: HighwayTask, config: Mapping[str, Any]) -> dict[str, Any]:
    if not task.maps:
        return {}
    lanes = config["lanes_count"]
    if lanes not in task.maps:
        raise ConfigError(
            f"lanes_count = {lanes!r}: must be one of {', '.join(map(str, task.maps))}; "
            "for another number, use your own map: overrides={'map.source': FILE}"
        )
    return {"map.source": task.maps[lanes]}


def _half(name: str, settings: Mapping[str, Any], usual: float) -> float:
    """Return the upper limit of a symmetric range; the action 1 stands for it."""
    low, high = settings.get(name, (-usual, usual))
    if low != -high or high <= 0.0:
        raise ConfigError(f"action.{name} = [{low}, {high}]: must be symmetric, like [-5, 5]")
    return float(high)


def _refuse_unknown(where: str, given: Mapping[str, Any], known: Iterable[str]) -> None:
    for key in given:
        if key not in known:
            raise ConfigError(
                f"{where}.{key}: unknown key; must be one of {', '.join(sorted(set(known)))}"
            )
