"""Time of an empty tick over nodes, and the time until zones of a killed node continue."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from statistics import median
from typing import Annotated, Any

import numpy as np
from xxhash import xxh3_64_digest

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_positive, silent
from cavmarl.cli.output import OptionalEnvironment, about
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.core.processes import start_python
from cavmarl.engine.world_setup import make_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import NODES, BackendName
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.shards.shard import Commands

TURN_STEPS = 50
LEAST_STEPS = 3  # steps per round before a node is killed
REPLACED_S = 120.0  # time limit for a replacement node to join
LOCAL = "127.0.0.1"
FRAME = bytes(96)  # about the size of the messages of an empty tick
PORT_BYTES = 4
SUM_BYTES = 8  # size of a checksum
SERVES = "import sys; from benchmarks.node_latencies import serve; serve(*sys.argv[1:])"


def measure(
    env: OptionalEnvironment = "merge",
    nodes: Annotated[int, about("Number of nodes, and of zones.")] = 2,
    turns: Annotated[int, about(f"Turns of {TURN_STEPS} steps without traffic.")] = 20,
    kills: Annotated[int, about("Number of times that a node is killed.")] = 100,
    background: Annotated[int, about("Background vehicles while nodes are killed.")] = 20,
    seed: Annotated[int, about("Seed of the times at which nodes are killed.")] = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Time ticks of a nearly empty world; then kill nodes and time until the zones continue."""
    check_positive("--turns", turns)
    check_positive("--kills", kills)
    if nodes < 2:
        raise ConfigError(f"--nodes {nodes}: must be at least 2, so that a node can take over")
    say("empty ticks")
    rows = _empty_ticks(env, nodes, turns)
    rows.append(_kills(env, nodes, kills, background, random.Random(seed), say))
    return BenchmarkReport(
        f"{nodes} nodes of this machine, {os.cpu_count()} cores",
        {
            "what": "what",
            "times": "times",
            "median": "median:.3g",
            "p99": "p99:.3g",
            "lowest": "least:.3g",
            "highest": "most:.3g",
            "unit": "unit",
        },
        rows,
        notes=[
            "tick, wall: mean wall time of a tick; tick, processor: mean processor time of "
            "the caller and all nodes together; tick, least: lower bound of the wall time: the "
            "time of as many processes that exchange as many messages and each run the undivided "
            "world, measured in turn with the other times; zones stand still: time from "
            "SIGKILL to the end of the caller's current or next step",
        ],
    )


class _Worlds:
    """One world over nodes, with one zone each."""

    def __init__(self, env: str, nodes: int, background: int) -> None:
        config, base_dir = load_config(
            env, zones=nodes, agents=1, background=background, max_cycles=1_000_000
        )
        self.nodes = NodeWorlds(
            make_world(config, base_dir), base_dir, 1, BackendName(NODES, nodes)
        )
        self.ticks_per_step = config.clock.ticks_per_step
        self.vec = CavVectorEnv(self.nodes)
        self.vec.reset(seed=1)
        arrays = self.nodes.arrays
        self._commands = Commands(arrays.controls, arrays.meta_actions)

    def step(self) -> None:
        self.nodes.step(self._commands)

    def cpu_s(self) -> float:
        """Return processor time: the caller's since its start, the nodes' since the last call."""
        return time.process_time() + sum(load.cpu_s for load in self.nodes.node_loads())


def _empty_ticks(env: str, nodes: int, turns: int) -> list[dict[str, Any]]:
    worlds = _Worlds(env, nodes, background=0)
    least = _Least(env, nodes, worlds.ticks_per_step)
    wall_us, cpu_us, least_us = [], [], []
    try:
        for turn in range(turns + 1):
            worlds.cpu_s()
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            for _ in range(TURN_STEPS):
                worlds.step()
            wall_s = time.perf_counter() - began_s
            cpu_s = worlds.cpu_s() - began_cpu_s
            least_s = least.turn()
            if turn:  # the first turn warms up
                ticks = TURN_STEPS * worlds.ticks_per_step
                wall_us.append(1e6 * wall_s / ticks)
                cpu_us.append(1e6 * cpu_s / ticks)
                least_us.append(1e6 * least_s / ticks)
    finally:
        least.close()
        worlds.vec.close()
    found = {"tick, wall": wall_us, "tick, processor": cpu_us, "tick, least": least_us}
    return [_row(what, values, "us") for what, values in found.items()]


