"""Time and memory of one city over zone nodes, compared with the undivided world and a model."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Annotated, Any, NamedTuple

from benchmarks.node_costs import NodeCosts, NodeSample, caches_here, fitted
from benchmarks.program import run
from benchmarks.world_processes import PER_JUNCTION, Turn, WorldProcess, make_city
from cavmarl.bench.harness import BenchmarkReport, Say, numbers_of, paired_interval, silent
from cavmarl.cli.output import about
from cavmarl.core.errors import ConfigError

PREDICTED = (10_000, 100_000, 1_000_000, 10_000_000)  # numbers of vehicles
OVER = (1, 2, 4, 16, 64, 256)  # numbers of nodes


def measure(
    vehicles: Annotated[str, about("Numbers of vehicles.", metavar="N,…")] = "2500,10000",
    nodes: Annotated[
        str, about("Numbers of nodes, besides the undivided world.", metavar="N,…")
    ] = ("1,2,4"),
    latencies: Annotated[
        str, about("Latencies in ms to add to all connections.", metavar="MS,…")
    ] = "",
    steps: Annotated[int, about("Steps per turn.")] = 5,
    repeats: Annotated[int, about("Turns of each world.")] = 40,
    realtime: Annotated[
        bool,
        about(
            "Run turns with real-time priority; other programs run between rounds.",
            "--realtime",
        ),
    ] = False,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure worlds in turn, fit a model to runs with 0 to 2 nodes, and predict the other runs.

    Each world has its own processes with the heap in huge pages. The worlds take turns in one order
    and then in reverse. The first steps of a turn are not measured, because other worlds have used
    the cache.
    """
    if steps < 1 or repeats < 1:
        raise ConfigError(f"{steps} steps, {repeats} turns: must be at least 1")
    sizes, counts = numbers_of("--vehicles", vehicles), numbers_of("--nodes", nodes)
    added = [float(text) * 1e-3 for text in latencies.split(",") if text]
    if len(set(sizes)) < 2 or min(sizes) < PER_JUNCTION * 16 or not {1, 2} <= set(counts):
        raise ConfigError(
            f"--vehicles {vehicles} --nodes {nodes}: give two sizes of at least "
            f"{PER_JUNCTION * 16}, and the nodes 1 and 2, to which the model is fitted"
        )
    sides = [_Side(size, n, s) for size in sizes for s in (0.0, *added) for n in counts]
    sides += [
        _Side(size, 0, 0.0) for size in sizes
    ]  # undivided worlds start last, because the divided ones load the maps
    turns = _turns(sides, steps, repeats, realtime, say)
    samples = {side: _sample(side, turns[side]) for side in sorted(sides)}
    known = [s for s in samples.values() if s.nodes <= 2 and s.latency_s == 0.0]
    costs, cores = fitted(known, caches_here()), os.cpu_count() or 1
    rows = [_row(side, samples, turns, costs, cores) for side in samples]
    return BenchmarkReport(
        f"a city over nodes, {cores} cores",
        {
            "vehicles": "vehicles:,",
            "nodes": "nodes",
            "+ ms": "latency_ms:g",
            "ms": "tick_ms:.3g",
            "faster": "ratio:.2f",
            "±": "interval:.2f",
            "model": "model_ms:.3g",
            "off": "off:+.0%",
            "MB": "memory_mb:.0f",
            "share": "memory_share:.0%",
            "model, MB": "model_mb:.0f",
        },
        rows,
        notes=[
            "ms: median tick; + ms: latency added to each connection; faster: speedup over the "
            "undivided world in adjacent turns, ± its 95 % interval; off: model / measured - 1; "
            "MB: resident memory of the largest process; share: of the undivided world's memory; "
            "the models are fitted to runs with at most 2 nodes",
            *_predictions(costs, max(cores, max(OVER))),
        ],
        facts={
            "costs": asdict(costs),
            "samples": [s.to_dict() for s in samples.values()],
            "turns": [[*side, [turn.tick_s for turn in turns[side]]] for side in samples],
        },
    )


class _Side(NamedTuple):
    """One world of the comparison."""

    vehicles: int
    nodes: int  # 0: undivided
    latency_s: float  # requested latency


def _turns(
    sides: Sequence[_Side], steps: int, repeats: int, is_realtime: bool, say: Say
) -> dict[_Side, list[Turn]]:
    found: dict[_Side, list[Turn]] = {side: [] for side in sides}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        nets = {size: make_city(Path(folder), size) for size in {side.vehicles for side in sides}}
        worlds: dict[_Side, WorldProcess] = {}
        for side in sides:
            say(f"{side.vehicles:,} vehicles, {side.nodes or 'no'} nodes")
            made = WorldProcess(nets[side.vehicles], *side, is_realtime)
            worlds[side] = stack.enter_context(closing(made))
        for number in range(repeats):
            say(f"turn {number + 1} of {repeats}")
            began_s = time.perf_counter()
            for side in sides if number % 2 == 0 else sides[::-1]:
                found[side].append(worlds[side].turn(steps))
            if is_realtime:
                time.sleep(time.perf_counter() - began_s)
    return found


def _sample(side: _Side, turns: Sequence[Turn]) -> NodeSample:
    found = Turn(*(median(values) for values in zip(*turns, strict=True)))
    return NodeSample(side.vehicles, side.nodes, **found._asdict())


def _row(
    side: _Side,
    samples: dict[_Side, NodeSample],
    turns: dict[_Side, list[Turn]],
    costs: NodeCosts,
    cores: int,
) -> dict[str, Any]:
    sample, alone = samples[side], _Side(side.vehicles, 0, 0.0)
    model_s = costs.tick(sample.vehicles, sample.nodes, sample.latency_s, cores)
    times = [[turn.tick_s for turn in turns[one]] for one in (alone, side)]
    ratio, interval = paired_interval(*times)
    return {
        "vehicles": sample.vehicles,
        "nodes": sample.nodes or "undivided",
        "latency_ms": 1e3 * side.latency_s,
        "latency_measured_ms": 1e3 * sample.latency_s,
        "tick_ms": 1e3 * sample.tick_s,
        "ratio": ratio,
        "interval": interval,
        "model_ms": 1e3 * model_s,
        "off": model_s / sample.tick_s - 1.0,
        "memory_mb": sample.memory_bytes / 1e6,
        "memory_share": sample.memory_bytes / samples[alone].memory_bytes,
        "model_mb": costs.memory(sample.vehicles, sample.nodes) / 1e6,
    }


def _predictions(costs: NodeCosts, cores: int) -> list[str]:
    """Return the model's times by size, with a core for each node, and whether dividing pays."""
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


if __name__ == "__main__":
    run(measure)
