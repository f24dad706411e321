"""`cavmarl bench v2x`: what messages between vehicles cost in a tick."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, Seed, write_json
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.v2x_speed import V2xSpeed

__all__ = ["v2x"]


def v2x(
    env: Annotated[str, typer.Argument(metavar="[ENV]", help="Whose map is used.")] = "town",
    vehicles: Annotated[int, typer.Option(help="That send, as far as there is room.")] = 1000,
    receivers: Annotated[
        int | None, typer.Option(help="Of them, agents that receive; default: all.")
    ] = None,
    ticks: Annotated[int, typer.Option(help="That are timed.")] = 200,
    warmup: Annotated[int, typer.Option(help="Ticks before.")] = 40,
    seed: Seed = 0,
    at_most: Annotated[
        float | None, typer.Option(help="Exit with 1 if any channel takes more ms a tick.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Milliseconds a tick for messages among vehicles, by channel, beside the tick itself."""
    from cavmarl.bench.v2x_speed import measure_v2x

    if at_most is not None and not 0.0 < at_most < math.inf:
        raise ConfigError(f"--at-most {at_most:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_v2x(
            env,
            vehicles=vehicles,
            receivers=vehicles if receivers is None else receivers,
            ticks=ticks,
            warmup=warmup,
            seed=seed,
            say=status.update,
        )
    console.print(_table(found))
    write_json(json_path, found.to_dict())
    if at_most is not None and max(row.median_ms for row in found.rows) > at_most:
        raise typer.Exit(1)


def _table(found: V2xSpeed) -> Table:
    table = Table(
        "channel",
        title=(
            f"{found.env}: {found.vehicles:,.0f} vehicles at {found.rate_hz:g} Hz, up to "
            f"{found.receivers:,} of them receive\n{found.hardware['cpu']}, one core"
        ),
    )
    for column in ("ms a tick", "in reach", "received", "busy"):
        table.add_column(column, justify="right")
    table.add_row("the world's own tick", f"{found.world_ms:.2f}", "", "", "")
    table.add_section()
    for row in found.rows:
        table.add_row(
            row.name,
            f"{row.median_ms:.2f}",
            f"{row.reachable:,.0f}",
            f"{row.reception_ratio:.1%}",
            f"{row.busy_ratio:.1%}" if row.busy_ratio else "-",
        )
    return table
