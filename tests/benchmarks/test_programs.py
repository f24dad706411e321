"""Benchmarks as programs: the list, the options, the table, the JSON, and what is refused."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import pytest

from benchmarks import balance, inference, moving, profile, scope, selection, sumo
from benchmarks.__main__ import KEPT, main, programs
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, paired_interval
from cavmarl.cli.bench import app
from cavmarl.core.errors import ConfigError
from tests.support.sumo_worlds import tiny_file


def test_all_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    shown = capsys.readouterr().out
    assert {command.name for command in app.registered_commands} == set(KEPT)
    assert {"sharding", "balance", "moving", "repartition", "rays", "v2x", "sumo"} <= set(
        programs()
    )
    assert all(name in shown for name in KEPT | programs())
    with pytest.raises(SystemExit, match="no benchmark 'nothing'"):
        main(["nothing"])


def test_a_program_shows_and_writes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "profile.json"
    words = ["ring", "--agents", "2", "--steps", "3", "--repeats", "1", "--json", str(path)]
    with pytest.raises(SystemExit) as ended:
        run(profile.measure, words)
    assert not ended.value.code
    assert "ns per vehicle" in capsys.readouterr().out
    found = json.loads(path.read_text())
    assert next(row["ns"] for row in found["rows"] if row["name"] == "sense") > 0.0
    assert found["hardware"]["usable_cores"] >= 1


def test_driver_networks_are_measured_beside_torch() -> None:
    pytest.importorskip("torch")
    found = inference.measure(rows=20, inputs=9, hidden=16, repeats=3, most_ratio=1e-6)
    assert not found.holds
    for row in found.rows:
        assert row["ratio"] > 0.0
        assert row["difference"] < 2e-6
    assert inference.measure(rows=20, inputs=9, hidden=16, repeats=1).holds
    with pytest.raises(ConfigError, match="rows = 0"):
        inference.measure(rows=0)


def test_a_bound_that_does_not_hold_is_exit_code_1() -> None:
    def measure(say: Any) -> BenchmarkReport:
        return BenchmarkReport("a", {"name": "name"}, [{"name": "b"}], holds=False)

    with pytest.raises(SystemExit) as ended:
        run(measure, [])
    assert ended.value.code == 1


def test_an_error_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run(balance.measure, ["grid4x4", "--workers", "0"])
    assert ended.value.code == 2
    assert "workers = 0: must be at least 1" in capsys.readouterr().err


def test_what_is_in_scope_holds_and_stands_on_its_page() -> None:
    found = scope.measure(steps=25, seed=0)
    assert [row["what"] for row in found.rows if not row["holds"]] == []
    page = Path(__file__).parents[2] / "docs/explanation/papers.md"
    text = page.read_text(encoding="utf-8")
    for row in found.rows:
        assert f"| {row['what']} | {row['A']} | " in text
    with pytest.raises(ConfigError, match="steps = 3"):
        scope.measure(steps=3)


def test_worlds_that_move_are_measured() -> None:
    small = {"worlds": 2, "lead": 4, "every": 2, "steps": 2, "repeats": 1}
    found = moving.measure("grid4x4", **small, at_least=1e9)  # type: ignore[arg-type]
    assert [row["name"] for row in found.rows] == ["fixed", "moving"]
    assert found.facts["ratio"] > 0.0
    assert not found.holds
    with pytest.raises(ConfigError, match="at least 2 workers"):
        moving.measure(workers=1)


def test_weights_of_the_score_are_studied() -> None:
    found = selection.measure(choices=100)
    assert found.facts["choices"] == 100
    for row in found.rows:
        assert 0.0 < row["changed"] < 1.0
        assert row["regret"] > 0.0
    assert found.rows[2]["changed"] < found.rows[6]["changed"]
    assert set(found.facts["latency_us"]) == {"p50", "p95", "p99"}
    assert selection.measure(choices=100).rows == found.rows
    with pytest.raises(ConfigError, match="choices = 0"):
        selection.measure(choices=0)


@pytest.mark.slow
def test_a_coupled_world_is_measured_beside_libsumo(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    found = sumo.measure("grid4x4", [tiny_file(tmp_path)], after=5, repeats=1, agents=1)
    alone, coupled = found.rows
    assert 0.0 < alone["low_ms"] <= alone["high_ms"]
    assert coupled["median_ms"] > 0.0


def test_a_ratio_by_pairs_has_an_interval() -> None:
    turns = [1.0, 3.0, 2.0, 5.0]
    assert paired_interval([2.0 * x for x in turns], turns) == pytest.approx((2.0, 0.0))
    assert paired_interval([3.0], [2.0]) == (pytest.approx(1.5), math.inf)
    draws = random.Random(0)
    within = 0
    for _ in range(200):
        others = [math.exp(draws.gauss(0.0, 1.0)) for _ in range(40)]  # what falls on both sides
        ones = [1.3 * x * math.exp(draws.gauss(0.0, 0.2)) for x in others]
        ratio, interval = paired_interval(ones, others)
        within += abs(ratio - 1.3) < interval
    assert within > 180
