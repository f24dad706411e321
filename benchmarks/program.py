"""Runs a benchmark as a program.

A benchmark is a function that takes options and `say`, a function that shows progress, and returns
a `BenchmarkReport`.
`cavmarl.bench.harness` also has helpers for turns, medians and checks of numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import typer

from cavmarl.bench.harness import BenchmarkReport
from cavmarl.cli.output import print_error
from cavmarl.cli.report_command import report_command
from cavmarl.core.errors import CavmarlError


def run(measure: Callable[..., BenchmarkReport], words: Sequence[str] | None = None) -> None:
    """Run a benchmark as a program; an expected error prints one line and exits with code 2."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(report_command(measure))
    name = Path(sys.argv[0]).name.removesuffix(".py").removeprefix("benchmarks.")
    try:
        app(args=None if words is None else list(words), prog_name=f"python -m benchmarks {name}")
    except CavmarlError as error:
        print_error(str(error))
        sys.exit(2)