class _Least:
    """Processes that run an undivided world and exchange messages as nodes do in empty ticks.

    This process is the caller.
    """

    def __init__(self, env: str, nodes: int, ticks_per_step: int) -> None:
        with socket.create_server((LOCAL, 0)) as listener:
            words = [env, str(listener.getsockname()[1]), str(nodes), str(ticks_per_step)]
            self._processes: list[subprocess.Popen[Any]] = [
                start_python(["-c", SERVES, *words, str(number)]) for number in range(nodes)
            ]
            self._nodes = [_answered(listener) for _ in range(nodes)]
        ports = [_read(node, PORT_BYTES) for node in self._nodes]
        for node in self._nodes:
            node.sendall(b"".join(ports))
        self.turn()

    def turn(self) -> float:
        """Return the time of a turn, s."""
        began_s = time.perf_counter()
        for _ in range(TURN_STEPS):
            for node in self._nodes:
                node.sendall(_framed())
            for node in self._nodes:
                _take(node)
        return time.perf_counter() - began_s

    def close(self) -> None:
        for node in self._nodes:
            node.close()
        for process in self._processes:
            process.kill()
            process.wait()


def serve(env: str, port: str, nodes: str, ticks_per_step: str, number: str) -> None:
    """Run a node."""
    config, base_dir = load_config(env, agents=1, background=0, max_cycles=1_000_000)
    worlds = LocalWorlds(make_world(config, base_dir), 1, warm=True)
    worlds.arrays.chosen[:] = True
    worlds.reset(1, 0)
    commands = Commands(worlds.arrays.controls, worlds.arrays.meta_actions)
    caller = _call(int(port))
    with socket.create_server((LOCAL, 0)) as listener:
        own = listener.getsockname()[1].to_bytes(PORT_BYTES, "little")
        caller.sendall(own)
        data = _read(caller, PORT_BYTES * int(nodes))
        ports = [data[at : at + PORT_BYTES] for at in range(0, len(data), PORT_BYTES)]
        before = ports.index(own)
        others = [_call(int.from_bytes(one, "little")) for one in ports[:before]]
        others += [_answered(listener) for _ in ports[before + 1 :]]
    while True:
        _take(caller)
        for tick in range(int(ticks_per_step)):
            is_last = tick == int(ticks_per_step) - 1
            worlds.simulation.run_tick(commands, tick == 0, is_last)
            for _ in range(1 + is_last):  # rows; after the last tick also the outputs of agents
                for other in others:
                    other.sendall(_framed())
                for other in others:
                    _take(other)
        caller.sendall(_framed())


def _call(port: int) -> socket.socket:
    return _prompt(socket.create_connection((LOCAL, port)))


def _answered(listener: socket.socket) -> socket.socket:
    return _prompt(listener.accept()[0])


def _prompt(connection: socket.socket) -> socket.socket:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _framed() -> bytes:
    return FRAME + xxh3_64_digest(FRAME)


def _take(connection: socket.socket) -> None:
    data = _read(connection, len(FRAME) + SUM_BYTES)
    if xxh3_64_digest(data[:-SUM_BYTES]) != data[-SUM_BYTES:]:
        raise ConfigError("a received message differs from the sent one")


def _read(connection: socket.socket, size: int) -> bytes:
    data = connection.recv(size)
    while len(data) < size:
        more = connection.recv(size - len(data))
        if not more:
            sys.exit()  # the caller has ended
        data += more
    return data


def _kills(
    env: str, nodes: int, kills: int, background: int, draws: random.Random, say: Say
) -> dict[str, Any]:
    worlds = _Worlds(env, nodes, background)
    waited_ms = []
    try:
        for number in range(kills):
            for _ in range(LEAST_STEPS + draws.randrange(50)):
                worlds.step()
            recoveries, replacements = worlds.nodes.pool.recoveries, worlds.nodes.pool.replacements
            os.kill(worlds.nodes.pool.pids[draws.randrange(nodes)], signal.SIGKILL)
            began_s = time.perf_counter()
            while worlds.nodes.pool.recoveries == recoveries:
                worlds.step()
            waited_ms.append(1e3 * (time.perf_counter() - began_s))
            until_s = time.perf_counter() + REPLACED_S
            while worlds.nodes.pool.replacements == replacements:
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
