"""Output for new users: lists with descriptions, folders of recordings, figures with notes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import cavmarl
from cavmarl.cli import app
from cavmarl.cli.evaluate import driver_cell
from cavmarl.config.entry_cards import sentence_about
from cavmarl.config.registry import agent_entries, entries
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.metrics import KM_PER_INFRACTION, METRICS
from cavmarl.evaluate.report import Found, PolicyReport


def run(*words: str) -> str:
    done = CliRunner().invoke(app, words, catch_exceptions=False, env={"COLUMNS": "80"})
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("path", [*entries().values(), *agent_entries().values()], ids=str)
def test_each_entry_is_described_by_a_sentence(path: Path) -> None:
    found = sentence_about(path)
    assert found != str(path)
    assert len(found.split()) > 3
    assert not set("[]`*") & set(found)


def test_an_entry_without_a_docstring_is_described_by_its_path(tmp_path: Path) -> None:
    script = tmp_path / "mine.py"
    assert sentence_about(tmp_path) == str(tmp_path)
    script.write_text("def make_policy(env): ...")
    assert sentence_about(script) == str(script)
    script.write_text('"""Brakes always. Never steers."""')
    assert sentence_about(script) == "Brakes always."


def test_lists_fit_eighty_columns() -> None:
    for words in (("list",), ("zoo", "list")):
        lines = run(*words).splitlines()
        assert max(map(len, lines)) <= 80
        assert any("A driver for unseen maps" in line for line in lines)


def test_a_folder_of_recordings_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    for name in ("one", "deep/two"):
        env = cavmarl.parallel_env("ring", agents=1, record=f"runs/{name}")
        env.reset(seed=0)
        env.step(env.suggest_actions())
        env.close()
    shown = run("replay", "runs", "--json", "list.json")
    assert "runs/one" in shown
    listed = json.loads(Path("list.json").read_text(encoding="utf-8"))["recordings"]
    assert list(listed) == ["runs/deep/two", "runs/one"]
    counts = {key: listed["runs/one"][key] for key in ("worlds", "episodes", "whole")}
    assert counts == {"worlds": 1, "episodes": 1, "whole": True}
    with pytest.raises(ConfigError, match="holds 2 recordings; name one: runs/deep/two"):
        run("replay", "runs", "--csv", "a.csv")


def report(**means: float | None) -> PolicyReport:
    names = [metric.name for metric in METRICS]
    nothing = Found(None, None, ())
    found = {name: replace(nothing, mean=means.get(name, 0.0)) for name in names}
    return PolicyReport(3, found, {}, ())


def test_kilometres_without_an_infraction_are_shown_as_a_lower_bound() -> None:
    metric = next(one for one in METRICS if one.name == KM_PER_INFRACTION)
    assert driver_cell(metric, report(km_per_infraction=12.3)) == "> 12.3"
    assert driver_cell(metric, report(km_per_infraction=12.3, red_light=0.1)) == "12.3"
    assert driver_cell(metric, report(km_per_infraction=None)) == "-"


def test_two_viewers_of_one_environment_share_an_address(
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("starlette")
    env: Any = cavmarl.parallel_env("ring", agents=1)
    env.reset(seed=0)
    with cavmarl.show(env, port=0) as first:
        port = int(first.address.rsplit(":", 1)[1].strip("/").split("/")[0])
        with cavmarl.show(env, port=port) as second:
            assert second.address == first.address
            env.step(env.suggest_actions())
    env.close()
    assert capsys.readouterr().out.count("viewer: http") == 2
