"""`cavmarl verify --faults`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.handoff.fault_injection.committed_store import CommittedStore
from cavmarl.verify.fault_campaign import run_campaign
from cavmarl.verify.fault_matrix import ELSEWHERE
from tests.cli.test_main import refusal, run

BUSY = (
    "verify", "grid4x4", "--set", "population.mode=respawn", "--background", "110",
    "--set", "clock.sim_dt_s=0.2", "--set", "clock.ctrl_dt_s=0.4",
)  # fmt: skip
PLAN = {
    "messages": {"Ack": {"drop": 1.0}, "Done": {"duplicate": 1.0}},
    "crashes": [
        {"tick": 4, "point": "advance", "zone": 0},
        {"tick": 6, "point": "resolve", "zone": 1, "times": 2},
        {"tick": 8, "point": "COMMIT torn"},
    ],
}


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


def written(folder: Path, plan: object) -> str:
    path = folder / "plan.json"
    path.write_text(json.dumps(plan))
    return str(path)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a store give back one speed that is wrong."""
    load = CommittedStore.load

    def forgetful(store: CommittedStore) -> object:
        notes = load(store)
        store._shards[0].worlds.rows["speed"][0, 0] += 0.25
        return notes

    monkeypatch.setattr(CommittedStore, "load", forgetful)


def test_it_counts_what_a_plan_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, folder = tmp_path / "found.json", tmp_path / "journals"
    words = ("--faults", written(tmp_path, PLAN), "--json", str(out), "--journal", str(folder))
    assert run(*BUSY, "--zones", "1,2,4", "--steps", "8", *words, "--check") == 0
    whole, _, four = json.loads(out.read_text())["results"]
    assert whole["figures"]["zone_deaths"] == {}
    figures = four["figures"]
    assert figures["zone_deaths"] == {"advance": 1, "resolve": 2}
    assert figures["coordinator_deaths"] == {"COMMIT torn": 1}
    assert figures["tick_begun_again"]["max"] == 2.0
    assert figures["hand_overs"]["forced"] > 0
    assert figures["messages"]["Ack"] == {"drop": figures["messages"]["Ack"]["drop"]}
    said = " ".join(capsys.readouterr().out.split())
    assert "deaths 3 of zones' hosts, 1 of coordinators" in said
    assert f"{figures['hand_overs']['forced']} of them forced; 0 failed" in said
    assert said.count("equal") == 3
    for count in (2, 4):
        assert len(list(JournalReader(folder / f"zones-{count}.jsonl"))) > 30
    assert not (folder / "zones-1.jsonl").exists()
    assert "exists" in refusal(capsys, *BUSY, "--zones", "2", "--steps", "1", *words)


def test_it_fails_where_a_death_is_not_made_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    forget(monkeypatch)
    words = ("--zones", "2", "--steps", "8", "--faults", written(tmp_path, PLAN))
    assert run(*BUSY, *words) == 1
    assert "2 zones: different: step 2 (tick 4), vehicle" in capsys.readouterr().out


def test_a_plan_that_nobody_survives_is_a_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poison = {"crashes": [{"tick": 4, "point": "advance", "zone": 0, "times": 9}]}
    words = ("--zones", "2", "--steps", "8", "--faults", written(tmp_path, poison))
    assert run(*BUSY, *words) == 1
    assert "zone 0 could not reach tick 4: 4 hosts in a row died" in capsys.readouterr().out


def test_a_campaign_prints_every_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "campaign.json"
    words = ("--zones", "2", "--steps", "4", "--seeds", "1", "--json", str(out))
    assert run("verify", "--faults", "campaign", "--set", "clock.ctrl_dt_s=0.4", *words) == 0
    found = json.loads(out.read_text())
    assert found["holds"]
    assert found["survived"] == found["injected"] > 100
    said = " ".join(capsys.readouterr().out.split())
    for line in found["lines"]:
        assert f"{line['name']} (" in said
        assert not line["failures"]
    for what, _ in ELSEWHERE:
        assert f"not counted here: {what}" in said


def test_a_campaign_fails_and_gives_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    forget(monkeypatch)
    settings = {"clock.ctrl_dt_s": 0.4}
    campaign = run_campaign(None, (2,), steps=4, seeds=0, overrides=settings)
    assert not campaign.holds
    (failure, *_) = [f for line in campaign.lines for f in line.failures]
    assert json.loads(failure["plan"])["crashes"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("verify",), "verify: name an environment; without one goes --faults campaign only"),
        (("verify", "merge", "--faults", "none.json"), "faults none.json: No such file"),
        (("verify", "merge", "--faults", "{"), "faults: no JSON"),
        (("verify", "merge", "--faults", '{"crash": 1}'), "faults: no key crash; there are seed"),
        (
            ("verify", "merge", "--faults", '{"messages": {"Ack": {"drop": 2}}}'),
            "faults, messages, Ack: the rate of drop is 2: must be a number from 0 to 1",
        ),
        (
            ("verify", "merge", "--faults", '{"crashes": [{"tick": 1, "point": "noon"}]}'),
            "faults, crashes[0]: the coordinator cannot die at 'noon'; points are offers made",
        ),
        (
            ("verify", "merge", "--faults", '{"crash_rate": 0.01}', "--worlds", "2"),
            "hosts die in one world at a time, not in 2",
        ),
        (
            (
                "verify", "merge", "--zones", "2", "--faults",
                '{"crashes": [{"tick": 1, "point": "advance", "zone": 2}]}',
            ),
            "the host of zone 2 cannot die, there are 2 zones; name one from 0 to 1",
        ),
        (
            ("verify", "merge", "--faults", "{}", "--set", "zones.faults={}"),
            "zones.faults stands in overrides and is given as faults; use one",
        ),
        (("verify", "merge", "--journal", "/dev/null/x"), "/dev/null/x: cannot be written"),
        (("verify", "--faults", "campaign", "--zones", "1,4"), "needs numbers of 2 or more"),
        (("verify", "--faults", "campaign", "--seeds", "-1"), "seeds is -1: must be a whole"),
        (("verify", "--faults", "campaign", "--steps", "0"), "steps = 0: must be"),
        (("verify", "--faults", "campaign", "--worlds", "2"), "--worlds 2: hosts die in one world"),
        (("verify", "--faults", "campaign", "--layout", "grid"), "takes --set zones.layout"),
        (("verify", "--faults", "campaign", "--journal", "x"), "--journal: a campaign is many"),
        (("verify", "nowhere", "--faults", "campaign"), "nowhere"),
    ],
)  # fmt: skip
def test_at13_wrong_use_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
) -> None:
    assert message in refusal(capsys, *words)
