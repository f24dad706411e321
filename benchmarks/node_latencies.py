"""How long an empty tick over nodes takes, and how long a killed node's zones stand still."""

from __future__ import annotations

import os
import random
import signal
import time
from statistics import median
from typing import Annotated, Any

import numpy as np

from benchmarks.harness import Env, Report, Say, about, check_positive, run, silent
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import make_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.shards.shard import Commands

TURN_STEPS = 50
LEAST_STEPS = 3  # of a round, before a node is killed
REPLACED_S = 120.0  # for another node to have joined


def measure(
    env: Env = "merge",
    nodes: Annotated[int, about("Nodes; as many zones.")] = 2,
    turns: Annotated[int, about(f"Turns of {TURN_STEPS} steps without traffic.")] = 20,
    kills: Annotated[int, about("Times that a node is killed.")] = 100,
    background: Annotated[int, about("Vehicles beside the agent while nodes are killed.")] = 20,
    seed: Annotated[int, about("Of the moments at which nodes are killed.")] = 0,
    say: Say = silent,
) -> Report:
    """Time ticks of a world with one vehicle; then kill nodes, and wait for the zones to go on."""
    check_positive("--turns", turns)
    check_positive("--kills", kills)
    if nodes < 2:
        raise ConfigError(f"--nodes {nodes}: of fewer than two none takes the zones of another")
    say("empty ticks")
    rows = _empty_ticks(env, nodes, turns)
    rows.append(_kills(env, nodes, kills, background, random.Random(seed), say))
    return Report(
        f"{nodes} nodes of this machine, {os.cpu_count()} cores",
        {
            "what": "what",
            "times": "times",
            "median": "median:.3g",
            "p99": "p99:.3g",
            "least": "least:.3g",
            "most": "most:.3g",
            "unit": "unit",
        },
        rows,
        notes=[
            "tick, wall: of a turn's ticks on average, by the clock; tick, processor: the same of "
            "the caller and of all nodes together; zones stand still: from SIGKILL to the "
            "end of the step of the caller that was under way or came next",
        ],
    )


class _Worlds:
    """One world over nodes, one zone each."""

    def __init__(self, env: str, nodes: int, background: int) -> None:
        config, base_dir = load_config(
            env, zones=nodes, agents=1, background=background, max_cycles=1_000_000
        )
        self.nodes = NodeWorlds(make_world(config, base_dir), base_dir, 1, nodes)
        self.ticks_per_step = config.clock.ticks_per_step
        self.vec = CavVectorEnv(self.nodes)
        self.vec.reset(seed=1)
        arrays = self.nodes.arrays
        self._commands = Commands(arrays.controls, arrays.meta_actions)

    def step(self) -> None:
        self.nodes.step(self._commands)

    def cpu_s(self) -> float:
        """Of the caller and of the nodes, since this was asked last."""
        return time.process_time() + sum(load.cpu_s for load in self.nodes.node_loads())


def _empty_ticks(env: str, nodes: int, turns: int) -> list[dict[str, Any]]:
    worlds = _Worlds(env, nodes, background=0)
    wall_us, cpu_us = [], []
    try:
        for turn in range(turns + 1):
            worlds.cpu_s()
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            for _ in range(TURN_STEPS):
                worlds.step()
            wall_s = time.perf_counter() - began_s
            cpu_s = worlds.cpu_s() - began_cpu_s
            if turn:  # the first one warms up
                ticks = TURN_STEPS * worlds.ticks_per_step
                wall_us.append(1e6 * wall_s / ticks)
                cpu_us.append(1e6 * cpu_s / ticks)
    finally:
        worlds.vec.close()
    return [_row("tick, wall", wall_us, "us"), _row("tick, processor", cpu_us, "us")]


def _kills(
    env: str, nodes: int, kills: int, background: int, draws: random.Random, say: Say
) -> dict[str, Any]:
    worlds = _Worlds(env, nodes, background)
    waited_ms = []
    try:
        for number in range(kills):
            for _ in range(LEAST_STEPS + draws.randrange(50)):
                worlds.step()
            recoveries, replacements = worlds.nodes.recoveries, worlds.nodes.replacements
            os.kill(worlds.nodes.pids[draws.randrange(nodes)], signal.SIGKILL)
            began_s = time.perf_counter()
            while worlds.nodes.recoveries == recoveries:
                worlds.step()
            waited_ms.append(1e3 * (time.perf_counter() - began_s))
            until_s = time.perf_counter() + REPLACED_S
            while worlds.nodes.replacements == replacements:
                worlds.step()
                if time.perf_counter() > until_s:
                    raise ConfigError(f"no other node has joined within {REPLACED_S:g} s")
            say(f"{number + 1} of {kills} nodes are killed, {waited_ms[-1]:.0f} ms")
    finally:
        worlds.vec.close()
    return _row("zones stand still", waited_ms, "ms")


def _row(what: str, values: list[float], unit: str) -> dict[str, Any]:
    return {
        "what": what,
        "times": len(values),
        "median": median(values),
        "p99": float(np.percentile(values, 99)),
        "least": min(values),
        "most": max(values),
        "unit": unit,
    }


if __name__ == "__main__":
    run(measure)
