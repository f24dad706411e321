"""highway-env's tasks: the entry of each task, and the default values of its `config`.

The values are taken from highway-env 1.10, except for observations that this package does not have:
`two-way` and `u-turn` observe times to collision in highway-env, and `Kinematics` here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

# Keys of all tasks.
COMMON: Mapping[str, Any] = {
    "observation": {"type": "Kinematics"},
    "action": {"type": "DiscreteMetaAction"},
    "simulation_frequency": 15,
    "policy_frequency": 1,
    "controlled_vehicles": 1,
    "normalize_reward": True,
    "reward_speed_range": [20, 30],
    "collision_reward": -1,
}

# Settings for rendering in highway-env, which are accepted and ignored.
DRAWING_KEYS = frozenset(
    (
        "screen_width", "screen_height", "centering_position", "scaling", "show_trajectories",
        "render_agent", "offscreen_rendering", "real_time_rendering", "manual_control",
    )
)  # fmt: skip

# Named rewards of tasks; `config` has their weights.
REWARDS = (
    "collision_reward",
    "right_lane_reward",
    "left_lane_reward",
    "high_speed_reward",
    "lane_change_reward",
    "merging_speed_reward",
    "arrived_reward",
    "goal_reward",
)


@dataclass(frozen=True)
class HighwayTask:
    """A task of highway-env.

    Attributes:
        entry: the environment of the task in `envs/`.
        config: highway-env's keys, in addition to `COMMON`.
        keys: keys of `env.yaml` that change the entry for the task.
        worst: names of the rewards in the worst step; `normalize_reward` maps their sum to 0.
        best: names of the rewards in the best step; `normalize_reward` maps their sum to 1.
        maps: number of lanes → map of the entry, if `lanes_count` selects one.
        merging: edge from which vehicles merge.
    """

    entry: str
    config: Mapping[str, Any]
    keys: Mapping[str, Any] = field(default_factory=dict)
    worst: tuple[str, ...] = ("collision_reward",)
    best: tuple[str, ...] = ("high_speed_reward",)
    maps: Mapping[int, str] = field(default_factory=dict)
    merging: str = ""


_HIGHWAY = {
    "lanes_count": 4,
    "vehicles_count": 50,
    "duration": 40,
    "right_lane_reward": 0.1,
    "high_speed_reward": 0.4,
    "lane_change_reward": 0,
}
_HIGHWAY_KEYS = {"traffic.origins": ["e0"], "traffic.min_trip_m": 1200.0}
_LANES = {3: "map/three_lanes.net.xml", 4: "map/map.net.xml"}
_WIDE = ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"]

TASKS: Mapping[str, HighwayTask] = {
    "highway": HighwayTask(
        "highway",
        _HIGHWAY,
        _HIGHWAY_KEYS,
        best=("high_speed_reward", "right_lane_reward"),
        maps=_LANES,
    ),
    "highway-fast": HighwayTask(
        "highway",
        {
            **_HIGHWAY,
            "simulation_frequency": 5,
            "lanes_count": 3,
            "vehicles_count": 20,
            "duration": 30,
        },
        _HIGHWAY_KEYS,
        best=("high_speed_reward", "right_lane_reward"),
        maps=_LANES,
    ),
    "merge": HighwayTask(
        "merge",
        {
            "vehicles_count": 6,
            "duration": 60,
            "right_lane_reward": 0.1,
            "high_speed_reward": 0.2,
            "merging_speed_reward": -0.5,
            "lane_change_reward": -0.05,
        },
        {"traffic.origins": ["main_in"]},
        worst=("collision_reward", "merging_speed_reward"),
        best=("high_speed_reward", "right_lane_reward"),
        merging="ramp",
    ),
    "roundabout": HighwayTask(
        "roundabout",
        {
            "observation": {
                "type": "Kinematics",
                "absolute": True,
                "features_range": {
                    "x": [-100, 100],
                    "y": [-100, 100],
                    "vx": [-15, 15],
                    "vy": [-15, 15],
                },
            },
            "action": {"type": "DiscreteMetaAction", "target_speeds": [0, 8, 16]},
            "vehicles_count": 5,
            "duration": 11,
            "reward_speed_range": [0, 16],
            "high_speed_reward": 0.2,
            "right_lane_reward": 0,
            "lane_change_reward": -0.05,
        },
        {"traffic.origins": ["south_in"]},
    ),
    "intersection": HighwayTask(
        "intersection",
        {
            "observation": {
                "type": "Kinematics",
                "vehicles_count": 15,
                "features": _WIDE,
                "features_range": {
                    "x": [-100, 100],
                    "y": [-100, 100],
                    "vx": [-20, 20],
                    "vy": [-20, 20],
                },
                "absolute": True,
                "observe_intentions": False,
            },
            "action": {
                "type": "DiscreteMetaAction",
                "longitudinal": True,
                "lateral": False,
                "target_speeds": [0, 4.5, 9],
            },
            "vehicles_count": 10,
            "duration": 13,
            "collision_reward": -5,
            "high_speed_reward": 1,
            "arrived_reward": 1,
            "reward_speed_range": [7, 9],
            "normalize_reward": False,
        },
        {"traffic.origins": ["south_in"], "population.mode": "respawn"},
        best=("arrived_reward",),
    ),
    "exit": HighwayTask(
        "exit",
        {
            "observation": {
                "type": "Kinematics",
                "vehicles_count": 15,
                "features": _WIDE,
                "clip": False,
            },
            "action": {"type": "DiscreteMetaAction", "target_speeds": [18, 24, 30]},
            "simulation_frequency": 5,
            "vehicles_count": 20,
            "duration": 30,
            "collision_reward": 0,
            "high_speed_reward": 0.1,
            "right_lane_reward": 0,
            "goal_reward": 1,
        },
        {"traffic.destinations": ["ramp"]},
        best=("goal_reward",),
    ),
    "two-way": HighwayTask(
        "two-way",
        {
            "vehicles_count": 10,
            "duration": 15,
            "collision_reward": 0,
            "high_speed_reward": 0.8,
            "left_lane_reward": 0.2,
            "normalize_reward": False,
        },
        {"traffic.origins": ["e0"], "traffic.destinations": ["e2"]},
    ),
    "u-turn": HighwayTask(
        "u-turn",
        {
            "action": {"type": "DiscreteMetaAction", "target_speeds": [8, 16, 24]},
            "vehicles_count": 6,
            "duration": 30,
            "reward_speed_range": [8, 24],
            "left_lane_reward": 0.1,
            "high_speed_reward": 0.4,
        },
        best=("high_speed_reward", "left_lane_reward"),
    ),
}
