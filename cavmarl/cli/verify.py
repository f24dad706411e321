"""`cavmarl verify`: whether divided worlds are the undivided one, bit for bit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.evaluate import progress_bar
from cavmarl.cli.output import (
    Agents,
    Background,
    Environment,
    JsonPath,
    PolicyName,
    Seed,
    Settings,
    parse_settings,
    say_difference,
    write_json,
)
from cavmarl.config import ZONE_LAYOUTS
from cavmarl.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.evaluate.equivalence import Equivalence, ZoneResult

__all__ = ["verify"]


def verify(
    env: Environment,
    zones: Annotated[
        str | None,
        typer.Option(
            metavar="K,K,…", help="Numbers of zones; default: 1,2,4,9, or what a zone file has."
        ),
    ] = None,
    steps: Annotated[int, typer.Option(help="That are compared.")] = 200,
    seed: Seed = 0,
    layout: Annotated[
        str | None,
        typer.Option(
            help=f"{', '.join(ZONE_LAYOUTS)}, or a zone file; default: the environment's."
        ),
    ] = None,
    policy: PolicyName = "idm",
    worlds: Annotated[int, typer.Option(help="Stepped together.")] = 1,
    agents: Agents = None,
    background: Background = None,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Drive divided worlds beside the undivided one; exit code 1 and where one first differs."""
    from cavmarl.evaluate.equivalence import verify_zones

    overrides = parse_settings(settings)
    counts = None if zones is None else _counts(zones)
    console = Console()
    with progress_bar(console) as bar:
        task = bar.add_task(f"{policy} drives {env}, undivided and divided")
        found = verify_zones(
            env,
            counts,
            steps=steps,
            seed=seed,
            layout=layout,
            policy=policy,
            worlds=worlds,
            agents=agents,
            background=background,
            overrides=overrides,
            progress=lambda k, n: bar.update(task, completed=k, total=n),
        )
    write_json(json_path, found.to_dict())
    console.print(_table(found, seed))
    for result in found.results:
        if result.difference is not None:
            console.print(_sentence(result, found.worlds), markup=False, soft_wrap=True)
    if not found.holds:
        raise typer.Exit(1)
    hashes = ", ".join(found.state_hashes)
    console.print(f"state after tick {found.ticks}: {hashes}", highlight=False, soft_wrap=True)


def _counts(text: str) -> list[int]:
    """The numbers of `--zones`.

    Raises:
        ConfigError: something else.
    """
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(f"--zones {text}: must be numbers with commas between, 1,2,4") from None


def _table(found: Equivalence, seed: int) -> Table:
    many = "a world" if found.worlds == 1 else f"{found.worlds} worlds"
    table = Table(
        title=escape(f"{found.env}, {many}, seed {seed}: beside the undivided"),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for heading in ("zones", "steps", "vehicles", "crossings"):
        table.add_column(heading, justify="right")
    table.add_column("")
    for result in found.results:
        equal = result.difference is None
        table.add_row(
            str(result.zones),
            str(result.steps),
            f"{result.vehicles:,.0f}",
            f"{result.crossings:,}",
            "[green]equal[/]" if equal else "[red]different[/]",
        )
    return table


def _sentence(result: ZoneResult, worlds: int) -> str:
    assert result.difference is not None
    where = f"{result.zones} zone{'' if result.zones == 1 else 's'}"
    if worlds > 1:
        where += f", world {result.world}"
    return f"{where}: {say_difference(result.difference, ('undivided', 'divided'))}"
