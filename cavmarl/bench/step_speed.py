"""Speed of a step compared with highway-env, on the same road with the same number of vehicles.

Times are processor times of this process, on one core.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.bench.harness import Say, check_range, one_core, silent, spread, take_turns
from cavmarl.bench.highway_worlds import (
    IDLE,
    KINEMATICS,
    LIDAR,
    THEIR_KINEMATICS,
    THEIR_LIDAR,
    THEIR_RAW_KINEMATICS,
    highway_env,
    length_m,
    overrides,
    straight_road,
)
from cavmarl.core.errors import require
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.vector import CavVectorEnv, make_vec

__all__ = ["MORE", "Row", "StepSpeed", "measure_step_speed", "one_core"]

OUR_STEPS = 100  # number of steps from a reset; no vehicle reaches the end of the road
THEIR_STEPS = 10  # the same for highway-env
MORE = 10  # factor of agents and of road length in the larger world
MAX_AGENTS = 1000

# sensors, side, factor of agents, whether worlds are batched
OURS = (
    ("lidar", "batched", 1, True),
    ("lidar", "single", 1, False),
    ("kinematics", "batched", 1, True),
    ("kinematics", "single", 1, False),
    ("kinematics", "more", MORE, True),
)
THEIRS = (
    ("lidar", "highway_env", THEIR_LIDAR),
    ("kinematics", "highway_env", THEIR_KINEMATICS),
    ("kinematics", "highway_env_raw", THEIR_RAW_KINEMATICS),
)


@dataclass(frozen=True)
class Row:
    """Measurements of one way to step one kind of world."""

    sensors: str  # `lidar` (with neighbours) or `kinematics`
    # cavmarl: `batched`, `single` (one world), `more` (agents), `dicts` (PettingZoo);
    # highway-env: `highway_env`, or `highway_env_raw` (observations are not normalised)
    side: str
    agents: int  # controlled vehicles per world
    worlds: int  # worlds stepped together
    low: float  # agent-steps per second, slowest turn
    median: float  # median of the turns
    high: float  # fastest turn

    @property
    def agent_step_s(self) -> float:
        """Median time of an agent-step, s."""
        return 1.0 / self.median


@dataclass(frozen=True)
class StepSpeed:
    """Result of the comparison."""

    road_m: float  # length of the road of `agents` vehicles, on both sides
    repeats: int  # number of turns
    rows: tuple[Row, ...]  # all measurements
    ratio: float  # `batched` over `highway_env`, with lidar
    ratio_kinematics: float  # `batched` over `highway_env`, with its default observation
    ratio_kinematics_raw: float  # like `ratio_kinematics`, but without normalisation
    cost_of_more: float  # cost per agent with `MORE` times the agents, over the cost of `batched`
    dict_us: float  # µs that the dict API adds to the time of `single`, per agent and step


def measure_step_speed(
    agents: int = 100, worlds: int = 16, repeats: int = 5, progress: Say = silent
) -> StepSpeed:
    """Measure all sides in turn on one core, with warm kernels."""
    check_range(agents=(agents, 1, MAX_AGENTS), worlds=(worlds, 1, 1024), repeats=(repeats, 1, 100))
    require("highway_env", "bench")
    with one_core(), tempfile.TemporaryDirectory() as folder:
        progress("creating highway-env's worlds")
        theirs = {(sensors, side): highway_env(agents, seen) for sensors, side, seen in THEIRS}
        road_m = max(map(length_m, theirs.values()))
        progress("creating cavmarl's worlds on that road")
        sides = our_sides(Path(folder), road_m, agents, worlds)
        for key, env in theirs.items():
            sides[key] = (agents, 1, partial(their_rate, env, agents))
        turns = take_turns({key: rate for key, (_, _, rate) in sides.items()}, repeats, progress)
    rows = []
    for (sensors, side), (count, together, _) in sides.items():
        rates = spread(turns[sensors, side])
        rows.append(Row(sensors, side, count, together, rates.low, rates.median, rates.high))
    return compare(road_m, repeats, rows)


def compare(road_m: float, repeats: int, rows: list[Row]) -> StepSpeed:
    """Compute the ratios of the median rates."""
    found = {(row.sensors, row.side): row for row in rows}

    def ratio(sensors: str, one: str, other: str) -> float:
        return found[sensors, one].median / found[sensors, other].median

    added_s = found["kinematics", "dicts"].agent_step_s - found["kinematics", "single"].agent_step_s
    return StepSpeed(
        road_m=road_m,
        repeats=repeats,
        rows=tuple(rows),
        ratio=ratio("lidar", "batched", "highway_env"),
        ratio_kinematics=ratio("kinematics", "batched", "highway_env"),
        ratio_kinematics_raw=ratio("kinematics", "batched", "highway_env_raw"),
        cost_of_more=ratio("kinematics", "batched", "more"),
        dict_us=added_s * 1e6,
    )


def our_sides(
    folder: Path, road_m: float, agents: int, worlds: int
) -> dict[tuple[str, str], tuple[int, int, Callable[[], float]]]:
    """Return agents, worlds and a function that measures the rate, by sensors and side."""
    sides: dict[tuple[str, str], tuple[int, int, Callable[[], float]]] = {}
    for sensors, side, times, is_batched in OURS:
        count, together = times * agents, worlds if is_batched else 1
        vec = make_vec(
            straight_road(folder, road_m * times),
            num_envs=together,
            agents=count,
            background=0,
            overrides=overrides(LIDAR if sensors == "lidar" else KINEMATICS, count),
        )
        batched_rate(vec, 2)
        sides[sensors, side] = (count, together, partial(batched_rate, vec))
    road = straight_road(folder, road_m)
    env = parallel_env(road, agents=agents, background=0, overrides=overrides(KINEMATICS, agents))
    dicts_rate(env, 2)
    sides["kinematics", "dicts"] = (agents, 1, partial(dicts_rate, env))
    return sides


def batched_rate(vec: CavVectorEnv, steps: int = OUR_STEPS) -> float:
    """Return agent-steps per second from a fresh reset, which is not timed."""
    vec.reset(seed=0)
    actions = np.full((vec.num_envs, vec.num_agents), np.int64(IDLE))
    decisions = 0
    began = time.process_time()
    for _ in range(steps):
        decisions += int(vec.step(actions)[4]["acted"].sum())
    return decisions / (time.process_time() - began)


def dicts_rate(env: CavEnv, steps: int = OUR_STEPS) -> float:
    """Return the rate through PettingZoo's dicts; agents that have ended are left out."""
    env.reset(seed=0)
    actions = dict.fromkeys(env.agents, IDLE)
    decisions = 0
    began = time.process_time()
    for _ in range(steps):
        decisions += len(env.step(actions)[1])
        if len(env.agents) != len(actions):
            actions = dict.fromkeys(env.agents, IDLE)
            if not actions:
                break
    return decisions / (time.process_time() - began)


def their_rate(env: Any, agents: int) -> float:
    """Return the agent-steps per second of highway-env from a fresh reset, which is not timed."""
    env.reset(seed=0)
    actions = (IDLE,) * agents
    began = time.process_time()
    for _ in range(THEIR_STEPS):
        env.step(actions)
    return agents * THEIR_STEPS / (time.process_time() - began)
