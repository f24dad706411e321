"""`cavmarl verify workers`: its output, its files and its refused arguments."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.parallel.processes.worker_loop import COMMITTED
from cavmarl.parallel.processes.worker_processes import WorkerProcesses
from cavmarl.verify import worker_kills
from tests.cli.test_main import refusal, run

SMALL = ("ring", "--agents", "3", "--background", "4", "--worlds", "2")


def test_killing_workers_changes_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "kills.json"
    assert run("verify", "workers", *SMALL, "--kill", "4", "--zones", "2", "--json", str(path)) == 0
    assert "equal in all 22 steps" in capsys.readouterr().out
    found = json.loads(path.read_text())
    assert found["holds"]
    assert len(found["kills"]) == 4
    assert {kill["signal"] for kill in found["kills"]} <= {"SIGKILL", "SIGSTOP"}
    assert all(0.0 <= kill["replaced_ms"] <= kill["recovered_ms"] for kill in found["kills"])


def test_a_successor_without_the_state_is_detected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    replace = WorkerProcesses.replace

    def replace_without_the_state(
        processes: WorkerProcesses, k: int, mail: bytes | None, ordered: tuple[int, ...]
    ) -> str:
        processes.orders[k, COMMITTED] = -1
        return replace(processes, k, mail, ordered)

    monkeypatch.setattr(WorkerProcesses, "replace", replace_without_the_state)
    monkeypatch.setattr(
        worker_kills, "same_bytes", lambda *_: True
    )  # all results count as equal, so only states can differ
    assert run("verify", "workers", *SMALL, "--kill", "5") == 1
    assert "different after step" in capsys.readouterr().out


def test_different_results_of_equal_states_are_detected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = iter([True, True, False])
    monkeypatch.setattr(worker_kills, "same_bytes", lambda *_: next(answers))
    assert run("verify", "workers", *SMALL, "--kill", "1") == 1
    assert "different after step 2" in capsys.readouterr().out


def test_killing_workers_of_one_divided_world_changes_no_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    town = ("town", "--agents", "4", "--background", "30", "--worlds", "1", "--zones", "4")
    assert run("verify", "workers", *town, "--kill", "12", "--workers", "2") == 0
    assert "equal in all 46 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "words_of_the_error"),
    [
        (
            ("verify", "workers", "ring", "--kill", "1", "--backend", "slurm"),
            ("backend = 'slurm'", "'ray'"),
        ),
        (
            ("verify", "workers", "ring", "--kill", "1", "--backend", "nodes:2"),
            ("'nodes:2'", "verify nodes"),
        ),
        (
            ("verify", "workers", "ring", "--kill", "1", "--hosts", "ray"),
            ("--hosts was removed", "--backend"),
        ),
        (("verify", "workers", "ring", "--kill", "0"), ("kills = 0", "at least 1")),
        (
            ("verify", "workers", "ring", "--kill", "5", "--steps", "7"),
            ("steps = 7", "at least 15"),
        ),
        (
            ("verify", "workers", "ring", "--kill", "1", "--zones", "1,2"),
            ("--zones", "valid integer"),
        ),
        (
            ("verify", "workers", "ring", "--kill", "1", "--layout", "grid"),
            ("No such option", "--layout"),
        ),
        (
            ("verify", "workers", "ring", "--kill", "1", "--workers", "3", "--worlds", "2"),
            ("workers = 3",),
        ),
    ],
)
def test_invalid_arguments_are_refused(
    words: tuple[str, ...], words_of_the_error: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    said = refusal(capsys, *words)
    assert all(word in said for word in words_of_the_error), said
