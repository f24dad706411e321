"""`cavmarl journal`: the contents of a log, and the refusal of a damaged log."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.handoff.coordinator.journal import Journal
from tests.cli.test_main import refusal, run
from tests.handoff.test_journal import run_events


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "run.journal"
    with Journal(path) as journal:
        journal.append(run_events().log)
    return path


def printed_words(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_the_command_counts_events_and_names_the_owners(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("journal", str(written)) == 0
    said = printed_words(capsys)
    for part in (
        f"run {bytes(range(16)).hex()}",
        "ticks 6, 1 to 6",
        "2 entered, 1 left",
        "2, 1 of them forced; 2 deferred by a tick",
        "3 named, 1 fenced",
        "1 1 1 2 hosted",
    ):
        assert part in said
    assert "note" not in said


def test_the_command_prints_the_owners_of_a_tick(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "owners.json"
    assert run("journal", str(written), "--at", "4", "--json", str(out)) == 0
    assert "7 1 1 0 8 1 0 2" in printed_words(capsys)
    assert json.loads(out.read_text()) == {
        "kind": "journal",
        "tick": 4,
        "owners": [[7, 1, 1, 0], [8, 1, 0, 2]],
    }


def test_a_dropped_incomplete_line_is_reported(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written.write_bytes(written.read_bytes()[:-5])
    assert run("journal", str(written)) == 0
    said = printed_words(capsys)
    assert "tick 6 was started but not committed" in said
    assert "is cut short" in said


def test_errors_of_damage_and_unknown_ticks_have_one_line(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "tick 99 was not committed" in refusal(capsys, "journal", str(written), "--at", "99")
    lines = written.read_bytes().splitlines(keepends=True)
    written.write_bytes(b"".join(lines[:2] + lines[3:]))
    said = refusal(capsys, "journal", str(written))
    assert f"error: {written}: line 3 of the log has number 3, so lines are missing" in said
    said = refusal(capsys, "journal", str(written.parent / "none.journal"))
    assert "none.journal" in "".join(said.replace("│", "").split()), "the missing file is not named"
