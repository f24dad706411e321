"""`cavmarl zoo`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.config.registry import agent_entries

pytest.importorskip("torch")

pytestmark = pytest.mark.integration  # a manifest asks git for the commit


def test_the_list_has_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "zoo.json"
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "list", "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["merge_ippo"]["environment"] == "merge-v5"
    assert "merge_ippo" in capsys.readouterr().out


def test_an_old_result_hides_no_other(
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
    assert told["merge_ippo"]["environment"] == "merge-v5"
    assert list(told["old"]) == ["refused"]
    said = capsys.readouterr()
    assert "merge_ippo" in said.out
    assert "error: old: " in said.err
    assert "evaluate again" in " ".join(said.err.split())


def test_a_matrix_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cross.json"
    words = ["zoo", "cross", "ring", "-p", "idm", "-p", "random_actions", "-n", "1"]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["random_actions"]["idm"]["success"] == 0.0
    assert "among idm" in capsys.readouterr().out
