"""One city over zone nodes: time and memory beside the undivided world, and a model of both."""

from __future__ import annotations

import math
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from benchmarks.harness import Report, Say, about, numbers_of, run, silent
from benchmarks.node_costs import NodeCosts, NodeSample, fitted
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError, require
from cavmarl.engine.world_setup import make_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.shards.shard import Commands
from cavmarl.verify.faulty_network import FaultyNetwork

PER_JUNCTION = 25  # vehicles
EDGE_M = 200
PREDICTED = (10_000, 100_000, 1_000_000, 10_000_000)
OVER = (1, 2, 4, 16, 64, 256)
WARM_STEPS = 3


def measure(
    vehicles: Annotated[str, about("Sizes of the city.", metavar="N,…")] = "2500,10000",
    nodes: Annotated[str, about("Numbers of nodes beside the undivided world.", metavar="N,…")] = (
        "1,2,4"
    ),
    latencies: Annotated[
        str, about("Latencies in ms that are added to all connections, too.", metavar="MS,…")
    ] = "",
    steps: Annotated[int, about("Steps of each turn.")] = 10,
    repeats: Annotated[int, about("Turns of each world, one after the other.")] = 5,
    say: Say = silent,
) -> Report:
    """Measure worlds by turns, fit a model to the runs with 0 to 2 nodes, and compare the rest."""
    if steps < 1 or repeats < 1:
        raise ConfigError(f"{steps} steps, {repeats} turns: must be at least 1")
    sizes, counts = numbers_of("--vehicles", vehicles), numbers_of("--nodes", nodes)
    added = [float(text) * 1e-3 for text in latencies.split(",") if text]
    if len(set(sizes)) < 2 or min(sizes) < PER_JUNCTION * 16 or not {1, 2} <= set(counts):
        raise ConfigError(
            f"--vehicles {vehicles} --nodes {nodes}: name two sizes from {PER_JUNCTION * 16} on, "
            "and among the nodes 1 and 2: the model is fitted to these"
        )
    samples: list[NodeSample] = []
    with tempfile.TemporaryDirectory() as folder:
        for size in sizes:
            net = make_city(Path(folder), size)
            say(f"a city of {size:,} vehicles")
            samples += _turns(net, size, counts, 0.0, steps, repeats)
            for latency_s in added if size == sizes[0] else []:
                say(f"with {1e3 * latency_s:g} ms of latency")
                samples += _turns(net, size, [2], latency_s, steps, repeats)
    known = [s for s in samples if s.nodes <= 2 and s.latency_s == 0.0]
    costs, cores = fitted(known), os.cpu_count() or 1
    rows = [_row(s, samples, costs, cores) for s in samples]
    return Report(
        f"a city over nodes, {cores} cores",
        {
            "vehicles": "vehicles:,",
            "nodes": "nodes",
            "+ ms": "latency_ms:g",
            "ms": "tick_ms:.3g",
            "faster": "ratio:.2f",
            "model": "model_ms:.3g",
            "off": "off:+.0%",
            "MB": "memory_mb:.0f",
            "share": "memory_share:.0%",
            "model, MB": "model_mb:.0f",
        },
        rows,
        notes=[
            "ms: a tick, median; + ms: latency added to each connection; faster: than undivided; "
            "MB: resident, the largest node; the models are fitted to runs with at most 2 nodes",
            *_predictions(costs, max(cores, max(OVER))),
        ],
        facts={"costs": costs.__dict__, "samples": [s.to_dict() for s in samples]},
    )


def _row(
    sample: NodeSample, samples: Sequence[NodeSample], costs: NodeCosts, cores: int
) -> dict[str, Any]:
    whole = next(s for s in samples if s.vehicles == sample.vehicles and s.nodes == 0)
    model_s = costs.tick(sample.vehicles, sample.nodes, sample.latency_s, cores)
    return {
        "vehicles": sample.vehicles,
        "nodes": sample.nodes or "undivided",
        "latency_ms": 1e3 * sample.latency_s,
        "tick_ms": 1e3 * sample.tick_s,
        "ratio": whole.tick_s / sample.tick_s,
        "model_ms": 1e3 * model_s,
        "off": model_s / sample.tick_s - 1.0,
        "memory_mb": sample.memory_bytes / 1e6,
        "memory_share": sample.memory_bytes / whole.memory_bytes,
        "model_mb": costs.memory(sample.vehicles, sample.nodes) / 1e6,
    }


