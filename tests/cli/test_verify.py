"""`cavmarl verify`: its checks, refused arguments, and campaigns of faults."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from tests.cli.test_main import refusal, run

CHECKS = "cavmarl verify zones|nodes|workers|determinism"
FEW = (
    "verify", "nodes", "merge", "--agents", "3", "--background", "12", "--zones", "3", "--steps",
    "8", "--nodes", "3", "--seeds", "1",
)  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        ("verify", "merge"),
        ("verify", "merge", "--kill", "3"),
        ("verify", "grid4x4", "--nodes", "2"),
        ("verify", "--faults", "campaign"),
        ("verify", "--replay", "tick.json"),
    ],
)
def test_the_error_for_a_missing_check_names_all_checks(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    said = refusal(capsys, *words)
    assert f"verify {words[1]}: the name of a check must come first: {CHECKS}" in said


def test_a_former_command_name_is_refused_with_its_replacement(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = refusal(capsys, "verify-determinism", "merge")
    assert "use cavmarl verify determinism" in said


@pytest.mark.parametrize("check", ["zones", "nodes", "workers", "determinism"])
def test_each_check_has_only_the_options_that_apply_to_it(
    check: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert run("verify", check, "--help") == 0
    options = {*re.findall(r" (--[a-z-]+) ", capsys.readouterr().out)}
    assert options >= {"--agents", "--seed", "--steps", "--policy", "--json"}
    own = {
        "zones": {"--zones", "--worlds", "--layout", "--journal", "--check"},
        "nodes": {"--zones", "--worlds", "--nodes", "--kill", "--faults", "--mix", "--check"},
        "workers": {"--zones", "--worlds", "--workers", "--kill", "--backend"},
        "determinism": set[str](),
    }
    assert options >= own[check]
    assert not options & (set[str]().union(*own.values()) - own[check])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "name an environment; only --faults has a default"),
        (("merge", "--nodes", "2,x"), "--nodes 2,x: must be comma-separated whole numbers"),
        (("merge", "--nodes", "0"), "from 1 on"),
        (("merge", "--mix", "kill"), "--mix kill: goes with --faults"),
        (("merge", "--seeds", "2"), "--seeds 2: goes with --faults"),
        (("merge", "--faults", "plan.json"), "--faults plan.json: must be simulated, processes"),
        (("--faults", "simulated", "--kill", "2"), "--kill 2: does not go with --faults"),
        (("--faults", "campaign", "--worlds", "2"), "--worlds 2: does not go with --faults"),
        (("--faults", "simulated", "--process-runs", "2"), "goes with processes or campaign"),
        (("--faults", "processes", "--mix", "kill"), "goes with simulated or campaign"),
        (("--faults", "simulated", "--mix", "flood"), "must be among none, delay"),
        (("--faults", "simulated", "--seeds", "0"), "seeds = 0"),
        (("--faults", "simulated", "--first-seed", "-1"), "first_seed = -1"),
        (("nowhere", "--faults", "simulated"), "nowhere"),
    ],
)
def test_invalid_arguments_are_refused(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refusal(capsys, "verify", "nodes", *words)


def test_a_campaign_prints_and_writes_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "found.json"
    words = ("--faults", "simulated", "--mix", "kill,damage,many_tolerated", "--json", str(path))
    assert run(*FEW, *words) == 0
    found = json.loads(path.read_text())
    assert found["holds"]
    figures = found["simulated"]
    assert (figures["runs"], figures["equal"], figures["wrong"]) == (3, 3, 0)
    assert (figures["deaths"], figures["recoveries"]) == (1, 2)
    assert figures["faults"] == sum(figures["injected"].values()) > 50
    assert figures["injected"]["kill"] == figures["injected"]["damage"] == 1
    said = capsys.readouterr().out
    assert re.search(rf"injected faults +{figures['faults']}", said)


def test_the_printed_command_repeats_a_wrong_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cavmarl.parallel.nodes.node_watch.PONG_S", 0.01)
    words = ("--faults", "simulated", "--mix", "stale_heartbeat", "--first-seed", "4")
    assert run(*FEW, *words, "--set", "zones.check_invariants=true") == 1
    first = capsys.readouterr().out
    ((_, again),) = re.findall(r"(to repeat this run: cavmarl) (.+)", first)
    assert run(*shlex.split(again)) == 1
    wrong = [
        [line for line in said.splitlines() if line.startswith("3 nodes, ")]
        for said in (first, capsys.readouterr().out)
    ]
    assert wrong[0] == wrong[1]
    assert wrong[0][0].startswith("3 nodes, stale_heartbeat, seed 4: {'stale_heartbeat': 1}")
