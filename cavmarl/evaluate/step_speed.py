"""How fast a step is, next to highway-env's, on the same road with the same number of vehicles.

Both sides drive N controlled vehicles by the meta-action IDLE on a straight road of four lanes, as
densely as highway-env sets them out, at 20 Hz with 10 decisions a second. They observe by a lidar
of 64 rays, distances and relative speeds over 60 m; nobody else is on the road.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from cavmarl.errors import ConfigError, require
from cavmarl.vector_env import CavVectorEnv, make_vec

__all__ = ["Rates", "StepSpeed", "measure_step_speed", "one_core"]

RAYS = 64
RANGE_M = 60.0
SIM_HZ = 20
CONTROL_HZ = 10
LANES = 4
LANE_WIDTH_M = 3.2
SPEED_MPS = 30.0
RUN_OUT_M = 1500.0
IDLE = 1
OUR_STEPS = 100
THEIR_STEPS = 10
MAX_AGENTS = 1000

_ONE = np.int64(IDLE)


@dataclass(frozen=True)
class Rates:
    """Agent-steps a second over the repeats."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class StepSpeed:
    """Result of the comparison.

    Attributes:
        agents: controlled vehicles a world, on both sides.
        worlds: how many of ours were stepped together in `batched`.
        road_m: length of the road that the vehicles were set out on, on both sides.
        repeats: measurements of each kind, by turns.
        batched: ours, `worlds` worlds.
        single: ours, one world.
        highway_env: highway-env, one world.
        ratio: of the medians, `batched` over `highway_env`.
        ratio_single: of the medians, `single` over `highway_env`.
    """

    agents: int
    worlds: int
    road_m: float
    repeats: int
    batched: Rates
    single: Rates
    highway_env: Rates
    ratio: float
    ratio_single: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def measure_step_speed(
    agents: int = 100,
    worlds: int = 16,
    repeats: int = 5,
    progress: Callable[[str], None] = lambda text: None,
) -> StepSpeed:
    """Measure by turns on one core: ours batched, ours alone, highway-env.

    Args:
        agents: controlled vehicles a world.
        worlds: of ours, stepped together.
        repeats: measurements of each.
        progress: told what is going on.

    Raises:
        ConfigError: a number out of range.
        MissingExtraError: highway-env is not installed.
    """
    limits = {"agents": (agents, MAX_AGENTS), "worlds": (worlds, 1024), "repeats": (repeats, 100)}
    for name, (value, most) in limits.items():
        if not 1 <= value <= most:
            raise ConfigError(f"{name} = {value}: must be from 1 to {most}")
    require("highway_env", "highway")
    with one_core(), tempfile.TemporaryDirectory() as folder:
        progress("making highway-env's road")
        theirs = _highway_env(agents)
        along = [vehicle.position[0] for vehicle in theirs.controlled_vehicles]
        road_m = float(max(along) - min(along)) + LANES * 10.0
        map_file = Path(folder) / "highway.net.xml"
        map_file.write_text(_straight_road(road_m), encoding="utf-8")
        progress("making our worlds on that road")
        batched, single = (_ours(map_file, agents, count) for count in (worlds, 1))
        rates: dict[str, list[float]] = {"batched": [], "single": [], "highway_env": []}
        for repeat in range(repeats):
            progress(f"measuring, {repeat + 1} of {repeats}")
            rates["batched"].append(_our_rate(batched, OUR_STEPS))
            rates["single"].append(_our_rate(single, OUR_STEPS))
            rates["highway_env"].append(_their_rate(theirs, agents))
    found = {
        name: Rates(min(values), median(values), max(values)) for name, values in rates.items()
    }
    return StepSpeed(
        agents=agents,
        worlds=worlds,
        road_m=road_m,
        repeats=repeats,
        **found,
        ratio=found["batched"].median / found["highway_env"].median,
        ratio_single=found["single"].median / found["highway_env"].median,
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


def _ours(map_file: Path, agents: int, worlds: int) -> CavVectorEnv:
    """Our worlds on that road, kernels warm."""
    vec = make_vec(
        map_file,
        num_envs=worlds,
        agents=agents,
        background=0,
        overrides={
            "clock.sim_dt_s": 1.0 / SIM_HZ,
            "clock.ctrl_dt_s": 1.0 / CONTROL_HZ,
            "action.kind": "discrete",
            "traffic.origins": ["road"],
            "traffic.destinations": ["end"],
            "sensors.route.points": 0,
            "sensors.neighbors.count": 0,
            "sensors.lidar.rays": RAYS,
            "sensors.lidar.range_m": RANGE_M,
            "sensors.lidar.speeds": True,
        },
    )
    vec.reset(seed=0)
    _our_rate(vec, 2)
    return vec


def _our_rate(vec: CavVectorEnv, steps: int) -> float:
    """Agent-steps a second from a fresh reset, which is not timed."""
    vec.reset(seed=0)
    actions = np.full((vec.num_envs, vec.num_agents), _ONE)
    decisions = 0
    began = time.perf_counter()
    for _ in range(steps):
        infos = vec.step(actions)[4]
        decisions += int(infos["acted"].sum())
    return decisions / (time.perf_counter() - began)


def _highway_env(agents: int) -> Any:
    """highway-env's own highway with that many controlled vehicles."""
    gymnasium = require("gymnasium", "highway")
    config = {
        "controlled_vehicles": agents,
        "vehicles_count": 0,
        "lanes_count": LANES,
        "duration": 1e9,
        "simulation_frequency": SIM_HZ,
        "policy_frequency": CONTROL_HZ,
        "offscreen_rendering": True,
        "action": {
            "type": "MultiAgentAction",
            "action_config": {"type": "DiscreteMetaAction"},
        },
        "observation": {
            "type": "MultiAgentObservation",
            "observation_config": {
                "type": "LidarObservation",
                "cells": RAYS,
                "maximum_range": RANGE_M,
            },
        },
    }
    env = gymnasium.make("highway-v0", config=config).unwrapped
    env.reset(seed=0)
    env.step((IDLE,) * agents)
    return env


def _their_rate(env: Any, agents: int) -> float:
    env.reset(seed=0)
    actions = (IDLE,) * agents
    began = time.perf_counter()
    for _ in range(THEIR_STEPS):
        env.step(actions)
    return agents * THEIR_STEPS / (time.perf_counter() - began)


def _straight_road(road_m: float) -> str:
    """A SUMO network: a straight `road`, and an `end` that nobody reaches while it is measured."""
    whole_m = road_m + RUN_OUT_M

    def lanes(edge: str, begin_m: float, end_m: float) -> str:
        return "".join(
            f'<lane id="{edge}_{k}" index="{k}" speed="{SPEED_MPS}" length="{end_m - begin_m:.2f}" '
            f'shape="{begin_m:.2f},{_lane_y(k):.2f} {end_m:.2f},{_lane_y(k):.2f}"/>'
            for k in range(LANES)
        )

    incoming = {edge: " ".join(f"{edge}_{k}" for k in range(LANES)) for edge in ("road", "end")}
    joins = "".join(
        f'<connection from="road" to="end" fromLane="{k}" toLane="{k}" dir="s" state="M"/>'
        for k in range(LANES)
    )
    nowhere = 'incLanes="" intLanes="" shape=""'
    return f"""<net version="1.20">
        <edge id="road" from="west" to="middle">{lanes("road", 0.0, road_m)}</edge>
        <edge id="end" from="middle" to="east">{lanes("end", road_m, whole_m)}</edge>
        <junction id="west" type="dead_end" x="0" y="0" {nowhere}/>
        <junction id="middle" type="priority" x="{road_m:.2f}" y="0"
            incLanes="{incoming["road"]}" intLanes="" shape=""/>
        <junction id="east" type="dead_end" x="{whole_m:.2f}" y="0"
            incLanes="{incoming["end"]}" intLanes="" shape=""/>
        {joins}
        </net>
        """


def _lane_y(index: int) -> float:
    """Of a lane's centre; lane 0 is the rightmost, driving to the east."""
    return (index - LANES) * LANE_WIDTH_M
