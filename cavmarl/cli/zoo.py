"""`cavmarl zoo`: lists, shows, verifies, compares and exports trained drivers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    CliGroup,
    Imports,
    JsonPath,
    about,
    about_file,
    add_command,
    driving_progress,
    grid,
    number,
    print_error,
    with_world,
    write_json,
)
from cavmarl.config.entry_cards import sentence_about
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.progress import progress_bar

if TYPE_CHECKING:
    from cavmarl.evaluate.zoo import Cross, ZooEntry

# Metrics that fit eighty columns, and their headings.
SHORT = {
    "success": "success",
    "collision": "crash",
    "off_road": "off road",
    "red_light": "red",
}

app = typer.Typer(
    cls=CliGroup,
    help="List, show, verify, compare and export trained drivers.",
    no_args_is_help=True,
)


def list_drivers(json_path: JsonPath = None) -> None:
    """List the trained drivers with their results.

    If a driver cannot be read, exit with 1.
    """
    from cavmarl.evaluate.zoo import zoo_entries

    heads = ("driver", "kB", "result of", "trips", *SHORT.values())
    entries = zoo_entries()
    found = [entry for entry in entries if not entry.refused]
    rows = []
    for entry in found:
        shares = (number(entry.shares.get(key), 100.0) for key in SHORT)
        cells = (f"{entry.weights_bytes / 1000.0:.0f}", entry.environment or "no result")
        rows.append((escape(entry.name), *cells, str(entry.trips), *shares))
    console = Console()
    about_each = [(escape(one.name), escape(sentence_about(one.folder))) for one in found]
    console.print(grid(("driver", "description"), about_each, lefts=2))
    sources = [(escape(one.name), escape(_sources(one))) for one in found]
    console.print(grid(("driver", "source of its inputs"), sources, lefts=2))
    console.print(grid(heads, rows, caption="shares in % of the result's trips", wraps=True))
    fields = ("environment", "weights_bytes", "trips", "shares")
    told = {
        one.name: {field: getattr(one, field) for field in fields} | _label(one) for one in found
    }
    refused = {one.name: {"refused": one.refused} for one in entries if one.refused}
    write_json(json_path, told | refused)
    for one in refused.values():
        Console(stderr=True).print(f"error: {one['refused']}", markup=False, highlight=False)
    if refused:
        raise typer.Exit(1)


def show(
    name: Annotated[
        str, typer.Argument(metavar="DRIVER", help="Name or folder of a trained driver.")
    ],
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Show the inputs of a driver, and the kinds of maps it was trained on."""
    from cavmarl.evaluate.zoo import zoo_entry

    entry = zoo_entry(name)
    rows = [(reading.source, escape(reading.what)) for reading in entry.readings]
    console = Console()
    title = escape(f"{entry.name}: {sentence_about(entry.folder)}")
    console.print(grid(("from", "it reads"), rows, title, lefts=2))
    console.print(f"maps of its training: {', '.join(entry.maps)}", highlight=False)
    write_json(json_path, {"name": entry.name, **_label(entry)})


def verify(
    name: Annotated[
        str, typer.Argument(metavar="DRIVER", help="Name or folder of a trained driver.")
    ],
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Repeat the recorded evaluation of a driver.

    If a byte of a result differs, exit with 1.
    """
    from cavmarl.evaluate.zoo import verify_entry

    console = Console()
    with progress_bar(console) as bar:
        found = verify_entry(name, driving_progress(bar))
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
            "gives the same bytes on every processor: compare the installed versions with the "
            "manifest of the result; if they are equal, report the difference"
        )
        raise typer.Exit(1)


@with_world()
def cross(
    world: WorldSpec,
    policy: Annotated[
        list[str], about("Drivers, at least two.", "--policy", "-p", metavar="POLICY")
    ],
    episodes: Annotated[
        int, about("Number of episodes of each pair.", "--episodes", "-n", metavar="N")
    ] = 8,
    json_path: JsonPath = None,
) -> None:
    """Evaluate each driver among the vehicles of each other driver.

    The results are matrices of success and collisions.
    """
    from cavmarl.evaluate.zoo import cross as run

    console = Console()
    world = with_sensors_of_drivers(world, policy)
    with progress_bar(console) as bar:
        found = run(world, policy, episodes=episodes, progress=driving_progress(bar))
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


def export(
    name: Annotated[
        str, typer.Argument(metavar="DRIVER", help="Name or folder of a trained driver.")
    ],
    onnx: Annotated[Path, about_file("Write an ONNX model, whose metadata state the sensors.")],
    json_path: JsonPath = None,
) -> None:
    """Write a trained driver as a model for other programs.

    `--policy FILE.onnx` reads the model, too.
    """
    from cavmarl.policies.onnx_export import export_onnx

    config = export_onnx(name, onnx)
    told = {
        "driver": name,
        "onnx": str(onnx),
        "observations": config.observation_size,
        "outputs": config.num_outputs,
        "action": config.action.kind,
        "observes_built_in_action": config.residual,
    }
    Console().print(
        f"{onnx}: observations (N, {config.observation_size}) to "
        f"{'actions' if config.action.kind == 'continuous' else 'logits'} (N, {config.num_outputs})"
        + ("; the last two observations are the built-in driver's action" * config.residual),
        markup=False,
        highlight=False,
    )
    write_json(json_path, told)


def _sources(entry: ZooEntry) -> str:
    return ", ".join(dict.fromkeys(reading.source for reading in entry.readings))


def _label(entry: ZooEntry) -> dict[str, Any]:
    """Return the inputs of an entry and the kinds of its maps, for JSON."""
    return {"reads": [asdict(reading) for reading in entry.readings], "maps": list(entry.maps)}


def _matrix(found: Cross, column: str, title: str) -> Table:
    heads = ("", *(f"among {escape(name)}" for name in found.drivers))
    rows = [
        (escape(a), *(number(found.share(a, b, column), 100.0) for b in found.drivers))
        for a in found.drivers
    ]
    return grid(heads, rows, title)


add_command(app, "list", list_drivers, "cavmarl zoo list")
add_command(app, "show", show, "cavmarl zoo show cities_ippo")
add_command(app, "verify", verify, "cavmarl zoo verify cities_ippo")
add_command(
    app,
    "cross",
    cross,
    "cavmarl zoo cross merge --policy idm --policy cities_ippo",
)
add_command(app, "export", export, "cavmarl zoo export cities_ippo --onnx cities_ippo.onnx")
