"""Balance of zones that are cut again while a world runs, and the cost of a cut."""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, Settings, about, parse_settings
from cavmarl.core.errors import EvaluationError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.statistics import mean_interval

Floats = NDArray[np.float64]


def measure(
    env: OptionalEnvironment = "rush",
    zones: Annotated[int, about("Zones of each world.")] = 4,
    every: Annotated[int, about("Steps between checks of the zones.")] = 20,
    steps: Annotated[int, about("Steps per seed.")] = 300,
    seeds: Annotated[int, about("Number of seeds; at least two for an interval.")] = 5,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare static zones with zones that are cut again: balance, and cost."""
    most = float("inf")
    check_range(
        zones=(zones, 2, most), every=(every, 1, most), steps=(steps, 1, most),
        seeds=(seeds, 1, most),
    )  # fmt: skip
    common = {"zones.count": zones, **parse_settings(settings)}
    pair = {
        name: make_vec(env, overrides={**common, "zones.repartition_steps": often})
        for name, often in (("static", 0), ("repartitioned", every))
    }
    uneven: dict[str, list[float]] = {name: [] for name in pair}
    taken: dict[str, list[float]] = {name: [] for name in pair}
    vehicles = []
    for seed in range(seeds):
        say(f"seed {seed + 1} of {seeds}")
        for name, (imbalance, step_ms) in _run_beside(pair, seed, steps).items():
            uneven[name].append(float(imbalance.mean()))
            taken[name].append(float(np.median(step_ms)))
        if len({vec.state_hash() for vec in pair.values()}) > 1:
            raise EvaluationError(f"seed {seed}: the states of static and re-cut worlds differ")
        vehicles.append(int(pair["static"].simulation.running()[0]))
    rows = [_row(name, vec, uneven[name], taken[name]) for name, vec in pair.items()]
    ratios = np.array(uneven["repartitioned"]) / np.array(uneven["static"])
    interval = mean_interval(ratios)
    between = "" if interval is None else f" ({interval.low:.2f} to {interval.high:.2f})"
    mean = statistics.fmean(vehicles)
    return BenchmarkReport(
        f"{pair['static'].config.name}: {zones} zones, {mean:.0f} vehicles",
        {
            "zones": "name",
            "max / mean": "mean_imbalance:.2f",
            "95 % between seeds": "between",
            "step, ms": "median_ms:.2f",
            "re-cuts": "repartitions",
            "moved": "moved",
            "ms each": "repartition_ms:.1f",
        },
        rows,
        notes=[
            f"imbalance (fullest zone / mean), re-cut / static: {ratios.mean():.2f}{between}; "
            "both worlds have the same states"
        ],
        facts={
            "vehicles": mean,
            "ratios": ratios.tolist(),
            "ratio": float(ratios.mean()),
            "ratio95": None if interval is None else asdict(interval),
        },
    )


def _run_beside(
    pair: dict[str, CavVectorEnv], seed: int, steps: int
) -> dict[str, tuple[Floats, Floats]]:
    """Return (imbalance, ms) of each step, for both worlds."""
    found = {name: (np.zeros(steps), np.zeros(steps)) for name in pair}
    for vec in pair.values():
        vec.reset(seed=seed)
    for step in range(steps):
        for name, vec in pair.items():
            uneven, taken = found[name]
            actions = vec.suggest_actions()
            began = time.perf_counter()
            vec.step(actions)
            taken[step] = 1e3 * (time.perf_counter() - began)
            uneven[step] = vec.simulation.zones.loads().imbalance()[0]
    return found


def _row(name: str, vec: CavVectorEnv, uneven: list[float], taken: list[float]) -> dict[str, Any]:
    repartitions = vec.simulation.zones.repartitions
    interval = mean_interval(np.array(uneven))
    return {
        "name": name,
        "imbalance": uneven,
        "mean_imbalance": statistics.fmean(uneven),
        "between": None if interval is None else f"{interval.low:.2f} to {interval.high:.2f}",
        "step_ms": taken,
        "median_ms": statistics.median(taken),
        "repartitions": len(repartitions),
        "moved": sum(repartitioned.moved for repartitioned in repartitions),
        "repartition_ms": statistics.median(repartitioned.ms for repartitioned in repartitions)
        if repartitions
        else None,
    }


if __name__ == "__main__":
    run(measure)
