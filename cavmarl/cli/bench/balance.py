"""`cavmarl bench balance`: what placing shards by load saves, on traces of loads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import Environment, JsonPath, Seed, Settings, parse_settings, write_json
from cavmarl.config.env import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.balance_replay import BalanceReplay
    from cavmarl.bench.load_traces import LoadTrace
    from cavmarl.bench.selection_study import SelectionStudy
    from cavmarl.evaluate.statistics import Interval

__all__ = ["balance"]


def balance(
    env: Environment,
    zones: Annotated[int, typer.Option(help="That the map is cut into.")] = 9,
    workers: Annotated[int, typer.Option(help="That host them.")] = 3,
    layout: Annotated[
        str, typer.Option(help=f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")
    ] = "bisection",
    recorded: Annotated[
        bool,
        typer.Option(
            "--recorded", help="Record what zones cost while the environment runs, not a crowd."
        ),
    ] = False,
    traces: Annotated[int, typer.Option(min=1, help="Each from a seed of its own.")] = 10,
    rounds: Annotated[int, typer.Option(help="Of each; the first quarter is to learn from.")] = 80,
    tolerance: Annotated[float, typer.Option(help="Imbalance below which nothing moves.")] = 0.1,
    max_moves: Annotated[int, typer.Option(help="Shards that move in one round.")] = 4,
    move_ms: Annotated[float, typer.Option(help="Supposed price of a shard's move.")] = 10.0,
    seed: Seed = 0,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Static, balanced and the extensions on the same traces: makespans beside the static one's."""
    from cavmarl.balance.problem import BalanceRule
    from cavmarl.bench.balance_replay import replay_traces
    from cavmarl.bench.balance_worlds import generated_traces, recorded_traces
    from cavmarl.bench.selection_study import study_selection

    rule = BalanceRule(tolerance=tolerance, max_moves=max_moves, move_s=1e-3 * move_ms)
    if workers < 1:
        raise ConfigError(f"workers = {workers}: must be at least 1")
    console = Console()
    with console.status("") as status:
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
            status.update(f"trace {len(found)} of {traces}")
        status.update("replaying")
        replay = replay_traces(found, rule)
        status.update("choosing")
        study = study_selection(seed=seed)
    console.print(_replay_table(replay, recorded))
    console.print(_verdicts(replay))
    console.print(_weights_table(study))
    write_json(
        json_path,
        {"recorded": recorded, "replay": replay.to_dict(), "selection": study.to_dict()},
    )


def _replay_table(found: BalanceReplay, recorded: bool) -> Table:
    table = Table(
        "",
        title=(
            f"{found.map_name}: {found.zones} zones on {found.workers} workers, {found.traces} "
            f"{'recorded' if recorded else 'generated'} traces of {found.rounds} rounds"
        ),
        caption=(
            "time: waiting for the slowest, all rounds, over static's; [95 % between traces]\n"
            "calibrated, predicted, re-cut: extensions of balanced; perfect: no shard whole\n"
            f"supposed: {1e3 * found.rule.move_s:g} ms a move, {found.ticks} ticks a round, "
            "what others use of workers"
        ),
    )
    for column in ("time", "beside balanced", "max /\nmean", "moves", "handed\nover"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in found.rows:
        table.add_row(
            row.name,
            _with_interval(row.ratio, row.ratio95),
            _with_interval(row.beside_balanced, row.beside_balanced95),
            f"{row.imbalance:.2f}",
            f"{row.moves:.2f}",
            f"{row.handoffs:.1f}",
        )
    return table


def _verdicts(found: BalanceReplay) -> str:
    """Who takes less or more time than the static placement; what weights were fitted."""
    placed = [row for row in found.rows if row.name not in ("static", "perfect")]
    verdicts = dict.fromkeys(row.verdict for row in placed)
    (fitted,) = (row.weights for row in placed if row.name == "calibrated")
    cpu, ram, gpu = fitted
    return "\n".join(
        [
            *(
                f"{verdict}: {', '.join(row.name for row in placed if row.verdict == verdict)}"
                for verdict in verdicts
            ),
            f"calibrated, mean: {cpu:.2f} CPU + {ram:.2f} RAM + {gpu:.2f} GPU",
        ]
    )


def _weights_table(study: SelectionStudy) -> Table:
    latency = ", ".join(f"{name} {value:.0f} µs" for name, value in study.latency_us.items())
    table = Table(
        "weights",
        title=f"weights beside 0.6, 0.2, 0.2: {study.choices} choices of {study.workers}",
        caption=f"one choice of {study.timed_workers} workers: {latency}",
    )
    table.add_column("other choice", justify="right")
    table.add_column("its score above\nthe best, mean", justify="right")
    for effect in study.effects:
        table.add_row(
            ", ".join(f"{weight:.2f}" for weight in effect.weights),
            _with_interval(effect.changed, effect.changed95),
            f"{effect.regret:.3f}",
        )
    return table


def _with_interval(value: float, interval: Interval | None) -> str:
    if interval is None:
        return f"{value:.2f}"
    return f"{value:.2f} \\[{interval.low:.2f}, {interval.high:.2f}]"
