"""Common parts of benchmarks: reports, alternating measurements, statistics, validation.

A benchmark returns a `BenchmarkReport`, which prints its tables and is the JSON of `--json`. All
sides of a comparison are measured in turn, so that other load on the machine affects all of them.
The programs in `benchmarks/` use this module too.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import fmean, median, variance
from typing import Any, TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.core.errors import ConfigError
from cavmarl.core.machine import describe_hardware
from cavmarl.core.progress import progress_bar

Say = Callable[[str], None]
Key = TypeVar("Key")
Taken = TypeVar("Taken")


def silent(text: str) -> None:
    """Print nothing; silent runs pass this function as `say`."""


@dataclass(frozen=True)
class Spread:
    """The smallest, median and largest result of one side."""

    low: float
    median: float
    high: float


def spread(values: Iterable[float]) -> Spread:
    """Return the smallest, median and largest value."""
    found = tuple(values)
    return Spread(min(found), median(found), max(found))


@dataclass(frozen=True)
class BenchmarkReport:
    """The result of a benchmark.

    Attributes:
        title: title of the table.
        columns: column head → `key` or `key:format` of the rows, left to right. The first column is
            text.
        rows: one row per side, with all its measurements.
        notes: lines below the tables, with markup of the library rich.
        facts: figures that belong to no row.
        holds: whether the requested bound holds; if not, the exit code is 1.
        caption: a line below the table.
        tables: further tables; their figures are in `facts`.
    """

    title: str
    columns: Mapping[str, str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    holds: bool = True
    caption: str | None = None
    tables: Sequence[Table] = ()

    def row(self, name: str) -> Mapping[str, Any]:
        """Return the row whose first column shows `name`."""
        key = next(iter(self.columns.values()))
        return next(row for row in self.rows if row[key] == name)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {"hardware": describe_hardware(), **self.facts, "rows": [dict(r) for r in self.rows]}

    def show(self, console: Console) -> None:
        """Print the tables, the notes and the hardware."""
        lines = ([_cell(row, shown) for shown in self.columns.values()] for row in self.rows)
        console.print(make_table(self.title, list(self.columns), lines, self.caption))
        for table in self.tables:
            console.print(table)
        for note in self.notes:
            console.print(note, highlight=False)
        console.print(hardware_line(describe_hardware()), highlight=False)


def _cell(row: Mapping[str, Any], shown: str) -> str:
    key, _, form = shown.partition(":")
    value = row.get(key)
    return "-" if value is None else str(value) if not form else format(value, form)


def is_kept(at_least: float | None, ratio: float | None) -> bool:
    """Return whether a ratio meets the bound of `--at-least`; True without a bound or a ratio."""
    return at_least is None or ratio is None or ratio >= at_least


def take_turns(
    sides: Mapping[Key, Callable[[], Taken]], repeats: int, say: Say = silent
) -> dict[Key, tuple[Taken, ...]]:
    """Call each side once per turn, one after another, and return the results by side."""
    found: dict[Key, list[Taken]] = {name: [] for name in sides}
    for turn in range(1, repeats + 1):
        say(f"measuring, {turn} of {repeats}")
        for name, measure in sides.items():
            found[name].append(measure())
    return {name: tuple(taken) for name, taken in found.items()}


def paired_ratio(ones: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the ratios of two sides, turn by turn."""
    return median(one / other for one, other in zip(ones, others, strict=True))


def paired_interval(ones: Sequence[float], others: Sequence[float]) -> tuple[float, float]:
    """Return the mean ratio of two sides, turn by turn, and half of its confidence interval.

    The mean is geometric, without the lowest and the highest tenth. Half of the 95 % interval is
    two standard errors by Yuen's (1974) estimate; for a single turn it is infinite.
    """
    logs = sorted(math.log(one / other) for one, other in zip(ones, others, strict=True))
    cut = len(logs) // 10
    kept = logs[cut : len(logs) - cut]
    mean = fmean(kept)
    ends = [min(max(value, kept[0]), kept[-1]) for value in logs]
    if len(kept) < 2:
        return math.exp(mean), math.inf
    error = math.sqrt(variance(ends) * (len(logs) - 1) / (len(kept) * (len(kept) - 1)))
    return math.exp(mean), 2.0 * error * math.exp(mean)


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process on one core, if the system supports it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def check_range(**limits: tuple[float, float, float]) -> None:
    """Raise ConfigError for values out of range; `limits`: name=(value, least, most)."""
    for name, (value, least, most) in limits.items():
        if not least <= value <= most:
            bounds = f"at least {least:g}" if math.isinf(most) else f"from {least:g} to {most:.15g}"
            raise ConfigError(f"{name} = {value}: must be {bounds}")


def check_positive(option: str, value: float | None) -> None:
    """Refuse a bound that is not positive; None: there is no bound."""
    if value is not None and not 0.0 < value < math.inf:
        raise ConfigError(f"{option} {value:g}: must be a number above 0")


def numbers_of(option: str, text: str) -> list[int]:
    """Parse an option with comma-separated whole numbers, such as `--zones 1,4,9`."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(
            f"{option} {text}: must be comma-separated whole numbers, for example 1,2,4"
        ) from None


@contextmanager
def measuring(console: Console) -> Iterator[Say]:
    """Show the current measurement; a text like `3 of 7` adds a progress bar and the time left."""
    with progress_bar(console) as bar:
        task = bar.add_task("", total=None)

        def say(text: str) -> None:
            turn = re.search(r"\b(\d+) of (\d+)\b", text)
            done, total = (int(turn[1]) - 1, int(turn[2])) if turn else (0, None)
            bar.update(task, description=text, completed=done, total=total)

        yield say


def make_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str] | None],
    caption: str | None = None,
) -> Table:
    """Build a table with text in the first column and numbers in the others; None draws a line.

    On a narrow terminal, text is wrapped but numbers are not.
    """
    close = (0, 1, 0, 0)  # fits ten columns on a terminal of 80 characters
    table = Table(
        title=escape(title), caption=caption, box=SIMPLE_HEAD, pad_edge=False, padding=close
    )
    for place, column in enumerate(columns):
        table.add_column(column, justify="right" if place else "left", overflow="fold")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    return table


def hardware_line(hardware: Mapping[str, Any]) -> str:
    return f"{hardware['cpu']}, {hardware['usable_cores']} cores"
