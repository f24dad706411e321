"""Repeats the commands behind published numbers, and compares the results with the pages."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.core.processes import dying_with_parent, last_words
from cavmarl.verify.published_lines import PublishedCell, PublishedLine, cells_of
from cavmarl.verify.result_paths import as_number, numbers_at, value_at

Verdict = Literal["same", "differs", "failed", "skipped", "by hand"]
Say = Callable[[str], None]
LEAST_S = 300.0  # lower bound of a command's time limit, which is `SLOWER` times its minutes
SLOWER = 10.0
_WITH_JSON = ("cavmarl ", "python -m benchmarks")


@dataclass(frozen=True)
class ComparedNumber:
    """A published number and the measured number.

    Attributes:
        place: row and column of a table, or the pattern of a text.
        published: the number as the page shows it; two numbers are the ends of a range.
        measured: the measured number; None: the command's result has no such value.
        tolerance: the tolerance as the line states it.
        is_same: whether the measured number is within the tolerance.
    """

    place: str
    published: str
    measured: float | None
    tolerance: str
    is_same: bool


@dataclass(frozen=True)
class LineResult:
    """The result of a line.

    Attributes:
        name: name of the line.
        verdict: `same`: all numbers agree; `differs`; `failed`: the command has failed, or its
            result lacks a number; `skipped` and `by hand`: the command did not run.
        comparisons: the compared numbers.
        reason: why the command was not run or has failed, or that a check of its own has failed.
    """

    name: str
    verdict: Verdict
    comparisons: tuple[ComparedNumber, ...] = ()
    reason: str = ""

    @property
    def is_wrong(self) -> bool:
        return self.verdict in ("differs", "failed")


class CommandRunner:
    """Runs commands of pages, each command once, and keeps their JSON.

    Args:
        root: root folder of the checkout.
        files: word of a command → path that replaces the word.

    Attributes:
        unmet: commands that have written their result, and ended with 1: a check of their own has
            failed.
    """

    def __init__(self, root: Path, files: Mapping[str, Path]) -> None:
        for word, path in files.items():
            if not path.exists():
                raise ConfigError(f"--file {word}={path}: there is no such file or folder")
        self._root = root
        self._files = {word: path.resolve() for word, path in files.items()}
        self._found: dict[str, Any] = {}
        self.unmet: set[str] = set()

    def lacking(self, needs: Iterable[str]) -> str:
        """Return the first requirement of a line that this machine lacks; empty: it has all."""
        for need in needs:
            kind, _, name = need.partition(":")
            if kind == "module" and importlib.util.find_spec(name.partition(".")[0]) is None:
                return f"the Python module {name} is not installed"
            if kind == "program" and shutil.which(name) is None:
                return f"the program {name} is not installed"
            if kind == "variable" and not os.environ.get(name):
                return f"the environment variable {name} is not set"
            if kind == "file" and name not in self._files:
                return f"no file; add --file {name}=PATH"
        return ""

    def run(self, command: str, minutes: float) -> Any:
        """Return the JSON of a command.

        Raises:
            EvaluationError: the command has failed, has not ended in time, or writes no JSON.
        """
        if command not in self._found:
            try:
                self._found[command] = self._run(command, max(LEAST_S, 60.0 * SLOWER * minutes))
            except EvaluationError as error:
                self._found[command] = error
        found = self._found[command]
        if isinstance(found, EvaluationError):
            raise found
        return found

    def _run(self, command: str, most_s: float) -> Any:
        with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile() as output:
            folder = Path(name)
            result = folder / "result.json"
            words = self._words(command)
            if command.startswith(_WITH_JSON):
                words += ["--json", str(result)]
            place = folder if command.startswith("cavmarl ") else self._root
            paths = [str(self._root), *filter(None, [os.environ.get("PYTHONPATH")])]
            program = subprocess.Popen(
                dying_with_parent(words),
                cwd=place,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                code = program.wait(most_s)
            except subprocess.TimeoutExpired:
                raise EvaluationError(f"did not end within {most_s:.0f} s: {command}") from None
            finally:
                _end_group(program)
            if code == 1 and result.is_file():
                self.unmet.add(command)
            elif code:
                raise EvaluationError(
                    f"ended with exit code {code}: {_last_line(last_words(output))}"
                )
            if not result.is_file():
                raise EvaluationError(f"has written no result: {command}")
            try:
                return json.loads(result.read_text("utf-8"))
            except (ValueError, RecursionError) as error:
                raise EvaluationError(
                    f"has written a result that is not JSON ({error}): {command}"
                ) from error

    def _words(self, command: str) -> list[str]:
        words = shlex.split(command)
        for given, path in self._files.items():
            whole = re.compile(rf"(?<![\w.]){re.escape(given)}(?![\w.])")
            text = str(path).replace("\\", r"\\")  # backslashes of a replacement are doubled
            words = [whole.sub(text, word) for word in words]
        if words[0] in ("cavmarl", "python"):
            start = ["-m", "cavmarl"] if words[0] == "cavmarl" else []
            return [sys.executable, *start, *words[1:]]
        program = shutil.which(words[0])
        if program is None:
            raise EvaluationError(f"the program {words[0]} is not installed")
        return [program, *words[1:]]


def reproduce(
    lines: Mapping[str, PublishedLine], root: Path, runner: CommandRunner, *, quick: bool, say: Say
) -> Iterator[LineResult]:
    """Repeat lines and yield their results.

    Args:
        lines: lines by name.
        root: root folder of the checkout.
        runner: runs the commands.
        quick: whether to repeat only the quick rows of tables.
        say: called with the name of each line before it runs.

    Raises:
        ConfigError: a page does not have the numbers of a line.
    """
    for name, line in lines.items():
        say(name)
        cells = cells_of(name, line, root, quick=quick)
        if line.by_hand:
            yield LineResult(name, "by hand", reason=line.by_hand)
        elif reason := runner.lacking(line.needs):
            yield LineResult(name, "skipped", reason=reason)
        else:
            yield _repeated(name, line, cells, runner)


def _repeated(
    name: str, line: PublishedLine, cells: Sequence[PublishedCell], runner: CommandRunner
) -> LineResult:
    found: list[ComparedNumber] = []
    try:
        for cell in cells:
            document = runner.run(cell.command, line.minutes)
            found += _compared(cell, line, document)
    except EvaluationError as error:
        return LineResult(name, "failed", tuple(found), str(error))
    if not found:
        return LineResult(name, "failed", reason="the line compares nothing; add an expression")
    is_same = all(comparison.is_same for comparison in found)
    unmet = any(cell.command in runner.unmet for cell in cells)
    reason = "a check of the command itself has failed" if unmet else ""
    return LineResult(name, "same" if is_same else "differs", tuple(found), reason)


def _compared(cell: PublishedCell, line: PublishedLine, document: Any) -> Iterator[ComparedNumber]:
    """Yield the comparisons of a cell; a number that is missing in the result counts as wrong."""
    shown = _shown_numbers(cell, line.tolerance)
    if line.table:
        own = value_at(cell.row, document) if cell.row else document
        measured = _as_shown(numbers_at(cell.expressions[0], own), len(shown))
        for place, numbers in enumerate(shown):
            value = measured[place] if place < len(measured) else None
            yield _comparison(cell.place, numbers, value, line.tolerance)
        return
    for numbers, expression in zip(shown, cell.expressions, strict=False):
        if expression:
            found = numbers_at(expression, document)
            yield _comparison(cell.place, numbers, found[0] if found else None, line.tolerance)


def _shown_numbers(cell: PublishedCell, tolerance: str) -> list[tuple[str, ...]]:
    """Return the published numbers of a cell: single numbers, or pairs for ranges."""
    step = 2 if tolerance.startswith("range") else 1
    return [cell.numbers[k : k + step] for k in range(0, len(cell.numbers), step)]


def _as_shown(measured: list[float], count: int) -> list[float]:
    """Convert (mean, low, high) to (mean, half width) if the page shows two numbers."""
    if count == 2 and len(measured) == 3:
        mean, _, high = measured
        return [mean, high - mean]
    return measured


def _comparison(
    place: str, published: tuple[str, ...], measured: float | None, tolerance: str
) -> ComparedNumber:
    text = " to ".join(published)
    if measured is None or not math.isfinite(measured):
        return ComparedNumber(place, text, measured, tolerance, False)
    if tolerance.startswith("range"):
        low, high = map(as_number, published)
        share = float(tolerance.split()[1]) / 100.0 if " " in tolerance else 0.0
        is_same = low - share * abs(low) <= measured <= high + share * abs(high)
        return ComparedNumber(place, text, measured, tolerance, is_same)
    return ComparedNumber(place, text, measured, tolerance, _is_close(text, measured, tolerance))


def _is_close(published: str, measured: float, tolerance: str) -> bool:
    """Return whether a measured number equals the published one in its digits, or is close."""
    expected = as_number(published)
    if tolerance == "exact":
        decimals = len(published.partition(".")[2])
        return float(f"{measured:.{decimals}f}") == expected
    size, _, unit = tolerance.partition(" ")
    most = float(size) * (abs(expected) / 100.0 if unit else 1.0)
    return abs(measured - expected) <= most


def _end_group(program: subprocess.Popen[Any]) -> None:
    """End a program and all processes that it has started."""
    try:
        os.killpg(program.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    program.wait()


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it has printed nothing"
