"""`cavmarl zoo`: the list of trained drivers, their verification, and mixed traffic."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.config.registry import agent_entries
from cavmarl.core.machine import describe_hardware
from cavmarl.evaluate.evaluation import run_seeds

pytestmark = pytest.mark.integration  # a manifest reads the commit from git


def test_the_list_contains_the_environment_of_each_driver(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "zoo.json"
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "list", "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["merge_ippo"]["environment"] == "merge-v6"
    assert "merge_ippo" in capsys.readouterr().out


def test_the_error_for_a_difference_names_both_hashes_and_both_processors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = Path(shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "merge_ippo"))
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    document["job"] |= {"episodes": 1, "seed": 3}
    document |= {"episodes": 1, "seeds": run_seeds(3, len(document["seeds"]))}
    document["hardware"] |= {"cpu": "Another Processor", "architecture": "a64"}
    path.write_text(json.dumps(document))
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "verify", str(entry), "--json", str(tmp_path / "found.json")])
    assert ended.value.code == 1
    found = json.loads((tmp_path / "found.json").read_text())
    said = capsys.readouterr()
    for file, digest in document["results_sha256"].items():
        if file in found["expected"]:
            both = f"(expected {digest[:12]}, found {found['found'][file][:12]})"
            assert f"{file}: differs {both}" in said.out
    assert "merge_ippo: 3 of 3 files differ" in said.err
    here = describe_hardware()
    assert "expected from Another Processor (a64)" in said.err
    assert f"found on {here['cpu']} ({here['architecture']})" in said.err


def test_the_list_shows_the_other_drivers_if_one_result_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = Path(shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "agents" / "old"))
    path = old / "result" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"metrics_version": 1}))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "list", "--json", "zoo.json"])
    assert ended.value.code == 1
    told = json.loads(Path("zoo.json").read_text())
    assert told["merge_ippo"]["environment"] == "merge-v6"
    assert list(told["old"]) == ["refused"]
    said = capsys.readouterr()
    assert "merge_ippo" in said.out
    assert "error: old: " in said.err
    assert "evaluate again" in " ".join(said.err.split())


def test_zoo_cross_prints_the_results_of_each_driver_among_vehicles_of_each_driver(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cross.json"
    words = ["zoo", "cross", "ring", "-p", "idm", "-p", "random_actions", "-n", "1"]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["random_actions"]["idm"]["success"] == 0.0
    assert "among idm" in capsys.readouterr().out
