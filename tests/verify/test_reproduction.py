"""Repeat the commands behind published numbers, and compare the results with the pages."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.verify.published_lines import PublishedLine, read_lines
from cavmarl.verify.reproduction import CommandRunner, LineResult, reproduce
from cavmarl.verify.result_paths import numbers_at

pytestmark = pytest.mark.integration  # these tests start processes

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import json, os, sys, time
name, *words = sys.argv[1:]
with open("calls.txt", "a") as file:
    file.write(name + chr(10))
if name == "fails":
    sys.exit("out of paint")
if name == "hangs":
    if os.fork() == 0:
        open("child.txt", "w").write(str(os.getpid()))
    time.sleep(60)
document = {"rate": 1234.56, "rows": [{"n": 1, "x": 0.25}, {"n": 2, "x": 4}], "name": name}
document["words"] = words
if name == "broken":
    open(words[words.index("--json") + 1], "w").write('{"rate": 12')
elif name != "silent":
    json.dump(document, open(words[words.index("--json") + 1], "w"))
if name == "misses":
    sys.exit(1)
"""
PAGE = """It makes 1,235 steps in 0.3 s, or 1,000 to 1,200 on others; sometimes 4 %.

| n | x |
|---|---|
| 1 | 0.25 |
| 2 | 4.0 |
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "page.md").write_text(PAGE)
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks/__init__.py").touch()
    (tmp_path / "benchmarks/__main__.py").write_text(PROGRAM)
    return tmp_path


def results(
    checkout: Path, *lines: PublishedLine, quick: bool = False, **files: Path
) -> list[LineResult]:
    named = {f"line{number}": line for number, line in enumerate(lines)}
    runner = CommandRunner(checkout, files)
    return list(reproduce(named, checkout, runner, quick=quick, say=lambda name: None))


def text(
    *patterns: str, values: tuple[str, ...] = (), name: str = "speed", **keys: Any
) -> PublishedLine:
    return PublishedLine(
        "page.md", f"python -m benchmarks {name}", text=patterns, values=values, **keys
    )


@pytest.mark.parametrize(
    ("pattern", "value", "tolerance", "verdict"),
    [
        ("makes {} steps", "rate", "exact", "same"),
        ("makes {} steps", "0.99 rate", "exact", "differs"),
        ("makes {} steps", "0.99 rate", "2 %", "same"),
        ("makes {} steps", "0.97 rate", "2 %", "differs"),
        ("makes {} steps", "0.99 rate", "20", "same"),
        ("makes {} steps", "0.97 rate", "20", "differs"),
        ("in {} s", "rows[n=1].x", "exact", "differs"),  # 0.2, because halves are rounded to even
        ("or {} to {} on others", "rate", "range", "differs"),
        ("or {} to {} on others", "rate", "range 5 %", "same"),
        ("or {} to {} on others", "0.7 rate", "range 5 %", "differs"),
    ],
)
def test_numbers_are_compared_within_a_tolerance(
    pattern: str, value: str, tolerance: str, verdict: str, checkout: Path
) -> None:
    (found,) = results(checkout, text(pattern, values=(value,), tolerance=tolerance))
    assert found.verdict == verdict
    assert found.is_wrong == (verdict == "differs")


def test_rows_of_a_table_are_compared_and_a_command_runs_once(checkout: Path) -> None:
    command = "python -m benchmarks speed"
    line = PublishedLine(
        "page.md", command, table="n", row="rows[n=ROW]", columns={"x": "x"}, quick_rows=("2",)
    )
    (all_rows,) = results(checkout, line)
    assert [(one.place, one.published, one.measured) for one in all_rows.comparisons] == [
        ("1, x", "0.25", 0.25),
        ("2, x", "4.0", 4.0),
    ]
    one, other = results(checkout, line, line, quick=True)
    assert [found.place for found in one.comparisons] == ["2, x"]
    assert other.verdict == "same"
    assert (checkout / "calls.txt").read_text().splitlines() == ["speed", "speed"]


def test_a_wrong_number_on_a_page_is_reported(checkout: Path) -> None:
    (checkout / "page.md").write_text(PAGE.replace("4.0", "4.1"))
    line = PublishedLine(
        "page.md", "python -m benchmarks speed", table="n", row="rows[n=ROW]", columns={"x": "1 x"}
    )
    (found,) = results(checkout, line)
    assert found.verdict == "differs"
    assert [one.published for one in found.comparisons if not one.is_same] == ["4.1"]


def test_a_line_with_a_missing_requirement_is_skipped_with_the_reason(
    checkout: Path, monkeypatch: Any
) -> None:
    monkeypatch.delenv("NOT_SET", raising=False)
    needs = ("module:not_installed", "program:not_there", "variable:NOT_SET", "file:MAPS")
    lines = [text("sometimes {} %", values=("rate",), needs=(need,)) for need in needs]
    found = results(checkout, *lines)
    assert {one.verdict for one in found} == {"skipped"}
    assert [one.reason for one in found] == [
        "the Python module not_installed is not installed",
        "the program not_there is not installed",
        "the environment variable NOT_SET is not set",
        "no file; add --file MAPS=PATH",
    ]
    (by_hand,) = results(checkout, text("sometimes {} %", by_hand="It takes a week."))
    assert (by_hand.verdict, by_hand.reason) == ("by hand", "It takes a week.")
    assert not (checkout / "calls.txt").exists()


def test_a_failed_command_is_reported_with_the_reason(checkout: Path) -> None:
    lines = [
        text("sometimes {} %", values=("rate",), name="fails"),
        text("sometimes {} %", values=("speed",)),
        text("sometimes {} %", values=("rate",), name="silent"),
        text("sometimes {} %", values=("rate",), name="broken"),
    ]
    found = results(checkout, *lines)
    assert {one.verdict for one in found} == {"failed"}
    assert "ended with exit code 1: out of paint" in found[0].reason
    assert "has no speed at its top" in found[1].reason
    assert "has written no result" in found[2].reason
    assert "has written a result that is not JSON" in found[3].reason


def test_numbers_of_a_command_are_compared_even_if_its_own_check_fails(checkout: Path) -> None:
    (found,) = results(checkout, text("makes {} steps", values=("rate",), name="misses"))
    assert (found.verdict, found.reason) == ("same", "a check of the command itself has failed")


def test_names_of_files_in_a_command_are_replaced_by_paths(checkout: Path) -> None:
    line = text("sometimes {} %", values=("len words",), name="speed MAPS/a.xml MAPS2")
    assert line.command.endswith("MAPS/a.xml MAPS2")
    maps = checkout / "with a space"
    maps.mkdir()
    runner = CommandRunner(checkout, {"MAPS": maps})
    words = runner.run(line.command, 1.0)["words"]
    assert words[:2] == [f"{maps}/a.xml", "MAPS2"]
    with pytest.raises(ConfigError, match="--file MAPS=gone: there is no such file or folder"):
        CommandRunner(checkout, {"MAPS": Path("gone")})


def test_a_command_that_takes_too_long_is_ended_with_its_children(
    checkout: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr("cavmarl.verify.reproduction.LEAST_S", 1.0)
    line = text("sometimes {} %", values=("rate",), name="hangs", minutes=0.0)
    (found,) = results(checkout, line)
    assert "did not end within 1 s" in found.reason
    child = int((checkout / "child.txt").read_text())
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline and is_running(child):
        time.sleep(0.05)
    assert not is_running(child)


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()


FOUND: dict[str, Any] = {
    "rows": [{"n": 1, "name": "a, b", "x": [3, 5]}, {"n": 2.0, "name": "c", "x": [7]}],
    "odd, key": "1,234 to 1,300 (2)",
    "none": None,
    "policies": {
        "idm": {
            "success": {
                "mean": 0.5,
                "between_run_ci95": None,
                "within_run": [{"wilson95": {"low": 0.25, "high": 0.75}}],
            },
            "delay_s": {"mean": 3.0, "between_run_ci95": None, "within_run": [{"wilson95": None}]},
            "none": {"mean": None, "between_run_ci95": None, "within_run": []},
        }
    },
}


@pytest.mark.parametrize(
    ("expression", "numbers"),
    [
        ("rows[n=1].x", [3, 5]),
        ("rows[n=2].x", [7]),
        ("rows[name={a, b},n=1].x.1", [5]),
        ("10 max rows.*.x", [70]),
        ("len rows.*.n", [2]),
        ("sum rows.0.x / rows.1.x", [8 / 7]),
        ("rows.0.x ; rows.1.x", [3, 7]),
        ("{odd, key}", [1234, 1300, 2]),
        ("third {odd, key}", [2]),
        ("none", []),
        ("policies.idm.success", [50, 25, 75]),
        ("policies.idm.delay_s", [3]),
    ],
)
def test_an_expression_selects_numbers_of_a_result(expression: str, numbers: list[float]) -> None:
    assert numbers_at(expression, FOUND) == pytest.approx(numbers)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("rows.5.x", r"has no 5 at rows\."),
        ("rows[n=3].x", r"has no \[n=3\] at rows"),
        ("rows[m=3].x", r"has no \[m=3\] at rows"),
        ("policies.sumo", r"has no sumo at policies\..*\(idm\); correct the expression"),
        ("policies", "which is not a number"),
        ("fourth {odd, key}", "has too few numbers"),
        ("rows.0.n / none", "has too few numbers"),
    ],
)
def test_wrong_expressions_are_refused(expression: str, message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        numbers_at(expression, FOUND)


QUICK = {name: line for name, line in read_lines(ROOT).lines.items() if line.is_quick}


@pytest.fixture(scope="module")
def runner() -> CommandRunner:
    return CommandRunner(ROOT, {})


@pytest.mark.parametrize("name", QUICK)
def test_a_published_number_is_reproduced(name: str, runner: CommandRunner) -> None:
    (found,) = reproduce({name: QUICK[name]}, ROOT, runner, quick=True, say=lambda name: None)
    assert found.verdict == "same", found


def test_is_running_finds_a_running_process() -> None:
    program = subprocess.Popen(["sleep", "60"])
    assert is_running(program.pid)
    program.kill()
    program.wait()
    assert not is_running(program.pid)
