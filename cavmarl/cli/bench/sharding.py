"""`cavmarl bench sharding`: what it costs to divide a world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import (
    Agents,
    Background,
    Environment,
    JsonPath,
    Seed,
    Settings,
    number,
    parse_settings,
    print_error,
    write_json,
)
from cavmarl.config.env import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError, EvaluationError

if TYPE_CHECKING:
    from cavmarl.bench.sharding_speed import ShardingSpeed
    from cavmarl.engine.simulation import Simulation

__all__ = ["sharding"]


def sharding(
    env: Environment,
    demand: Annotated[
        list[Path] | None,
        typer.Option(
            "--demand", "-d", help="A .rou.xml, .add.xml or .sumocfg, for nobody else; repeatable."
        ),
    ] = None,
    zones: Annotated[str, typer.Option(help="How many, with commas; 1 is measured, too.")] = "1,4",
    layout: Annotated[
        str, typer.Option(help=f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")
    ] = "bisection",
    agents: Agents = None,
    background: Background = None,
    after: Annotated[int, typer.Option(help="Simulated seconds before the first turn.")] = 120,
    repeats: Annotated[int, typer.Option(help="Turns of 10 simulated seconds of each.")] = 5,
    check: Annotated[
        bool, typer.Option("--check", help="What the monitor of invariants costs, too.")
    ] = False,
    seed: Seed = 0,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """The same world in several numbers of zones, by phases; exit code 1 if they differ."""
    from cavmarl.bench.sharded_worlds import world_maker
    from cavmarl.bench.sharding_speed import TURN_S, check_numbers, measure_sharding

    counts = _counts(zones)
    check_numbers(counts, after, repeats)
    if demand and (agents, background) != (None, None):
        raise ConfigError("--demand: its vehicles are alone; leave --agents and --background out")
    console = Console()
    with console.status("reading") as status:

        def maker(**more: Any) -> Callable[[int], Simulation]:
            return world_maker(
                env,
                demand or (),
                layout=layout,
                seconds=after + (repeats + 1) * TURN_S,
                seed=seed,
                agents=agents,
                background=background,
                overrides={**parse_settings(settings), **more},
            )

        try:
            found = measure_sharding(
                maker(),
                counts,
                after_s=after,
                repeats=repeats,
                make_checked=maker(**{"zones.check": True}) if check else None,
                progress=status.update,
            )
        except EvaluationError as error:
            print_error(str(error))
            raise typer.Exit(1) from error
    console.print(_loads(found))
    console.print(_phases(found))
    write_json(json_path, found.to_dict())


def _counts(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"--zones {text}: must be whole numbers with commas, as 1,4,9") from error


def _loads(found: ShardingSpeed) -> Table:
    first = found.rows[0]
    table = Table(
        title=(
            f"{found.map_name}, {first.vehicles:,.0f} vehicles, {found.agents} of them agents, "
            f"halo {first.halo_m:.0f} m"
        ),
        caption=(
            "zone: side of a square of mean area; fullest: rows of the fullest zone,\n"
            "ghosts among them, over all vehicles; states of all worlds are equal"
        ),
    )
    for column in (
        "zones", "zone,\nm", "ghosts", "ghosts a\nvehicle", "max /\nmean", "fullest",
        "moves\na tick", "µs a\nmove", "cost",
    ):  # fmt: skip
        table.add_column(column, justify="right", no_wrap=True)
    for row in found.rows:
        table.add_row(
            str(row.zones),
            f"{row.side_m:,.0f}",
            f"{row.ghosts:,.0f}",
            number(row.ghosts / row.vehicles),
            number(row.imbalance),
            f"{row.largest_share:.0%}",
            number(row.migrations),
            number(row.migration_us),
            number(row.ratio),
        )
    return table


def _phases(found: ShardingSpeed) -> Table:
    table = Table(
        "ns a vehicle and tick",
        title=(
            f"one core, {found.repeats} turns after {found.after_s} s, ticks of {found.dt_s:g} s"
        ),
    )
    for row in found.rows:
        table.add_column(f"{row.zones} zone{'' if row.zones == 1 else 's'}", justify="right")
    for name in found.rows[0].phases:
        table.add_row(name, *(f"{row.phases[name]:,.1f}" for row in found.rows))
    table.add_section()
    table.add_row("sum", *(f"{row.timed_ns:,.1f}" for row in found.rows))
    table.add_row("without stopwatches", *(f"{row.plain_ns:,.1f}" for row in found.rows))
    table.add_row("sum beside it", *(f"{row.timed_ratio - 1.0:+.1%}" for row in found.rows))
    monitor = [row.checked_ratio for row in found.rows]
    if any(ratio is not None for ratio in monitor):
        cells = ("" if ratio is None else f"{ratio - 1.0:+.1%}" for ratio in monitor)
        table.add_row("the monitor", *cells)
    return table
