"""`cavmarl scenario`: the list, single runs, and sweeps over maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.traffic.scenarios.library import scenario_names


def code(*words: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(words)
    return int(end.value.code or 0)


def test_the_list_has_all_scenarios_with_their_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code("scenario", "list", "--json", str(tmp_path / "list.json")) == 0
    said = capsys.readouterr().out
    listed = json.loads((tmp_path / "list.json").read_text(encoding="utf-8"))
    assert listed.pop("kind") == "scenario list"
    assert list(listed) == scenario_names()
    for name, about in listed.items():
        assert name in said
        assert {"name", "default", "range", "what"} == set(about["parameters"][0])


def test_a_run_prints_its_outcome(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pygame")
    words = ["scenario", "run", "pedestrian_crossing", "--param", "occluded=true"]
    kept, seen = tmp_path / "run.json", tmp_path / "closest.png"
    assert code(*words, "--json", str(kept), "--picture", str(seen)) == 0
    assert "passed" in capsys.readouterr().out
    found = json.loads(kept.read_text(encoding="utf-8"))
    assert (found["verdict"], found["collisions"]) == ("passed", 0)
    assert found["min_ttc_s"] > 0.0
    assert len(found["state_hash"]) == 32
    assert seen.stat().st_size > 1000
    assert code(*words, "--driver", "never_yield", "--zones", "2") == 1
    assert "collided" in capsys.readouterr().out


def test_a_run_fails_if_actors_touch_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Cars of 5 m follow each other at 4.9 m/s and 1 s between their centres, so they overlap.
    words = ["unprotected_left_turn", "--param=oncoming_mps=4.9", "--param=gap_s=1"]
    words += ["--param=cars=2"]
    assert code("scenario", "run", *words, "--json", str(tmp_path / "run.json")) == 1
    assert "passed; failed: actors 0 and 1 touched at" in " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert (found["verdict"], found["verdicts"]) == ("actors collided", ["passed"])


def test_a_sweep_prints_which_drivers_pass_on_each_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "sweep.json"
    words = ["scenario", "sweep", "road_closure", "--map", "grid4x4", "--map", "ring"]
    assert code(*words, "--seeds", "2", "--json", str(kept)) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "| `road_closure` | grid4x4 | 2 passed |" in said
    assert "| `road_closure` | ring | no place |" in said
    here, nowhere = json.loads(kept.read_text(encoding="utf-8"))["rows"]
    assert [run["verdict"] for run in here["failing"]] == ["collided"] * 2
    assert (here["holds"], nowhere["passing"]) == (True, [])
    assert code(*words, "--seeds", "1", "--fails", "idm") == 1


def test_a_scenario_runs_for_several_agents(capsys: pytest.CaptureFixture[str]) -> None:
    assert code("scenario", "run", "signal_outage", "--agents", "2") == 0
    said = capsys.readouterr().out
    assert "passed, passed" in said
    assert "idm (2 agents)" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing"], "Choose one of: failed_u_turn"),
        (["pedestrian_crossing", "--param", "walk_mps"], "must be KEY=VALUE"),
        (["pedestrian_crossing", "--param", 'walk_mps="fast"'], "must be KEY=VALUE"),
        (["pedestrian_crossing", "--map", "ring"], "has no place for it"),
        (["failed_u_turn", "--agents", "99"], "and at most"),
        (["signal_outage", "--map", "merge"], "it needs a signal"),
        (["pedestrian_crossing", "--density", "some"], "must be one of none, low, high"),
        (["pedestrian_crossing", "--picture", "crossing.jpg"], "must end in .png"),
    ],
)
def test_wrong_arguments_are_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code("scenario", "run", *words) == 2
    assert message in " ".join(capsys.readouterr().err.split())
