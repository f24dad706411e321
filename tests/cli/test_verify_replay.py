"""`cavmarl verify --replay`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.cli.test_main import refusal, run
from tests.cli.test_verify_faults import BUSY, written

PLAN = {"crashes": [{"tick": 6, "point": "resolve", "zone": 1, "times": 4}]}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `verify` leaves of a tick that no host survives."""
    folder = tmp_path_factory.mktemp("kept")
    out = folder / "found.json"
    words = ("--zones", "4", "--steps", "8", "--faults", written(folder, PLAN), "--json", str(out))
    assert run(*BUSY, *words, "--set", f"zones.reproducers={folder}") == 1
    said = json.loads(out.read_text())["results"][0]["difference"]["values"][1]
    (path,) = re.findall(r"cavmarl verify --replay (\S+)$", said)
    return Path(path)


def test_the_tick_is_run_again(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again.json"
    assert run("verify", "--replay", str(kept), "--json", str(out)) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("grid4x4, tick 6 of the run, on record: zone 1 could not reach tick")
    found = json.loads(out.read_text())
    assert found["failure"] == found["recorded"]
    assert said[1:] == [
        "as it was: zone 1 could not reach tick 6: 4 hosts in a row died, the last one at "
        "'resolve', on purpose",
        f"without faults: reached, state {found['state_hash']}",
    ]
    assert re.fullmatch(r"[0-9a-f]{32}", found["state_hash"])


def test_what_cannot_be_run_again_is_refused(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "cannot be read" in refusal(capsys, "verify", "--replay", str(tmp_path / "nothing"))
    path = tmp_path / "damaged.json"
    path.write_bytes(kept.read_bytes()[:-9])
    assert "damaged" in refusal(capsys, "verify", "--replay", str(path))
    assert "ENV only" in refusal(capsys, "verify", "--replay", str(kept), "--zones", "4")
    assert "not the one" in refusal(capsys, "verify", "merge", "--replay", str(kept))
