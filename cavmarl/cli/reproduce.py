"""`cavmarl reproduce`: repeats the commands behind the published numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, about, flag, grid, print_error, write_json
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import progress_bar

if TYPE_CHECKING:
    from cavmarl.verify.published_lines import PublishedLine
    from cavmarl.verify.reproduction import LineResult

ALL_SHOWN = 4  # a longer line shows only its wrong numbers, and a count


def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="LINE", help="Names of lines, see --list.", show_default=False),
    ] = None,
    quick: Annotated[
        bool, flag("Repeat quick lines only, whose numbers are equal on all machines.", "--quick")
    ] = False,
    every: Annotated[bool, flag("Repeat all lines; takes hours.", "--all")] = False,
    listed: Annotated[bool, flag("List the lines and run nothing.", "--list")] = False,
    files: Annotated[
        list[str] | None,
        about(
            "Replace a word in the commands by a file or folder, for example MAPS=maps. Repeat it "
            "for more.",
            "--file",
            metavar="WORD=PATH",
        ),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Repeat the commands behind the numbers of README.md and docs/figures.

    Each line names numbers of a page, their command and a tolerance. If a measured number is
    outside its tolerance, or a command fails, exit with 1. Needs a checkout of the repository.
    """
    from cavmarl.verify.published_lines import read_lines, repository_root
    from cavmarl.verify.reproduction import CommandRunner, reproduce

    root = repository_root()
    lines = read_lines(root).lines
    chosen = _chosen(lines, names or (), quick, every, listed)
    console = Console()
    if listed:
        return _list(console, chosen, root, json_path)
    runner = CommandRunner(root, _files(files or ()))
    results: list[LineResult] = []
    try:
        with progress_bar(console) as bar:
            task = bar.add_task("", total=len(chosen))

            def say(name: str) -> None:
                bar.update(task, description=name, completed=len(results))

            for result in reproduce(chosen, root, runner, quick=quick, say=say):
                results.append(result)
    finally:  # show results of an interrupted run, too: it may have taken hours
        if results:
            _show(console, results, len(chosen), json_path)
    wrong = [result.name for result in results if result.is_wrong]
    if wrong:
        print_error(
            f"{', '.join(wrong)}: measured numbers differ from the page; correct the page, or "
            "the code if the change was not intended"
        )
        raise typer.Exit(1)


def _show(
    console: Console, results: Sequence[LineResult], lines: int, json_path: Path | None
) -> None:
    console.print(_table(results))
    counts = Counter(result.verdict for result in results)
    shown = [f"{count} {verdict}" for verdict, count in counts.items()]
    if len(results) < lines:
        shown.append(f"{lines - len(results)} not repeated")
    console.print(", ".join(shown))
    write_json(json_path, {"lines": [asdict(result) for result in results]})


def _chosen(
    lines: Mapping[str, PublishedLine], names: Sequence[str], quick: bool, every: bool, listed: bool
) -> dict[str, PublishedLine]:
    """Return the lines that the command line asks for; raises ConfigError."""
    if quick and every:
        raise ConfigError("--quick and --all: use only one of the two")
    if names and every:
        raise ConfigError(f"--all and {names[0]}: name lines, or leave out the names")
    if not (names or quick or every or listed):
        raise ConfigError("nothing to repeat: name lines, or use --quick, --all or --list")
    if unknown := [name for name in names if name not in lines]:
        raise ConfigError(f"{unknown[0]}: is not a line; `cavmarl reproduce --list` lists them")
    if slow := [name for name in names if quick and not lines[name].is_quick]:
        raise ConfigError(f"{slow[0]}: --quick does not repeat this line; leave out --quick")
    return {
        name: line
        for name, line in lines.items()
        if (not names or name in names) and (not quick or line.is_quick)
    }


def _files(given: Sequence[str]) -> dict[str, Path]:
    found = {}
    for text in given:
        word, equals, path = text.partition("=")
        if not (word and equals and path):
            raise ConfigError(f"--file {text}: must be WORD=PATH, for example MAPS=maps")
        found[word] = Path(path)
    return found


def _list(
    console: Console, lines: Mapping[str, PublishedLine], root: Path, json_path: Path | None
) -> None:
    from cavmarl.verify.published_lines import cells_of

    rows = []
    for name, line in lines.items():
        cells = cells_of(name, line, root)
        numbers = sum(len(cell.numbers) for cell in cells)
        rows.append((name, line.page, str(numbers), _how(line), escape(line.command)))
    heads = ("line", "page", "numbers", "how", "command")
    console.print(grid(heads, rows, lefts=2, wraps=True))
    write_json(json_path, {"lines": {name: asdict(line) for name, line in lines.items()}})


def _how(line: PublishedLine) -> str:
    if line.by_hand:
        return "by hand"
    time = "quick" if line.is_quick else f"{line.minutes:g} min"
    return escape(", ".join((time, *line.needs)))


def _table(results: Sequence[LineResult]) -> Table:
    rows: list[tuple[str, str, str, str, str]] = []
    for result in results:
        shown = result.comparisons
        if len(shown) > ALL_SHOWN:
            shown = tuple(one for one in shown if not one.is_same)
        for one in shown:
            measured = "-" if one.measured is None else f"{one.measured:,.6g}"
            verdict = "same" if one.is_same else "[red]differs[/]"
            place = f"{result.name}: {one.place}" if len(result.comparisons) > 1 else result.name
            rows.append((escape(place), one.published, measured, one.tolerance, verdict))
        if not shown or result.reason:
            count = f"{len(result.comparisons)} numbers" if result.comparisons else ""
            verdict = escape(": ".join(filter(None, (result.verdict, result.reason))))
            rows.append((result.name, count, "", "", verdict))
    return grid(("line", "published", "measured", "tolerance", "verdict"), rows, wraps=True)
