"""How fast a step is, next to others', on the same road with the same number of vehicles.

Every row of the comparison is measured once a turn, all rows one after the other, and the ratios
are those of the medians over the turns: what else the machine does falls on all of them. Times are
those of the processor that this process had, on one core, without what others took of it.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

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
from cavmarl.bench.peer_speed import check_compiler, peer_runners
from cavmarl.bench.speed_rows import Row, Runner
from cavmarl.core.errors import ConfigError, require
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.vector import CavVectorEnv, make_vec

__all__ = ["MORE", "Row", "StepSpeed", "measure_step_speed", "one_core"]

OUR_STEPS = 100  # from a fresh reset: nobody reaches the end of the road
THEIR_STEPS = 10
MORE = 10  # times as many agents, on a road as many times as long
MAX_AGENTS = 1000

_ONE = np.int64(IDLE)


@dataclass(frozen=True)
class StepSpeed:
    """Result of the comparison.

    Attributes:
        road_m: length of the road that `agents` vehicles were set out on, on both sides.
        repeats: turns.
        rows: what was measured.
        ratio: with a lidar, `batched` over `highway_env`.
        ratio_kinematics: without, `batched` over `highway_env`'s default observation.
        ratio_kinematics_raw: the same over its observation without normalisation.
        cost_of_more: what an agent costs among `MORE` times as many, over what it costs `batched`.
        dict_us: what the dict API adds for each agent and step to `single`, in µs.
        ratio_peer: with pufferlib's observation, `batched` over `c`; None where it is not measured.
        ratio_peer_native: the same over `c_native`.
    """

    road_m: float
    repeats: int
    rows: tuple[Row, ...]
    ratio: float
    ratio_kinematics: float
    ratio_kinematics_raw: float
    cost_of_more: float
    dict_us: float
    ratio_peer: float | None
    ratio_peer_native: float | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def measure_step_speed(
    agents: int = 100,
    worlds: int = 16,
    repeats: int = 5,
    peer: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> StepSpeed:
    """Measure by turns on one core, kernels warm.

    Args:
        agents: controlled vehicles a world.
        worlds: of ours, stepped together where they are batched.
        repeats: turns.
        peer: whether the peer in C is measured, too.
        progress: told what is going on.

    Raises:
        ConfigError: a number out of range.
        MissingExtraError: highway-env is not installed.
        EvaluationError: there is no C compiler for the peer.
    """
    limits = {"agents": (agents, MAX_AGENTS), "worlds": (worlds, 1024), "repeats": (repeats, 100)}
    for name, (value, most) in limits.items():
        if not 1 <= value <= most:
            raise ConfigError(f"{name} = {value}: must be from 1 to {most}")
    require("highway_env", "highway")
    if peer:
        check_compiler()
    with one_core(), tempfile.TemporaryDirectory() as folder:
        progress("making highway-env's worlds")
        theirs, road_m = _their_runners(agents)
        progress("making our worlds on that road")
        runners = _our_runners(Path(folder), road_m, agents, worlds) + theirs
        if peer:
            progress("making the peer's worlds on that road")
            runners += peer_runners(Path(folder), road_m, agents, worlds)
        turns = []
        for repeat in range(repeats):
            progress(f"measuring, {repeat + 1} of {repeats}")
            turns.append([runner.rate() for runner in runners])
    return _compare(
        road_m,
        repeats,
        [
            Row(
                runner.sensors,
                runner.who,
                runner.agents,
                runner.worlds,
                min(rates),
                median(rates),
                max(rates),
            )
            for runner, rates in zip(runners, zip(*turns, strict=True), strict=True)
        ],
    )


def _compare(road_m: float, repeats: int, rows: list[Row]) -> StepSpeed:
    """The ratios of what was measured."""
    found = {(row.sensors, row.who): row for row in rows}

    def ratio(sensors: str, one: str, other: str) -> float:
        return found[sensors, one].median / found[sensors, other].median

    def peer_ratio(who: str) -> float | None:
        return ratio("puffer_drive", "batched", who) if ("puffer_drive", who) in found else None

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
        ratio_peer=peer_ratio("c"),
        ratio_peer_native=peer_ratio("c_native"),
    )


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process on one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _our_runners(folder: Path, road_m: float, agents: int, worlds: int) -> list[Runner]:
    """Ours, each stepped twice before anything is measured."""
    road = straight_road(folder, road_m)
    long_road = straight_road(folder, road_m * MORE)
    runners = []
    for sensors, who, count, together in (
        ("lidar", "batched", agents, worlds),
        ("lidar", "single", agents, 1),
        ("kinematics", "batched", agents, worlds),
        ("kinematics", "single", agents, 1),
        ("kinematics", "more", agents * MORE, worlds),
    ):
        vec = make_vec(
            long_road if who == "more" else road,
            num_envs=together,
            agents=count,
            background=0,
            overrides=overrides(LIDAR if sensors == "lidar" else KINEMATICS, count),
        )
        _batched_rate(vec, 2)
        runners.append(Runner(sensors, who, count, together, partial(_batched_rate, vec)))
    env = parallel_env(road, agents=agents, background=0, overrides=overrides(KINEMATICS, agents))
    _dicts_rate(env, 2)
    runners.append(Runner("kinematics", "dicts", agents, 1, partial(_dicts_rate, env)))
    return runners


def _their_runners(agents: int) -> tuple[list[Runner], float]:
    """highway-env's, and the length of their road in m."""
    runners = []
    road_m = 0.0
    for sensors, who, observation in (
        ("lidar", "highway_env", THEIR_LIDAR),
        ("kinematics", "highway_env", THEIR_KINEMATICS),
        ("kinematics", "highway_env_raw", THEIR_RAW_KINEMATICS),
    ):
        env = highway_env(agents, observation)
        road_m = length_m(env)
        runners.append(Runner(sensors, who, agents, 1, partial(_their_rate, env, agents)))
    return runners, road_m


def _batched_rate(vec: CavVectorEnv, steps: int = OUR_STEPS) -> float:
    """Agent-steps a second from a fresh reset, which is not timed."""
    vec.reset(seed=0)
    actions = np.full((vec.num_envs, vec.num_agents), _ONE)
    decisions = 0
    began = time.process_time()
    for _ in range(steps):
        decisions += int(vec.step(actions)[4]["acted"].sum())
    return decisions / (time.process_time() - began)


def _dicts_rate(env: CavEnv, steps: int = OUR_STEPS) -> float:
    """The same through PettingZoo's dicts; nobody leaves, so the actions are ready as well."""
    env.reset(seed=0)
    actions = dict.fromkeys(env.agents, IDLE)
    decisions = 0
    began = time.process_time()
    for _ in range(steps):
        decisions += len(env.step(actions)[1])
    return decisions / (time.process_time() - began)


def _their_rate(env: Any, agents: int) -> float:
    env.reset(seed=0)
    actions = (IDLE,) * agents
    began = time.process_time()
    for _ in range(THEIR_STEPS):
        env.step(actions)
    return agents * THEIR_STEPS / (time.process_time() - began)
