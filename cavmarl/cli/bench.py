"""`cavmarl bench`: how fast it is, as ratios measured side by side in one run."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.bench_traffic import traffic
from cavmarl.cli.output import JsonPath, write_json
from cavmarl.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.evaluate.step_speed import Rates, StepSpeed

__all__ = ["app"]

app = typer.Typer(help="How fast it is, measured side by side.", no_args_is_help=True)
app.command()(traffic)


@app.command()
def step(
    agents: Annotated[int, typer.Option(help="Controlled vehicles a world.")] = 100,
    worlds: Annotated[int, typer.Option(help="Of ours, stepped together.")] = 16,
    repeats: Annotated[int, typer.Option(help="Measurements of each, by turns.")] = 5,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if the ratio is below this.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Agent-steps a second next to highway-env's: same road, vehicles, sensor, rates; one core."""
    from cavmarl.evaluate.step_speed import measure_step_speed

    if at_least is not None and not 0.0 < at_least < math.inf:
        raise ConfigError(f"--at-least {at_least:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_step_speed(agents, worlds, repeats, status.update)
    console.print(_table(found))
    console.print(
        f"ratio: [bold]{found.ratio:,.0f}[/] batched, {found.ratio_single:,.0f} with one world"
    )
    write_json(json_path, found.to_dict())
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _table(found: StepSpeed) -> Table:
    table = Table(
        "agent-steps/s",
        title=(
            f"{found.agents} controlled vehicles on {found.road_m / 1000.0:.1f} km of four lanes, "
            f"64-ray lidar, one core, {found.repeats} repeats by turns"
        ),
    )
    for column in ("min", "median", "max"):
        table.add_column(column, justify="right")
    rows = {
        f"cavmarl, {found.worlds} worlds": found.batched,
        "cavmarl, 1 world": found.single,
        "highway-env": found.highway_env,
    }
    for name, rates in rows.items():
        table.add_row(name, *_cells(rates))
    return table


def _cells(rates: Rates) -> tuple[str, str, str]:
    return f"{rates.low:,.0f}", f"{rates.median:,.0f}", f"{rates.high:,.0f}"
