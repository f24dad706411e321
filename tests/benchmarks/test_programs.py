"""Benchmark programs: their list, options, tables, JSON files and refused arguments."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import (
    balance,
    client_actors,
    inference,
    libraries,
    moving,
    node_latencies,
    node_limit,
    profile,
    rays,
    repartition,
    scope,
    selection,
    splits,
    sumo,
    v2x,
    vectorization,
    viewer,
)
from benchmarks.__main__ import KEPT, main, programs
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, paired_interval
from cavmarl.cli.bench import app
from cavmarl.core.errors import ConfigError
from tests.support.sumo_worlds import tiny_file

pytestmark = pytest.mark.integration


def test_all_programs_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    shown = capsys.readouterr().out
    assert {command.name for command in app.registered_commands} == set(KEPT)
    assert {"sharding", "balance", "moving", "repartition", "rays", "v2x", "sumo"} <= set(
        programs()
    )
    assert all(name in shown for name in KEPT | programs())
    with pytest.raises(SystemExit, match="no benchmark 'nothing'"):
        main(["nothing"])


def test_a_program_prints_a_table_and_writes_json(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "profile.json"
    words = ["ring", "--agents", "2", "--steps", "3", "--repeats", "1", "--json", str(path)]
    with pytest.raises(SystemExit) as ended:
        run(profile.measure, words)
    assert not ended.value.code
    assert "ns per vehicle" in capsys.readouterr().out
    found = json.loads(path.read_text())
    assert next(row["ns"] for row in found["rows"] if row["name"] == "sense") > 0.0
    assert found["hardware"]["usable_cores"] >= 1


def test_driver_networks_are_compared_with_torch() -> None:
    pytest.importorskip("torch")
    found = inference.measure(rows=20, inputs=9, hidden=16, repeats=3, most_ratio=1e-6)
    assert not found.holds
    for row in found.rows:
        assert row["ratio"] > 0.0
        assert row["difference"] < 2e-6
    assert inference.measure(rows=20, inputs=9, hidden=16, repeats=1).holds


def test_actors_of_clients_enter_in_one_step_and_do_not_change_other_vehicles(
    tmp_path: Path,
) -> None:
    path = tmp_path / "actors.json"
    words = [
        "ring", "--agents", "1", "--background", "4", "--visits", "2", "--actors", "2",
        "--rate-hz", "60", "--steps", "4", "--json", str(path),
    ]  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        run(client_actors.measure, words)
    assert not ended.value.code
    found = json.loads(path.read_text())
    row = next(row for row in found["rows"] if row["name"] == "with clients")
    assert (row["most_steps"], row["poses"], row["late"], row["lost"]) == (1, 2 * 2 * 4 * 3, 0, 0)
    assert found["others_equal"]


def test_a_violated_bound_gives_exit_code_1() -> None:
    def measure(say: Any) -> BenchmarkReport:
        return BenchmarkReport("a", {"name": "name"}, [{"name": "b"}], holds=False)

    with pytest.raises(SystemExit) as ended:
        run(measure, [])
    assert ended.value.code == 1


def test_an_error_prints_one_line_and_gives_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run(balance.measure, ["grid4x4", "--workers", "0"])
    assert ended.value.code == 2
    assert "workers = 0: must be at least 1" in capsys.readouterr().err


def test_every_claim_of_the_benchmark_scope_holds_and_is_on_the_page() -> None:
    found = scope.measure(steps=25, seed=0)
    assert [row["what"] for row in found.rows if not row["holds"]] == []
    page = Path(__file__).parents[2] / "docs/explanation/papers.md"
    text = page.read_text(encoding="utf-8")
    for row in found.rows:
        assert f"| {row['what']} | {row['A']} | " in text


def test_worlds_that_move_between_workers_are_measured() -> None:
    small = {"worlds": 2, "lead": 4, "every": 2, "steps": 2, "repeats": 1}
    found = moving.measure("grid4x4", **small, at_least=1e9)  # type: ignore[arg-type]
    assert [row["name"] for row in found.rows] == ["fixed", "moving"]
    assert found.facts["ratio"] > 0.0
    assert not found.holds


def test_the_effect_of_score_weights_is_measured() -> None:
    found = selection.measure(choices=100)
    assert found.facts["choices"] == 100
    for row in found.rows:
        assert 0.0 < row["changed"] < 1.0
        assert row["regret"] > 0.0
    assert found.rows[2]["changed"] < found.rows[6]["changed"]
    assert set(found.facts["latency_us"]) == {"p50", "p95", "p99"}
    assert selection.measure(choices=100).rows == found.rows


@pytest.mark.slow
def test_a_coupled_world_is_compared_with_libsumo(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    found = sumo.measure("grid4x4", [tiny_file(tmp_path)], after=5, repeats=1, agents=1)
    alone, coupled = found.rows
    assert 0.0 < alone["low_ms"] <= alone["high_ms"]
    assert coupled["median_ms"] > 0.0


def test_a_ratio_of_pairs_has_a_confidence_interval() -> None:
    turns = [1.0, 3.0, 2.0, 5.0]
    assert paired_interval([2.0 * x for x in turns], turns) == pytest.approx((2.0, 0.0))
    assert paired_interval([3.0], [2.0]) == (pytest.approx(1.5), math.inf)
    draws = random.Random(0)
    within = 0
    for _ in range(200):
        # Both values of a pair have the same random factor.
        others = [math.exp(draws.gauss(0.0, 1.0)) for _ in range(40)]
        ones = [1.3 * x * math.exp(draws.gauss(0.0, 0.2)) for x in others]
        ratio, interval = paired_interval(ones, others)
        within += abs(ratio - 1.3) < interval
    assert within > 180


def test_channels_of_v2x_are_measured_with_the_same_vehicles() -> None:
    found = v2x.measure("grid4x4", vehicles=40, ticks=10, warmup=10, at_most=1e-9)
    rows = {row["name"]: row for row in found.rows[1:]}
    assert list(rows) == list(v2x.CHANNELS)
    assert all(len(row["tick_ms"]) == 10 and row["median_ms"] > 0.0 for row in rows.values())
    assert rows["ideal"]["reception_ratio"] == rows["range 300 m"]["reception_ratio"] == 1.0
    assert rows["path loss"]["reachable"] == rows["range 300 m"]["reachable"]
    assert rows["ideal"]["reachable"] > rows["path loss"]["reachable"] > 0.0
    assert 0.0 < rows["path loss, busy air"]["reception_ratio"] < 1.0
    assert not found.holds


def test_frames_of_the_viewer_have_at_most_100_kb_and_reach_clients() -> None:
    found = viewer.measure("ring", vehicles=10_000, clients=2, seconds=1.0, rate_hz=5.0)
    assert found.row("publishing")["kb"] <= 100.0
    assert found.row("2 clients, 5 Hz")["fps"] > 2.0


def test_the_times_of_phases_sum_to_the_step() -> None:
    found = profile.measure("ring", worlds=2, agents=3, background=2, steps=5, repeats=2)
    phases = {row["name"]: row["ns"] for row in found.rows}
    assert {"advance", "resolve", "commit", "sense", "view"} <= set(phases)
    assert "suggest" not in phases
    assert sum(phases.values()) == pytest.approx(found.facts["timed_ns"])
    assert list(phases.values()) == sorted(phases.values(), reverse=True)
    assert (found.facts["vehicles"], found.facts["agents"]) == (10.0, 6.0)
    assert found.facts["plain_ns"] > 0.0


def test_undivided_and_divided_worlds_are_compared() -> None:
    found = splits.measure("ring", "9,12", agents=3, steps=2, repeats=2)
    assert [row["vehicles"] for row in found.rows] == [9, 12]
    assert all(len(row["split_ms"]) == 2 for row in found.rows)
    assert "splitting one world" in found.notes[0]
    few, some, many = (100, 1.1), (1000, 0.9), (10_000, 1.6)
    assert splits.split_line([many, few, some]) == 10_000
    assert splits.split_line([few, some]) is None
    assert splits.split_line([few, many]) == 100


def test_repartitioning_balances_a_crowd_of_fifty() -> None:
    settings = ["population.agents=50"]
    found = repartition.measure("rush", zones=4, every=10, steps=60, seeds=3, settings=settings)
    static, repartitioned = found.row("static"), found.row("repartitioned")
    assert found.facts["vehicles"] <= 50
    assert min(static["imbalance"]) > 2.0
    assert max(repartitioned["imbalance"]) < 0.75 * min(static["imbalance"])
    assert max(found.facts["ratios"]) < 0.75
    assert static["repartitions"] == 0 < repartitioned["repartitions"]
    assert repartitioned["repartition_ms"] > 0.0


@pytest.mark.slow
def test_every_sensor_of_the_rig_is_measured() -> None:
    said: list[str] = []
    found = rays.measure(2, said.append)
    facts = found.facts
    assert facts["cars_per_km2"] == pytest.approx(400.0, abs=8.0)
    assert len(found.rows) == 11
    for row in found.rows:
        assert 0.0 < row["low_us"] <= row["median_us"] <= row["high_us"]
    assert 0.0 < facts["lidar_ns"] < 250.0
    assert 0.0 < facts["cameras_ms"] < 2.5
    assert facts["cameras_ms"] < facts["tick_ms"] < 20.0
    assert said[-1] == "measuring, 2 of 2"


@pytest.mark.parametrize(
    ("measure", "arguments", "told"),
    [
        (profile.measure, {"env": "ring", "steps": 0}, "steps"),
        (profile.measure, {"env": "ring", "repeats": 0}, "repeats"),
        *[(repartition.measure, {"env": "rush", name: least}, "must be at least")
          for name, least in (("zones", 1), ("every", 0), ("steps", 0), ("seeds", 0))],
        *[(rays.measure, {"repeats": repeats}, f"repeats = {repeats}: must be from 1 to 100")
          for repeats in (0, 101)],
        (splits.measure, {"env": "ring", "vehicles": "many"},
         "--vehicles many: must be"),
        (splits.measure, {"env": "ring", "vehicles": "2", "agents": 3},
         "2 vehicles: must be at least the 3 agents"),
        (vectorization.measure, {"agents": 5, "workers": 2}, "5 agents over 2 workers"),
        (node_latencies.measure, {"env": "ring", "nodes": 1}, "--nodes 1"),
        (node_limit.measure, {"vehicles": 1}, "--vehicles 1: must be at least 800"),
        *[(libraries.measure, {"env": "merge", name: wrong}, f"{name} = {wrong}: must be from 1 to")
          for name, wrong in (("agents", 0), ("agents", 20_000), ("steps", 0))],
        (inference.measure, {"rows": 0}, "rows = 0"),
        (scope.measure, {"steps": 3}, "steps = 3"),
        (moving.measure, {"workers": 1}, "at least 2 workers"),
        (selection.measure, {"choices": 0}, "choices = 0"),
    ],
)  # fmt: skip
def test_invalid_settings_are_refused(
    measure: Callable[..., BenchmarkReport], arguments: dict[str, Any], told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        measure(**arguments)
