"""Cities in separate processes that step on command and report their times."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.huge_pages import huge_heap
from cavmarl.core.processes import start_python
from cavmarl.engine.world_setup import make_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import NODES, BackendName
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.shards.shard import Commands
from cavmarl.verify.faulty_network import FaultyNetwork

PER_JUNCTION = 25  # vehicles per junction
EDGE_M = 200
FIRST_STEPS = 3  # steps after creation
WARM_STEPS = 2  # unmeasured steps of a turn, which fill the cache
PINGS = 40
PING = bytes(1 << 14)  # about the size of the nodes' messages in a tick
LOCAL = "127.0.0.1"
SERVES = "import sys; from benchmarks.world_processes import serve; serve(*sys.argv[1:])"


class Turn(NamedTuple):
    """Measurements of a number of steps of a world."""

    tick_s: float  # wall time
    node_s: float  # processor time per tick of the most expensive node; undivided: of the process
    caller_s: float  # processor time per tick of the caller
    own: float  # vehicles of the most expensive node
    ghosts: float  # ghosts of this node
    crossings: float  # vehicles that changed their node, per step
    memory_bytes: float  # resident memory of the largest process
    latency_s: float  # measured latency added to each connection
    ticks_per_step: float


class WorldProcess:
    """A city of a number of vehicles: undivided in its own process, or over nodes."""

    def __init__(
        self,
        net: Path,
        vehicles: int,
        nodes: int = 0,  # 0: undivided
        latency_s: float = 0.0,  # latency added to each connection
        is_realtime: bool = False,  # real-time priority in turns
    ) -> None:
        words = [str(net), str(vehicles), str(nodes), repr(latency_s), str(int(is_realtime))]
        self._process: subprocess.Popen[Any] = start_python(
            ["-c", SERVES, *words],
            env=huge_heap(),  # nodes have a huge heap, too
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            self._line()
        except BaseException:
            self.close()
            raise

    def go(self, steps: int) -> None:
        """Begin a turn."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{steps}\n")
        self._process.stdin.flush()

    def read(self) -> Turn:
        """Wait for the turn's result."""
        return Turn(*json.loads(self._line()))

    def turn(self, steps: int) -> Turn:
        self.go(steps)
        return self.read()

    def _line(self) -> str:
        assert self._process.stdout is not None
        line: str = self._process.stdout.readline()
        if not line:
            raise ConfigError("a process of the benchmark has ended; see its output")
        return line

    def close(self) -> None:
        with suppress(OSError):
            self._process.communicate("\n")


def make_city(folder: Path, vehicles: int) -> Path:
    """Generate a grid with room for the vehicles."""
    require("sumo", "sumo")
    import sumo

    side = max(4, round(math.sqrt(vehicles / PER_JUNCTION)))
    path = folder / f"city{vehicles}.net.xml"
    command = [
        str(Path(sumo.SUMO_HOME) / "bin" / "netgenerate"), "--grid", "--grid.number", str(side),
        "--grid.length", str(EDGE_M), "--default.lanenumber", "2", "--output-file", str(path),
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True)
    return path


def serve(net: str, vehicles: str, nodes: str, latency_s: str, is_realtime: str) -> None:
    """Run a world: each input line has a number of steps; an empty line ends the program."""
    with _network(float(latency_s)) as network:
        world = _World(Path(net), int(vehicles), int(nodes), network, bool(int(is_realtime)))
        try:
            print("ready", flush=True)
            while steps := sys.stdin.readline().strip():
                print(json.dumps(world.turn(int(steps))), flush=True)
        finally:
            world.vec.close()


