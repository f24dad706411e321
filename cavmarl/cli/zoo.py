"""`cavmarl zoo`: the trained drivers, their results, and how they drive among each other."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, about, grid, number, print_error, with_world, write_json
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.progress import progress_bar

if TYPE_CHECKING:
    from cavmarl.evaluate.episodes import Progress
    from cavmarl.evaluate.zoo import Cross

# Shares of a result that eighty columns hold, and their heads.
SHORT = {
    "success": "success",
    "collision": "crash",
    "off_road": "off road",
    "red_light": "red",
}

app = typer.Typer(help="Trained drivers: list, verify, compare.", no_args_is_help=True)


@app.command("list")
def list_drivers(json_path: JsonPath = None) -> None:
    """Show the trained drivers, and what their results say; exit code 1 if one cannot be read."""
    from cavmarl.evaluate.zoo import zoo_entries

    heads = ("driver", "kB", "result of", "trips", *SHORT.values())
    entries = zoo_entries()
    found = [entry for entry in entries if not entry.refused]
    rows = []
    for entry in found:
        shares = (number(entry.shares.get(key), 100.0) for key in SHORT)
        cells = (f"{entry.weights_bytes / 1000.0:.0f}", entry.environment or "no result")
        rows.append((escape(entry.name), *cells, str(entry.trips), *shares))
    Console().print(grid(heads, rows, caption="shares in % of the result's trips", wraps=True))
    fields = ("environment", "weights_bytes", "trips", "shares")
    told = {one.name: {field: getattr(one, field) for field in fields} for one in found}
    refused = {one.name: {"refused": one.refused} for one in entries if one.refused}
    write_json(json_path, told | refused)
    for one in refused.values():
        Console(stderr=True).print(f"error: {one['refused']}", markup=False, highlight=False)
    if refused:
        raise typer.Exit(1)


@app.command()
def verify(
    name: Annotated[str, typer.Argument(metavar="DRIVER", help="A trained driver, or its folder.")],
    json_path: JsonPath = None,
) -> None:
    """Drive the episodes of a driver's result again; exit code 1 if a byte differs."""
    from cavmarl.evaluate.zoo import verify_entry

    console = Console()
    with progress_bar(console) as bar:
        found = verify_entry(name, _progress(bar))
    for file, digest in found.expected.items():
        verdict = f"the same ({digest[:12]})"
        if file in found.differing:
            verdict = f"differs (expected {digest[:12]}, found {found.found[file][:12]})"
        console.print(f"{file}: {verdict}", markup=False, highlight=False)
    write_json(json_path, asdict(found))
    if found.differing:
        print_error(
            f"{found.name}: {len(found.differing)} of {len(found.expected)} files differ; expected "
            f"from {found.expected_on}, found on {found.found_on}. The same version of cavmarl "
            "gives the same bytes on every processor: check the versions in the manifest of the "
            "result, and report the difference if they are the installed ones"
        )
        raise typer.Exit(1)


@app.command()
@with_world()
def cross(
    world: WorldSpec,
    policy: Annotated[list[str], about("A driver; repeat it, two or more.", "--policy", "-p")],
    episodes: Annotated[int, about("Episodes of each pair.", "--episodes", "-n")] = 8,
    json_path: JsonPath = None,
) -> None:
    """Let each driver drive among each other's vehicles; success and collisions as matrices."""
    from cavmarl.evaluate.zoo import cross as run

    console = Console()
    world = with_sensors_of_drivers(world, policy)
    with progress_bar(console) as bar:
        found = run(world, policy, episodes=episodes, progress=_progress(bar))
    for column, title in (("success", "success, %"), ("collision", "collision, %")):
        console.print(_matrix(found, column, title))
    write_json(
        json_path,
        {
            a: {
                b: {key: found.share(a, b, key) for key in ("success", "collision")}
                for b in found.drivers
            }
            for a in found.drivers
        },
    )


def _matrix(found: Cross, column: str, title: str) -> Table:
    heads = ("", *(f"among {escape(name)}" for name in found.drivers))
    rows = [
        (escape(a), *(number(found.share(a, b, column), 100.0) for b in found.drivers))
        for a in found.drivers
    ]
    return grid(heads, rows, title)


def _progress(bar: Any) -> Progress:
    """Shows how far a driver has come."""
    task = bar.add_task("")

    def show(policy: str, steps: int, most: int) -> None:
        bar.update(task, description=policy, completed=steps, total=most)

    return show