def _predictions(costs: NodeCosts, cores: int) -> list[str]:
    """Where dividing pays, by the model, with a core for each node."""
    lines = []
    for vehicles in PREDICTED:
        found = {n: costs.tick(vehicles, n, 0.0, cores) for n in (0, *OVER)}
        best = min(found, key=lambda n: found[n])
        shown = ", ".join(
            f"{n}: {1e3 * s:.3g} ms, {costs.memory(vehicles, n) / 1e9:.2g} GB"
            for n, s in found.items()
        )
        pays = f"{best} nodes are the fastest" if best else "dividing does not pay"
        lines.append(f"{vehicles:,} vehicles by the model, a core for each node: {shown}; {pays}")
    return lines


def make_city(folder: Path, vehicles: int) -> Path:
    """A grid with room for so many."""
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


class _Side:
    """One world, that takes turns."""

    def __init__(self, net: Path, vehicles: int, nodes: int, network: FaultyNetwork | None) -> None:
        config, base_dir = load_config(
            net, zones=max(1, nodes), agents=1, background=vehicles - 1, max_cycles=1_000_000
        )
        world = make_world(config, base_dir)
        self.nodes = nodes
        self._worlds: LocalWorlds | NodeWorlds
        if nodes == 0:
            self._worlds = LocalWorlds(world, 1)
        elif network is None:
            self._worlds = NodeWorlds(world, base_dir, 1, nodes)
        else:
            self._worlds = NodeWorlds(world, base_dir, 1, nodes, route=network.route)
        self._ticks = config.clock.ticks_per_step
        self.vec = CavVectorEnv(self._worlds)
        self.vec.reset(seed=1)
        arrays = self.vec.worlds.arrays
        self._commands = Commands(arrays.controls, arrays.meta_actions)
        self._step(WARM_STEPS)
        self.turns: list[tuple[float, ...]] = []

    def _step(self, steps: int) -> None:
        for _ in range(steps):
            self._worlds.step(self._commands)

    def turn(self, steps: int) -> None:
        if isinstance(self._worlds, NodeWorlds):
            self._worlds.node_loads()
        cpu_s, wall_s, ticks = time.process_time(), time.perf_counter(), steps * self._ticks
        self._step(steps)
        wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
        if isinstance(self._worlds, NodeWorlds):
            loads = self._worlds.node_loads()
            dear = max(loads, key=lambda load: load.cpu_s)
            memory = max(load.memory_bytes for load in loads)
            parts = (dear.cpu_s / ticks, cpu_s / ticks, dear.vehicles, dear.ghosts, memory)
        else:
            parts = (cpu_s / ticks, 0.0, int(self.vec.simulation.running()[0]), 0, _resident())
        self.turns.append((wall_s / ticks, *map(float, parts)))

    def sample(self, vehicles: int, latency_s: float) -> NodeSample:
        found = (median(values) for values in zip(*self.turns, strict=True))
        return NodeSample(vehicles, self.nodes, latency_s, *found)


def _turns(
    net: Path, vehicles: int, counts: Sequence[int], latency_s: float, steps: int, repeats: int
) -> list[NodeSample]:
    """The undivided world and those over nodes, one turn after the other."""
    with _network(latency_s) as network:
        wanted = [0, *counts] if network is None else counts
        sides = [_Side(net, vehicles, n, network) for n in wanted]
        try:
            for _ in range(repeats):
                for side in sides:
                    side.turn(steps)
            return [side.sample(vehicles, latency_s) for side in sides]
        finally:
            for side in sides:
                side.vec.close()


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


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    run(measure)
