"""`cavmarl plan`: assignments of zones to workers, and zones cut by measured costs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.test_main import refusal, run

QUICK = ("--steps", "5", "--before", "1", "--agents", "2", "--background", "8")


def test_a_plan_is_printed_stored_and_recomputed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "plan.json"
    words = ("plan", "grid4x4", "--zones", "4", "--workers", "2", "--worlds", "2", *QUICK)
    assert run(*words, "--snapshot", "idle", "--json", str(path)) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("8 shards on 2 workers")
    assert "supposed idle" in shown
    assert run("plan", "--again", str(path)) == 0
    assert capsys.readouterr().out == shown
    assert run(*words, "--snapshot", str(path)) == 0
    document = json.loads(path.read_text())
    document["shards"][0]["worker"] = 1 - document["shards"][0]["worker"]
    path.write_text(json.dumps(document))
    assert run("plan", "--again", str(path)) == 1
    assert "the recomputed plan differs" in capsys.readouterr().err


def test_an_impossible_plan_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    few = ("plan", "ring", "--zones", "2", "--snapshot", "idle", *QUICK)
    assert "3 workers for 2 shards" in refusal(capsys, *few, "--workers", "3")
    assert "--workers 0" in refusal(capsys, *few, "--workers", "0")
    assert "the environment is missing" in refusal(capsys, "plan")
    assert "cannot be read" in refusal(capsys, "plan", "--again", str(tmp_path / "none"))
    path = tmp_path / "other.json"
    path.write_text("[]")
    assert "not a plan" in refusal(capsys, "plan", "--again", str(path))
    assert "no schema" in refusal(capsys, "plan", "ring", "--snapshot", str(path))


def test_the_error_names_the_exceeded_limit_of_each_worker(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "plan.json"
    words = ("plan", "ring", "--zones", "2", "--workers", "2", *QUICK, "--snapshot")
    assert run(*words, "idle", "--json", str(path)) == 0
    document = json.loads(path.read_text())
    for worker in document["snapshot"]["workers"]:
        worker["use"]["cpu"] = 0.99
    path.write_text(json.dumps(document))
    said = refusal(capsys, *words, str(path))
    assert "no admissible worker: worker 0: cpu 0.99 > 0.85; worker 1: cpu 0.99 > 0.85" in said
    assert "with --snapshot idle the plan assumes" in said
    three = ("plan", "ring", "--zones", "3", "--workers", "3", *QUICK, "--snapshot")
    assert "has 2 workers, but --workers is 3" in refusal(capsys, *three, str(path))


def test_zones_can_be_cut_by_measured_costs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "zones.json"
    rush = (
        "plan",
        "rush",
        "--zones",
        "4",
        "--workers",
        "2",
        "--snapshot",
        "idle",
        "--agents",
        "50",
    )
    short = ("--steps", "5", "--before", "5")
    assert run(*rush, *short, "--layout", "grid", "--write-zones", str(path)) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith(f"new zones in {path}: ")
    assert "of 50 vehicles change zone" in said
    assert run(*rush, *short, "--layout", str(path)) == 0
    assert (
        run("verify", "zones", "rush", "--zones", "4", "--layout", str(path), "--steps", "5") == 0
    )
    path.unlink()
    assert run(*rush, *short, "--tolerance", "4", "--write-zones", str(path)) == 0
    assert "is not written" in capsys.readouterr().out
    assert not path.exists()
