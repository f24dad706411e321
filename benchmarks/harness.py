"""How a benchmark is run as a program: its options, its table, its JSON.

A benchmark is a function that takes options and a `say`, and returns a `Report`. Turns, medians and
checks of numbers are those of `cavmarl.bench.harness`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, get_type_hints

import typer
from rich.console import Console

from cavmarl.bench.harness import (
    Say,
    check_positive,
    check_range,
    hardware_line,
    make_table,
    measuring,
    numbers_of,
    one_core,
    paired_interval,
    paired_ratio,
    silent,
    spread,
    take_turns,
)
from cavmarl.cli.output import JsonPath, about, print_error, write_json
from cavmarl.core.errors import CavmarlError
from cavmarl.core.machine import describe_hardware

__all__ = [
    "Env",
    "Report",
    "Say",
    "about",
    "check_positive",
    "check_range",
    "hardware_line",
    "make_table",
    "numbers_of",
    "one_core",
    "paired_interval",
    "paired_ratio",
    "run",
    "silent",
    "spread",
    "take_turns",
]

Env = Annotated[
    str, typer.Argument(metavar="[ENV]", help="Name, folder or map file of an environment.")
]


@dataclass(frozen=True)
class Report:
    """What a benchmark has found.

    Attributes:
        title: of the table.
        columns: head of a column → `key` or `key:format` of the rows, left to right.
        rows: one a side, with all that was measured of it.
        notes: lines below the table.
        facts: what belongs to no row.
        holds: whether a bound that was asked for was kept; if not, the exit code is 1.
    """

    title: str
    columns: Mapping[str, str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    holds: bool = True

    def row(self, name: str) -> Mapping[str, Any]:
        """The row whose first column shows this."""
        key = next(iter(self.columns.values()))
        return next(row for row in self.rows if row[key] == name)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {"hardware": describe_hardware(), **self.facts, "rows": [dict(r) for r in self.rows]}

    def show(self, console: Console) -> None:
        """Print the table, the notes, and what it ran on."""
        lines = ([_cell(row, shown) for shown in self.columns.values()] for row in self.rows)
        console.print(make_table(self.title, list(self.columns), lines))
        for note in self.notes:
            console.print(note, highlight=False)
        console.print(hardware_line(describe_hardware()), highlight=False)


def _cell(row: Mapping[str, Any], shown: str) -> str:
    key, _, form = shown.partition(":")
    value = row.get(key)
    return "-" if value is None else str(value) if not form else format(value, form)


def command(measure: Callable[..., Report]) -> Callable[..., None]:
    """A benchmark as a command of typer: without `say`, and with `--json`."""
    hints = get_type_hints(measure, include_extras=True)
    given = inspect.signature(measure).parameters.values()
    wanted = [
        one.replace(annotation=hints[one.name], kind=inspect.Parameter.POSITIONAL_OR_KEYWORD)
        for one in given
        if one.name != "say"
    ]
    wanted.append(
        inspect.Parameter(
            "json_path", inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=JsonPath
        )
    )

    def program(**options: Any) -> None:
        json_path = options.pop("json_path")
        console = Console()
        with measuring(console) as say:
            report = measure(**options, say=say)
        report.show(console)
        write_json(json_path, report.to_dict())
        if not report.holds:
            raise typer.Exit(1)

    program.__doc__ = measure.__doc__
    program.__annotations__ = {one.name: one.annotation for one in wanted}
    vars(program)["__signature__"] = inspect.Signature(wanted)
    return program


def run(measure: Callable[..., Report], words: Sequence[str] | None = None) -> None:
    """Run a benchmark as a program; an error that is raised on purpose is one line and code 2."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command(measure))
    try:
        app(args=None if words is None else list(words))
    except CavmarlError as error:
        print_error(str(error))
        sys.exit(2)
