"""Plans as text and as files, and plans recomputed from files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.balance.balance_plan import Plan, make_plan, replan
from cavmarl.balance.load_score import Candidate, LoadRule, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.plan_file import plan_from_dict, read_plan
from cavmarl.balance.plan_text import describe_plan
from cavmarl.balance.problem import BalanceRule, Problem
from cavmarl.core.errors import ConfigError
from tests.balance.shards import COSTS, busy, grid, row


@pytest.fixture
def plan() -> Plan:
    away = Candidate(3, Utilisation(0.0, 0.0), available=False)
    snapshot = LoadSnapshot((*busy(0.1, 0.2, 0.9).workers, away), "none", "generated")
    rule = BalanceRule(LoadRule((0.5, 0.25, 0.25)), tolerance=0.05, max_moves=3)
    present = (0, 0, 0, 0, 0, 1, 1, 2)
    costs = [0.004, 0.001, 0.002, 0.001, 0.003, 0.001, 0.001, 0.001]
    return make_plan(Problem(row(costs, worlds=2), grid(2, 2), snapshot, rule, present))


def test_a_plan_read_from_json_equals_the_written_plan(plan: Plan) -> None:
    again = plan_from_dict(json.loads(json.dumps(plan.to_dict())))
    assert again == plan
    assert again.to_dict() == plan.to_dict()


@settings(deadline=None)
@given(
    st.lists(COSTS, min_size=4, max_size=9), st.lists(st.floats(0.0, 0.85), min_size=1, max_size=4)
)
def test_a_plan_is_recomputed_from_its_snapshot(costs: list[float], cpus: list[float]) -> None:
    plan = make_plan(Problem(row(costs), grid(1, len(costs)), busy(*cpus)))
    kept = plan_from_dict(json.loads(json.dumps(plan.to_dict())))
    assert replan(kept, kept.problem.snapshot) == plan


def test_another_snapshot_gives_another_plan(plan: Plan) -> None:
    first = make_plan(replace(plan.problem, present=None))
    assert replan(first, idle_snapshot(1)).homes == (0,) * 8


def test_the_json_of_a_plan_has_derived_values(plan: Plan) -> None:
    document = plan.to_dict()
    assert [worker["worker"] for worker in document["workers"]] == [0, 1, 2]
    assert sum(worker["load_s"] for worker in document["workers"]) == pytest.approx(0.014)
    assert {reason["worker"] for reason in document["rejections"]} == {2, 3}
    for move in plan.moves:
        assert plan.homes[4 * move.world + move.zone] == move.target != move.source
    assert document["imbalance"] == plan.imbalance > 0.0


def test_the_text_of_a_plan_has_its_scores_exclusions_and_moves(plan: Plan) -> None:
    text = describe_plan(plan)
    assert text.startswith("8 shards on 4 workers, moved from the slowest\n")
    assert "score = 0.5 CPU + 0.25 RAM + 0.25 GPU; workers generated, GPU: none" in text
    assert "costliest shard 4.000 ms a tick, 2.286 times the mean" in text
    assert "excluded: worker 2: cpu 0.9 > 0.85" in text
    assert "excluded: worker 3 is unavailable" in text
    (first,) = (line for line in text.splitlines() if line.startswith("     0"))
    assert "0.050" in first
    assert f"moves: {len(plan.moves)}" in text
    assert all(f"worker {move.source} → {move.target}" in text for move in plan.moves)


def test_consecutive_zones_are_written_as_ranges() -> None:
    plan = make_plan(Problem(row([1.0] * 8, worlds=2), grid(2, 2), idle_snapshot(1)))
    assert describe_plan(plan).splitlines()[-1].endswith("  0: 0-3; 1: 0-3")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"schema": "other"}, "no schema 'cavmarl.plan'"),
        ({"version": 2}, "version 2"),
        ({"shards": None}, "shards = None: must be a list"),
        ({"shards": [1]}, r"shards\.0 = 1: must be a mapping"),
        ({"rule": {}}, "rule = {} lacks a key .* must have load, tolerance, .* keeps_one"),
        ({"method": 1}, "method = 1: must be a valid string"),
        ({"snapshot": {"workers": []}}, r"snapshot\.gpu_source: missing"),
        ({"snapshot": {"workers": [], "gpu_source": "none", "origin": ""}}, "no workers"),
        ({"present": [0]}, "1 present workers"),
        ({"present": [0, True]}, r"present\.1 = True: must be a valid integer"),
        ({"neighbors": [[1], [], [], []]}, "zone 0 names 1 as its neighbour"),
        ({"neighbors": [[0], [], [], []]}, "zone 0 names 0"),
        ({"neighbors": [["x"], [], [], []]}, r"neighbors\.0\.0 = 'x': must be a valid integer"),
    ],
)
def test_a_file_without_a_plan_is_refused(plan: Plan, change: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        plan_from_dict(plan.to_dict() | change)


def test_a_whole_number_in_a_stored_plan_may_stand_for_a_float(plan: Plan) -> None:
    document = json.loads(json.dumps(plan.to_dict()))
    document["rule"]["move_s"] = 0
    assert plan_from_dict(document).problem.rule == replace(plan.problem.rule, move_s=0.0)


def test_an_invalid_share_in_a_stored_plan_is_refused(plan: Plan) -> None:
    document = plan.to_dict()
    document["snapshot"]["workers"][0]["use"]["cpu"] = 12.0
    with pytest.raises(ConfigError, match="utilisation cpu = 12"):
        plan_from_dict(document)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("shards", 0, "worker"), 9, r"homes .*: there must be one for each of 8 .* \[0, 1, 2\]"),
        (("shards", 0, "worker"), 3, "among the workers that answer"),
        (("shards", 0, "cost_s"), 1e300, "cost_s = 1e"),
        (("shards", 0, "cost_s"), 10**400, "cost_s = inf: must be seconds"),
        (("shards", 0, "zone"), 0.0, r"shards\.0\.zone = 0.0: must be a valid integer"),
        (("rule", "load", "weights"), [1.0], r"rule\.load\.weights\.1: missing"),
        (("rule", "load", "weights"), [1.0, "", 0.0], r"weights\.1 = '': must be a valid number"),
        (("rule", "max_moves"), 2.5, r"rule\.max_moves = 2.5"),
        (
            ("snapshot", "workers", 0, "available"),
            1,
            r"workers\.0\.available = 1: must be a valid boolean",
        ),
    ],
)
def test_an_invalid_value_in_a_stored_plan_is_named(
    plan: Plan, path: tuple[str | int, ...], value: object, said: str
) -> None:
    document = plan.to_dict()
    part: Any = document
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(ConfigError, match=said):
        plan_from_dict(json.loads(json.dumps(document)))


def test_a_plan_is_read_from_a_file(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan.to_dict()), encoding="utf-8")
    assert read_plan(path) == plan
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"plan\.json: not a plan"):
        read_plan(path)
    for content in (b"\xff", b"[" * 100_000, b'{"a": ' + b"9" * 5000 + b"}"):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="cannot be read"):
            read_plan(path)
