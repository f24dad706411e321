"""Gains from placing shards by load, on load traces of an environment.

Traces are generated on the environment's map, or recorded while it runs; `balance_replay` replays
each one through every placement strategy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any

import typer

from benchmarks.balance_replay import BalanceReplay, replay_traces
from benchmarks.load_traces import LoadTrace, generated_trace, recorded_trace
from benchmarks.program import run
from cavmarl.balance.problem import BalanceRule
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Seed, Settings, about, parse_settings
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.evaluate.built_in_runs import world_maker
from cavmarl.evaluate.shard_costs import measure_rounds
from cavmarl.evaluate.statistics import Interval
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_file import named_zones

ROUND_S = 10  # simulated seconds per recorded round
BEFORE_S = 20  # simulated seconds before the first round
AFTER_S = 1  # simulated seconds after the last round, so that no episode ends in the last round


def measure(
    env: Annotated[str, typer.Argument(help="Name, folder or map file of an environment.")],
    zones: Annotated[int, about("Number of zones.")] = 9,
    workers: Annotated[int, about("Number of workers that host the zones.")] = 3,
    layout: Annotated[str, about(f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")] = "bisection",
    recorded: Annotated[
        bool, about("Record the costs of zones while the environment runs.", "--recorded")
    ] = False,
    traces: Annotated[int, about("Number of traces, each with its own seed.", min=1)] = 10,
    rounds: Annotated[int, about("Rounds per trace; the first quarter is for learning.")] = 80,
    tolerance: Annotated[float, about("Imbalance below which nothing moves.")] = 0.1,
    max_moves: Annotated[int, about("Largest number of shards that move in one round.")] = 4,
    move_ms: Annotated[float, about("Assumed cost of moving a shard.")] = 10.0,
    seed: Seed = 0,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare static placement, balancing and its extensions on the same traces, by makespan."""
    rule = BalanceRule(tolerance=tolerance, max_moves=max_moves, move_s=1e-3 * move_ms)
    check_range(workers=(workers, 1, float("inf")))
    make = recorded_traces if recorded else generated_traces
    found: list[LoadTrace] = []
    for trace in make(
        env,
        zones=zones,
        layout=layout,
        workers=workers,
        rounds=rounds,
        seeds=range(seed, seed + traces),
        overrides=parse_settings(settings),
    ):
        found.append(trace)
        say(f"trace {len(found)} of {traces}")
    say("replaying")
    return _report(replay_traces(found, rule), "recorded" if recorded else "generated")


def _report(found: BalanceReplay, kind: str) -> BenchmarkReport:
    shown = [
        {
            **asdict(row),
            "time": _with_interval(row.ratio, row.ratio95),
            "beside": _with_interval(row.beside_balanced, row.beside_balanced95),
        }
        for row in found.rows
    ]
    placed = [row for row in found.rows if row.name not in ("static", "perfect")]
    verdicts = dict.fromkeys(row.verdict for row in placed)
    (fitted,) = (row.weights for row in placed if row.name == "calibrated")
    return BenchmarkReport(
        f"{found.map_name}: {found.zones} zones on {found.workers} workers, {found.traces} {kind} "
        f"traces of {found.rounds} rounds",
        {
            "placement": "name",
            "time / static": "time",
            "time / balanced": "beside",
            "max / mean": "imbalance:.2f",
            "moves": "moves:.2f",
            "handed over": "handoffs:.1f",
        },
        shown,
        notes=[
            *(
                f"{verdict}: {', '.join(row.name for row in placed if row.verdict == verdict)}"
                for verdict in verdicts
            ),
            "calibrated, mean: {:.2f} CPU + {:.2f} RAM + {:.2f} GPU".format(*fitted),
            "calibrated, predicted and repartitioned extend balanced; perfect: if every shard "
            f"could be divided at will; {found.ticks} ticks per round; assumed: "
            f"{1e3 * found.rule.move_s:g} ms per move, and the load of other programs on workers",
        ],
        facts={"recorded": kind == "recorded", "rule": asdict(found.rule), "ticks": found.ticks},
    )


def _with_interval(value: float, interval: Interval | None) -> str:
    if interval is None:
        return f"{value:.2f}"
    return f"{value:.2f} ({interval.low:.2f} to {interval.high:.2f})"


def generated_traces(
    env: str,
    *,
    zones: int,
    layout: str,
    workers: int,
    rounds: int,
    seeds: Sequence[int],
    overrides: Mapping[str, Any],
) -> Iterator[LoadTrace]:
    """Yield a trace for each seed: a generated crowd on the environment's map."""
    if overrides:
        raise ConfigError("--set: a generated crowd has no settings; add --recorded")
    network = load_network(find_map(env))
    partition = named_zones(network, layout, zones)
    for seed in seeds:
        yield generated_trace(network, partition, rounds=rounds, workers=workers, seed=seed)


def recorded_traces(
    env: str,
    *,
    zones: int,
    layout: str,
    workers: int,
    rounds: int,
    seeds: Sequence[int],
    overrides: Mapping[str, Any],
) -> Iterator[LoadTrace]:
    """Yield a trace for each seed: recorded costs of zones with built-in drivers."""
    for seed in seeds:
        simulation = world_maker(
            env,
            layout=layout,
            seconds=BEFORE_S + rounds * ROUND_S + AFTER_S,
            seed=seed,
            overrides=overrides,
        )(zones)
        clock = simulation.config.clock
        steps = max(round(ROUND_S / clock.ctrl_dt_s), 1)
        before = max(round(BEFORE_S / clock.ctrl_dt_s), 1)
        yield recorded_trace(
            simulation.network,
            simulation.partition,
            list(measure_rounds(simulation, rounds, steps, before=before)),
            ticks=steps * clock.ticks_per_step,
            workers=workers,
            seed=seed,
        )


if __name__ == "__main__":
    run(measure)
