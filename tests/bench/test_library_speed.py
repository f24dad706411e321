"""What the views of libraries cost: each that is installed is measured on the same world."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.bench import library_speed
from cavmarl.bench.library_speed import measure_library_speed
from cavmarl.core.errors import ConfigError


def test_every_view_is_measured_or_says_how_to_install_it() -> None:
    found = measure_library_speed("merge", agents=3, steps=2)
    assert [row.view for row in found.rows] == list(library_speed.VIEWS)
    for row in found.rows:
        if row.step_ms is None:
            assert "pip install 'cavmarl[" in row.missing
        else:
            assert row.step_ms > 0.0
    assert json.loads(json.dumps(found.to_dict()))["agents"] == 3


def test_all_views_step_the_same_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """The seeds and the actions are the same, so the rewards have to be."""
    settings = {
        "agents": 3,
        "background": 0,
        "overrides": {"population.mode": "seats", "action.kind": "continuous"},
    }
    arrays = library_speed._arrays("merge", settings)
    dicts = library_speed._dicts("merge", settings)
    rows = library_speed._gymnasium("merge", settings)
    for _ in range(20):
        wanted = arrays()[1].ravel().tolist()  # type: ignore[index]
        assert list(dicts()[1].values()) == wanted  # type: ignore[index]
        assert rows()[1].tolist() == wanted  # type: ignore[index]


@pytest.mark.parametrize(("name", "value"), [("agents", 0), ("agents", 20_000), ("steps", 0)])
def test_numbers_out_of_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(ConfigError, match=f"{name} = {value}: must be from 1 to"):
        measure_library_speed("merge", **{name: value})


def test_the_command_prints_a_table_and_holds_a_bound(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from cavmarl.cli import app

    pytest.importorskip("torchrl", reason="needs the extra: torchrl")
    words = ["bench", "libraries", "--env", "merge", "--agents", "2", "--steps", "1"]
    words += ["--json", str(tmp_path / "found.json")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "TorchRL" in done.output
    assert len(json.loads((tmp_path / "found.json").read_text())["rows"]) == 6
    assert CliRunner().invoke(app, [*words, "--at-most", "1e-9"]).exit_code == 1
