"""Each result file (`--json`) names the command that wrote it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport
from cavmarl.cli import app
from cavmarl.cli.output import Seed

COMMANDS = {
    "list": ["list"],
    "scenario list": ["scenario", "list"],
    "demand random": ["demand", "random", "grid4x4", "--out", "x.rou.xml"],
    "map check": ["map", "check", "grid4x4"],
    "plan": ["plan", "grid4x4", "--zones", "2", "--workers", "2", "--snapshot", "idle"],
    "verify zones": ["verify", "zones", "ring", "--zones", "2", "--steps", "2"],
}


@pytest.mark.parametrize("kind", list(COMMANDS))
def test_a_result_file_names_its_command(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shown = CliRunner().invoke(app, [*COMMANDS[kind], "--json", "found.json"])
    assert Path("found.json").exists(), shown.output
    document = json.loads(Path("found.json").read_text(encoding="utf-8"))
    assert next(iter(document)) == "kind"
    assert document["kind"] == kind
    assert len(document) > 1


def test_a_result_file_of_a_benchmark_names_its_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(say: object, seed: Seed = 0) -> BenchmarkReport:
        """Measure nothing."""
        return BenchmarkReport("none", {"name": "name"}, [{"name": "a", "seed": seed}])

    monkeypatch.setattr("sys.argv", ["benchmarks.none"])
    with pytest.raises(SystemExit, match="0"):
        run(measure, ["--json", str(tmp_path / "found.json")])
    document = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert document["kind"] == "benchmarks none"
    assert document["rows"] == [{"name": "a", "seed": 0}]
