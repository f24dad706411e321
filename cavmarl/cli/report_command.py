"""Turns functions that return a `BenchmarkReport` into commands."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, get_type_hints

import typer
from rich.console import Console

from cavmarl.bench.harness import BenchmarkReport, measuring
from cavmarl.cli.output import JsonPath, write_json


def report_command(measure: Callable[..., BenchmarkReport]) -> Callable[..., None]:
    """Return a benchmark as a Typer command: without the parameter `say`, and with `--json`."""
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
