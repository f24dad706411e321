"""`cavmarl bench sumo`: what SUMO as global traffic costs beside libsumo alone."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, Seed, write_json

if TYPE_CHECKING:
    from cavmarl.bench.sumo_speed import SumoSpeed

__all__ = ["sumo"]


class _Source(StrEnum):
    DEMAND = "sumo-demand"
    TRAFFIC = "sumo-traffic"


def sumo(
    map_name: Annotated[
        str, typer.Argument(metavar="MAP", help="A map file, or an environment's name or folder.")
    ],
    demand: Annotated[
        list[Path],
        typer.Option("--demand", "-d", help="A .rou.xml, .add.xml or .sumocfg; may be repeated."),
    ],
    source: Annotated[_Source, typer.Option(help="How the world is coupled.")] = _Source.TRAFFIC,
    dt: Annotated[float, typer.Option(help="Step length of both, in seconds.")] = 0.1,
    agents: Annotated[int, typer.Option(help="Vehicles driven from outside.", min=1)] = 4,
    seed: Seed = 0,
    after: Annotated[int, typer.Option(help="Simulated seconds before it is measured.")] = 120,
    repeats: Annotated[int, typer.Option(help="Turns of 10 s of each.")] = 5,
    json_path: JsonPath = None,
) -> None:
    """What coupling a world to SUMO adds to the time that libsumo takes alone."""
    from cavmarl.bench.sumo_speed import measure_sumo_speed

    console = Console()
    with console.status("") as status:
        found = measure_sumo_speed(
            map_name,
            demand,
            source=source.value,
            dt_s=dt,
            seed=seed,
            agents=agents,
            after_s=after,
            repeats=repeats,
            progress=status.update,
        )
    console.print(_table(found))
    write_json(json_path, found.to_dict())


def _table(found: SumoSpeed) -> Table:
    table = Table(
        "ms a tick",
        title=(
            f"{found.map_name}, {found.source}, step {found.dt_s:g} s, {found.agents} agents, "
            f"{found.repeats} turns of each, after {found.after_s} s"
        ),
        caption=(
            f"coupling adds {found.added:.2f} times what libsumo takes alone "
            f"({found.added_wall:.2f} by the wall clock)"
        ),
    )
    for column in ("vehicles", "min", "median", "max", "median, wall clock"):
        table.add_column(column, justify="right")
    for name, vehicles, cost, wall in (
        ("libsumo alone", found.sumo_vehicles, found.sumo, found.sumo_wall),
        ("coupled world", found.our_vehicles, found.coupled, found.coupled_wall),
    ):
        values = (cost.low, cost.median, cost.high, wall.median)
        table.add_row(name, f"{vehicles:,.0f}", *(f"{value:.2f}" for value in values))
    return table
