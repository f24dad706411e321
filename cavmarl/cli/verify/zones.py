"""`cavmarl verify zones`: compares divided worlds with the undivided one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.bench.harness import numbers_of
from cavmarl.cli.output import (
    OUTPUT,
    WORLD,
    JsonPath,
    PolicyName,
    about,
    grid,
    make_folder,
    say_difference,
    with_world,
    write_json,
)
from cavmarl.cli.verify import options
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.verify.equivalence import Equivalence, ZoneResult

Zones = Annotated[
    str | None,
    about(
        "Numbers of zones to compare [default: 1,2,4,9, or the number in a zone file].",
        metavar="K,K,…",
    ),
]
Layout = Annotated[
    str | None,
    about(
        f"Shape of the zones: {', '.join(ZONE_LAYOUTS)}, or a zone file [default: as "
        "configured by the environment].",
        metavar="LAYOUT",
        panel=WORLD,
    ),
]
Journal = Annotated[
    Path | None,
    about("Write the ownership journals into this folder.", metavar="DIR", panel=OUTPUT),
]


@with_world()
def verify_zones(
    world: WorldSpec,
    zones: Zones = None,
    steps: Annotated[int, about("Number of steps to compare.", metavar="N")] = 200,
    layout: Layout = None,
    policy: PolicyName = "idm",
    worlds: Annotated[int, about("Number of parallel worlds.", metavar="N", panel=WORLD)] = 1,
    check: options.Check = False,
    journal: Journal = None,
    json_path: JsonPath = None,
) -> None:
    """Compare divided worlds with the undivided one, step by step.

    On the first difference of a division, print it and exit with 1.
    """
    counts = None if zones is None else numbers_of("--zones", zones)
    world = with_sensors_of_drivers(world, [policy])
    if journal is not None:
        make_folder(journal)
    from cavmarl.verify import equivalence

    console = Console()
    with counting(console, f"{policy} drives {world.env}, undivided and divided") as progress:
        found = equivalence.verify_zones(
            world, counts, steps=steps, layout=layout, policy=policy, worlds=worlds, check=check,
            journals=journal, progress=progress,
        )  # fmt: skip
    write_json(json_path, found.to_dict())
    console.print(_table(found, world.seed))
    for result in found.results:
        if result.difference is not None:
            console.print(_sentence(result, found.worlds), markup=False, soft_wrap=True)
    if not found.holds:
        raise typer.Exit(1)
    hashes = ", ".join(found.state_hashes)
    console.print(f"state after tick {found.ticks}: {hashes}", highlight=False, soft_wrap=True)


def _table(found: Equivalence, seed: int) -> Table:
    many = "a world" if found.worlds == 1 else f"{found.worlds} worlds"
    rows = (
        (
            str(result.zones),
            str(result.steps),
            f"{result.vehicles:,.0f}",
            f"{result.crossings:,}",
            _verdict(result),
        )
        for result in found.results
    )
    title = escape(
        f"{Path(found.env).name}, {many}, seed {seed}: compared with the undivided world"
    )
    return grid(("zones", "steps", "vehicles", "crossings", ""), rows, title, lefts=0)


def _verdict(result: ZoneResult) -> str:
    if result.difference is not None:
        return "[red]different[/]"
    if result.tolerance_m > 0.0:
        return f"[yellow]not compared: a simulator has a tolerance of {result.tolerance_m:g} m[/]"
    return "[green]equal[/]"


def _sentence(result: ZoneResult, worlds: int) -> str:
    assert result.difference is not None
    where = f"{result.zones} zone{'' if result.zones == 1 else 's'}"
    if worlds > 1:
        where += f", world {result.world}"
    return f"{where}: {say_difference(result.difference, ('undivided', 'divided'))}"
