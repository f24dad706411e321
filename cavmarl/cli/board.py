"""`cavmarl board`: checks entries (drivers with recorded results), and shows them on a page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.cli.output import (
    CliGroup,
    Imports,
    JsonPath,
    about,
    about_file,
    add_command,
    driving_progress,
    grid,
    print_error,
    write_json,
)
from cavmarl.core.progress import progress_bar

app = typer.Typer(
    cls=CliGroup,
    help="Check entries (drivers with recorded results), and show them on a page, the board.",
    no_args_is_help=True,
)


def build(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="Folders that contain entries.")
    ],
    out: Annotated[Path, about_file("File of the page.", "--out", "-o")] = Path("board.html"),
    entry: Annotated[
        list[str] | None,
        about("Show only this entry. May be repeated.", "--entry", metavar="NAME"),
    ] = None,
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Repeat the recorded evaluation of each entry, and write one page.

    Entries that fail are marked on the page with the reason. If an entry fails, exit with 1. The
    scripts of entries are run: build boards only of entries that you trust.
    """
    from cavmarl.evaluate.board import build_board, entries_in

    console = Console()
    with progress_bar(console) as bar:
        found = build_board(entries_in(folders, entry or ()), out, driving_progress(bar))
    rows = [(escape(one.name), escape(one.environment), one.state) for one in found]
    console.print(grid(("entry", "result of", "state"), rows, lefts=3))
    console.print(f"page: {out}", markup=False, highlight=False)
    write_json(json_path, {"entries": {one.name: asdict(one) for one in found}})
    failed = [one for one in found if one.failure]
    for one in failed:
        print_error(f"{one.name}: {one.failure}")
    if failed:
        raise typer.Exit(1)


def check(
    entry: Annotated[Path, typer.Argument(metavar="ENTRY", help="Folder of an entry.")],
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Check an entry before it is submitted: read its files, and repeat its evaluation.

    If the entry has a script, the script is run.
    """
    from cavmarl.evaluate.board import check_entry

    console = Console()
    with progress_bar(console) as bar:
        found = check_entry(entry, driving_progress(bar))
    for file, digest in found.expected.items():
        console.print(f"{file}: the same ({digest[:12]})", markup=False, highlight=False)
    said = "can be submitted"
    if not found.expected:
        said += (
            "; it is shown as not verified, because it is a model of another library: for a "
            "verified entry, export it as model.safetensors and config.json"
        )
    console.print(f"{entry}: {said}", markup=False, highlight=False)
    write_json(json_path, asdict(found))


add_command(app, "build", build, "cavmarl board build agents board --out board.html")
add_command(app, "check", check, "cavmarl board check agents/merge_ippo")
