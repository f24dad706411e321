"""`cavmarl zoo`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.cli import main

pytest.importorskip("torch")

pytestmark = pytest.mark.integration  # a manifest asks git for the commit


def test_the_list_has_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "zoo.json"
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "list", "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["merge_ippo"]["environment"] == "merge-v1"
    assert "merge_ippo" in capsys.readouterr().out


def test_a_matrix_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cross.json"
    words = ["zoo", "cross", "ring", "-p", "idm", "-p", "random_actions", "-n", "1"]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", str(out)])
    assert ended.value.code == 0
    told = json.loads(out.read_text())
    assert told["random_actions"]["idm"]["success"] == 0.0
    assert "among idm" in capsys.readouterr().out
