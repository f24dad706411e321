"""Speedup of one world in zones over several workers, compared with one process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Annotated, Any

from benchmarks.program import run
from benchmarks.worker_speed import Measured
from cavmarl.bench.harness import BenchmarkReport, Say, numbers_of, paired_ratio, silent
from cavmarl.cli.output import (
    Agents,
    Background,
    OptionalEnvironment,
    Seed,
    Settings,
    about,
    parse_settings,
)
from cavmarl.config.registry import load_config
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, EvaluationError


def measure(
    env: OptionalEnvironment = "rush",
    vehicles: Annotated[
        str, about("Numbers of vehicles [default: the environment's].", metavar="N,…")
    ] = "",
    workers: Annotated[int, about("Number of workers.")] = 2,
    zones: Annotated[int | None, about("Number of zones [default: one per worker].")] = None,
    agents: Agents = None,
    background: Background = None,
    steps: Annotated[int, about("Steps per turn.")] = 20,
    repeats: Annotated[int, about("Turns of each world.")] = 7,
    seed: Seed = 0,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare a world in turn: undivided, with zones on one worker, and on several workers."""
    if workers < 2 or steps < 1 or repeats < 1:
        raise ConfigError(
            f"{workers} workers, {steps} steps, {repeats} turns: must be at least 2, 1 and 1"
        )
    numbers = numbers_of("--vehicles", vehicles) if vehicles else [None]
    spec = WorldSpec(env=env, agents=agents, seed=seed, overrides=parse_settings(settings))
    rows = []
    for number in numbers:
        say(f"splitting one world{'' if number is None else f' of {number} vehicles'}")
        others = background
        if number is not None:
            config, _ = load_config(env, **spec.keywords)
            others = number - config.population.agents
            if others < 0:
                raise ConfigError(
                    f"{number} vehicles: must be at least the {config.population.agents} agents"
                )
        wanted = replace(spec, background=others)
        rows.append(_measured(wanted, zones or workers, workers, steps, repeats))
    line = split_line([(row["vehicles"], row["ratio"]) for row in rows])
    return BenchmarkReport(
        f"{env}: one world undivided, and in {zones or workers} zones over one and {workers} "
        "workers",
        {
            "vehicles": "vehicles",
            "undivided, ms": "undivided_median:.2f",
            "one worker, ms": "whole_median:.2f",
            "workers, ms": "split_median:.2f",
            "times faster": "ratio:.2f",
        },
        rows,
        notes=[
            "splitting one world does not pay on this machine"
            if line is None
            else f"splitting one world pays from {line} vehicles on"
        ],
        facts={"workers": workers, "zones": zones or workers, "split_pays_from": line},
    )


def split_line(found: Sequence[tuple[int, float]]) -> int | None:
    """Return the least number of vehicles from which all divided worlds were faster, or None."""
    line = None
    for vehicles, ratio in sorted(found, reverse=True):
        if ratio <= 1.0:
            break
        line = vehicles
    return line


def _measured(
    spec: WorldSpec, zones: int, workers: int, steps: int, repeats: int
) -> dict[str, Any]:
    measured: list[Measured] = []
    try:
        for count, parts in ((0, 1), (1, zones), (workers, zones)):
            measured.append(Measured(spec, count, zones=parts))
        for _ in range(repeats):
            for one in measured:
                one.count_turn(steps)
        hashes = {one.vec.state_hash() for one in measured}
        running = int(measured[0].vec.traffic_stats()["running"])
    finally:
        for one in measured:
            one.vec.close()
    if len(hashes) > 1:
        raise EvaluationError(f"{spec.env}: {zones} zones differ from the undivided world")
    undivided, whole, split = (one.row(repeats * steps).step_ms for one in measured)
    return {
        "vehicles": running,
        "undivided_ms": undivided,
        "whole_ms": whole,
        "split_ms": split,
        "undivided_median": median(undivided),
        "whole_median": median(whole),
        "split_median": median(split),
        "ratio": paired_ratio(undivided, split),
    }


if __name__ == "__main__":
    run(measure)
