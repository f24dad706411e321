"""The speed of workers, compared with the speed of independent programs on the same cores."""

from __future__ import annotations

import json
import multiprocessing
from pathlib import Path

import pytest

from benchmarks import workers
from benchmarks.program import run
from benchmarks.worker_speed import CoreCeiling, measure_ceiling
from cavmarl import ConfigError
from cavmarl.core.errors import WorkerError


def test_all_independent_programs_step_and_end() -> None:
    before = {*multiprocessing.active_children()}
    found = measure_ceiling("ring", worlds=3, programs=2, steps=2, repeats=2, agents=2, alike=True)
    assert found.programs == 2
    assert len(found.alone_ms) == len(found.together_ms) == 2
    assert min(found.alone_ms + found.together_ms) > 0.0
    assert {*multiprocessing.active_children()} <= before
    assert found.facts()["ratio"] == found.ratio


def test_the_ratio_is_that_of_the_median_turn() -> None:
    assert CoreCeiling(2, (4.0, 8.0, 6.0), (2.0, 5.0, 6.0)).ratio == 1.6


def test_more_programs_than_worlds_are_refused() -> None:
    with pytest.raises(ConfigError, match="3 programs, 2 worlds"):
        measure_ceiling("ring", worlds=2, programs=3)


def test_a_program_that_cannot_start_is_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    before = {*multiprocessing.active_children()}
    with pytest.raises(WorkerError, match="has ended"):
        measure_ceiling("no such place", worlds=2)
    assert "no such place" in capfd.readouterr().err
    assert {*multiprocessing.active_children()} <= before


def test_the_benchmark_compares_workers_with_independent_programs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "speed.json"
    words = ["ring", "--agents", "3", "--background", "4", "--worlds", "2", "--steps", "2"]
    words += ["--repeats", "2", "--json", str(path), "--at-least", "100"]
    with pytest.raises(SystemExit) as ended:
        run(workers.measure, words)
    assert ended.value.code == 1
    found = json.loads(path.read_text())
    assert [row["workers"] for row in found["rows"]] == [0, 1, 2]
    assert all(len(row["step_ms"]) == 2 for row in found["rows"])
    assert found["ratio"] > 0.0
    assert found["barrier_us"][0] <= found["barrier_us"][1] <= found["barrier_us"][3]
    assert found["hardware"]["usable_cores"] >= 1
    assert found["ceiling"]["ratio"] > 0.0
    assert "an empty command to all 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--workers", "1"), "1 workers, 20 steps, 7 turns: must be at least 2"),
        (("--at-least", "-1"), "--at-least -1: must be a number above 0"),
    ],
)
def test_invalid_numbers_are_refused(
    words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(workers.measure, ["ring", *words])
    assert ended.value.code == 2
    assert told in " ".join(capsys.readouterr().err.split())
