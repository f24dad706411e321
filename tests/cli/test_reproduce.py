"""`cavmarl reproduce`: measures published numbers again, and exits with 1 if one is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.cli import main

pytestmark = pytest.mark.integration  # each command of a published line is a process

LINES = """
lines:
  rate:
    page: page.md
    text: ["makes {} steps"]
    command: python -m benchmarks speed
    values: [rate]
    quick: true
  rows:
    page: page.md
    table: n
    command: python -m benchmarks speed
    row: "rows[n=ROW]"
    columns: {x: x}
  week:
    page: page.md
    section: Page
    command: make soak
    by_hand: It takes a week.
"""
PAGE = "# Page\n\nIt makes 12 steps.\n\n| n | x |\n|---|---|\n"
PAGE += "".join(f"| {n} | {10 * n} |\n" for n in range(6))
PROGRAM = """
import json, sys
rows = [{"n": n, "x": 10 * n} for n in range(6)]
json.dump({"rate": 12, "rows": rows}, open(sys.argv[sys.argv.index("--json") + 1], "w"))
"""


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "docs/figures").mkdir(parents=True)
    (tmp_path / "docs/figures/lines.yaml").write_text(LINES)
    (tmp_path / "page.md").write_text(PAGE)
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks/__init__.py").touch()
    (tmp_path / "benchmarks/__main__.py").write_text(PROGRAM)
    monkeypatch.setattr("cavmarl.verify.published_lines.repository_root", lambda: tmp_path)
    return tmp_path


def called(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[object, str, str]:
    """Return exit code, output without line breaks, and errors of a call."""
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", *words])
    found = capsys.readouterr()
    return ended.value.code, " ".join(found.out.split()), " ".join(found.err.split())


def test_all_published_lines_are_measured_again(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = checkout / "report.json"
    code, out, _ = called(capsys, "--all", "--json", str(report))
    assert code == 0
    assert "rate 12 12 exact same" in out
    assert "rows 6 numbers same" in out
    assert "by hand: It takes a week." in out
    assert "2 same, 1 by hand" in out
    lines = json.loads(report.read_text())["lines"]
    assert [line["verdict"] for line in lines] == ["same", "same", "by hand"]
    assert lines[0]["comparisons"][0]["measured"] == 12


def test_selected_published_lines_are_measured_again(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = called(capsys, "--quick")
    assert (code, out.count("same")) == (0, 2)
    assert "1 same" in out
    code, out, _ = called(capsys, "rows")
    assert (code, "rows 6 numbers same" in out) == (0, True)


def test_a_wrong_published_number_is_shown(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (checkout / "page.md").write_text(PAGE.replace("| 3 | 30 |", "| 3 | 31 |"))
    code, out, err = called(capsys, "--all")
    assert code == 1
    assert "rows: 3, x 31 30 exact differs" in out
    assert "2, x" not in out
    assert "error: rows: measured numbers differ from the page; correct the page, or" in err


def test_results_before_an_error_are_shown(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = checkout / "report.json"
    (checkout / "page.md").write_text(PAGE.replace("| n | x |", "| m | x |"))
    code, out, err = called(capsys, "--all", "--json", str(report))
    assert code == 2
    assert "rate 12 12 exact same" in out
    assert "1 same, 2 not repeated" in out
    assert "has 0 tables" in err
    assert len(json.loads(report.read_text())["lines"]) == 1


def test_published_lines_are_listed(checkout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = called(capsys, "--list")
    assert code == 0
    assert "rate page.md 1 quick python -m benchmarks speed" in out
    assert "rows page.md 6 1 min" in out
    assert "by hand make soak" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "nothing to repeat: name lines, or use --quick, --all or --list"),
        (("gone",), "gone: is not a line; `cavmarl reproduce --list` lists them"),
        (("--quick", "--all"), "--quick and --all: use only one of the two"),
        (("rate", "--all"), "--all and rate: name lines, or leave out the names"),
        (("--quick", "--file", "MAPS"), "--file MAPS: must be WORD=PATH, for example MAPS=maps"),
        (("--quick", "--file", "MAPS=gone"), "MAPS=gone: there is no such file or folder"),
        (("week", "--quick"), "week: --quick does not repeat this line"),
    ],
)
def test_wrong_use_is_refused(
    words: tuple[str, ...], message: str, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = called(capsys, *words)
    assert code == 2
    assert message in err


def test_a_published_line_without_its_number_is_refused(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (checkout / "page.md").write_text(PAGE.replace("12", "many"))
    code, _, err = called(capsys, "--all")
    assert code == 2
    assert "rate: page.md has no text 'makes {} steps'; write the pattern so that" in err