class _World:
    """A world that takes turns."""

    def __init__(
        self,
        net: Path,
        vehicles: int,
        nodes: int,
        network: FaultyNetwork | None,
        is_realtime: bool,
    ) -> None:
        config, base_dir = load_config(
            net, zones=max(1, nodes), agents=1, background=vehicles - 1, max_cycles=1_000_000
        )
        world = make_world(config, base_dir)
        self._worlds: LocalWorlds | NodeWorlds
        if nodes == 0:
            self._worlds = LocalWorlds(world, 1)
        elif network is None:
            self._worlds = NodeWorlds(world, base_dir, 1, BackendName(NODES, nodes))
        else:
            self._worlds = NodeWorlds(
                world, base_dir, 1, BackendName(NODES, nodes), route=network.route
            )
        self._ticks = config.clock.ticks_per_step
        self._is_realtime = is_realtime
        self.vec = CavVectorEnv(self._worlds)
        self.vec.reset(seed=1)
        arrays = self.vec.worlds.arrays
        self._commands = Commands(arrays.controls, arrays.meta_actions)
        self._step(FIRST_STEPS)
        with self._priority():
            self._latency_s = 0.0 if network is None else _pinged(network) - _pinged(None)

    def _step(self, steps: int) -> None:
        for _ in range(steps):
            self._worlds.step(self._commands)

    def turn(self, steps: int) -> Turn:
        with self._priority():
            self._step(WARM_STEPS)
            return self._timed(steps)

    def _timed(self, steps: int) -> Turn:
        worlds, ticks = self._worlds, steps * self._ticks
        is_divided = isinstance(worlds, NodeWorlds)
        before = self._loads()[1]
        cpu_s, wall_s = time.process_time(), time.perf_counter()
        self._step(steps)
        wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
        loads, migrations = self._loads()
        if is_divided:
            dear = max(loads, key=lambda load: load.cpu_s)
            own, ghosts = float(dear.vehicles), float(dear.ghosts)
            memory = max(load.memory_bytes for load in loads)
            node_s, caller_s = dear.cpu_s, cpu_s
        else:
            own, ghosts, memory = float(self.vec.simulation.running()[0]), 0.0, _resident()
            node_s, caller_s = cpu_s, 0.0
        return Turn(
            tick_s=wall_s / ticks,
            node_s=node_s / ticks,
            caller_s=caller_s / ticks,
            own=own,
            ghosts=ghosts,
            crossings=(migrations - before) / steps,
            memory_bytes=memory,
            latency_s=self._latency_s,
            ticks_per_step=self._ticks,
        )

    def _loads(self) -> tuple[Sequence[Any], int]:
        """Return the loads of nodes since the last call, and all ownership changes so far."""
        if not isinstance(self._worlds, NodeWorlds):
            return (), 0
        return self._worlds.node_loads(), self._worlds.migrations

    @contextmanager
    def _priority(self) -> Iterator[None]:
        """Give this process and its nodes real-time priority, if requested."""
        if not self._is_realtime:
            yield
            return
        pids = [os.getpid(), *(getattr(self._worlds, "pids", ()))]
        _prefer(pids, os.SCHED_RR, 2)
        try:
            yield
        finally:
            _prefer(pids, os.SCHED_OTHER, 0)


def _prefer(pids: Sequence[int], policy: int, priority: int) -> None:
    for pid in pids:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread), policy, os.sched_param(priority))


@contextmanager
def _network(latency_s: float) -> Iterator[FaultyNetwork | None]:
    if latency_s == 0.0:
        yield None
        return
    network = FaultyNetwork(seed=0, latency_s=latency_s)
    try:
        yield network
    finally:
        network.close()


def _pinged(network: FaultyNetwork | None) -> float:
    """Return the median latency from one end of a connection to the other, s; None: no network."""
    with socket.create_server((LOCAL, 0)) as listener:
        place = listener.getsockname()
        with socket.create_connection(network.route(place) if network else place) as near:
            far = listener.accept()[0]
            with far:
                return median(_ping_s(near, far) for _ in range(PINGS))


def _ping_s(near: socket.socket, far: socket.socket) -> float:
    began_s, left = time.perf_counter(), len(PING)
    near.sendall(PING)
    while left:
        left -= len(far.recv(left))
    return time.perf_counter() - began_s


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
