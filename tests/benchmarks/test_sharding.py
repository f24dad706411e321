"""The cost of dividing a world: parts of a tick, and refused comparisons.

No test checks a duration.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.program import run
from benchmarks.sharding import measure, measure_sharding
from benchmarks.sharding_turns import PHASES
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.built_in_runs import world_maker
from tests.support.demand_worlds import GRID


@pytest.fixture
def demand(tmp_path: Path) -> Path:
    path = tmp_path / "grid.rou.xml"
    path.write_text(GRID, encoding="utf-8")
    return path


@pytest.fixture
def make(demand: Path) -> Callable[[int], Simulation]:
    return world_maker("grid4x4", [demand], seconds=60, seed=1)


def test_the_times_of_phases_sum_to_the_tick(make: Callable[[int], Simulation]) -> None:
    found = measure_sharding(make, [4, 2], after_s=20, repeats=2)
    assert [row["zones"] for row in found.rows] == [1, 2, 4]
    assert found.facts["state_hash"] == _at_end(make, 40).state_hash()
    for row in found.rows:
        assert tuple(row["phases"]) == PHASES
        assert sum(row["phases"].values()) == pytest.approx(row["timed_ns"])
        assert row["plain_ns"] > 0.0
        assert row["vehicles"] == found.rows[0]["vehicles"]
        assert {"advance", "resolve", "commit"} <= row["calls"].keys()
        assert not {"suggest", "loads", "vehicles"} & row["calls"].keys()


def test_vehicles_and_ghosts_of_zones_are_counted(make: Callable[[int], Simulation]) -> None:
    one, four = measure_sharding(make, [4], after_s=20, repeats=2).rows
    alone = {"ghosts": 0.0, "imbalance": 1.0, "largest_share": 1.0, "ratio": 1.0}
    undivided = {"migrations": 0.0, "migration_us": None}
    assert one.items() >= (alone | undivided).items()
    assert one["side_m"] == pytest.approx(2.0 * four["side_m"])
    assert 0.0 < four["ghosts"] <= 3.0 * four["vehicles"]
    assert four["imbalance"] > 1.0
    assert 0.25 < four["largest_share"] <= 1.0
    ticks = 200
    moved = _at_end(make, 40, zones=4).migrations
    before = _at_end(make, 20, zones=4).migrations
    assert four["migrations"] == pytest.approx((moved - before) / ticks)
    assert four["migration_us"] is not None


def test_agents_drive_and_their_policy_is_not_counted_as_a_phase() -> None:
    make = world_maker("ring", agents=3, background=2, seconds=60)
    (found,) = measure_sharding(make, [1], after_s=1, repeats=1).rows
    assert found["vehicles"] == 5.0
    assert "suggest" not in found["calls"]
    assert found["phases"]["sense"] > 0.0


def test_the_cost_of_the_monitor_is_measured_on_request(
    make: Callable[[int], Simulation], demand: Path
) -> None:
    checked = world_maker(
        "grid4x4", [demand], seconds=60, seed=1, overrides={"zones.check_invariants": True}
    )
    one, two = measure_sharding(make, [2], after_s=10, repeats=1, make_checked=checked).rows
    assert one["checked_ratio"] is None
    assert two["checked_ratio"] is not None
    assert two["checked_ratio"] > 0.0


def test_a_comparison_of_worlds_with_different_states_is_refused(
    make: Callable[[int], Simulation], demand: Path
) -> None:
    other = world_maker("grid4x4", [demand], seconds=60, seed=2)
    with pytest.raises(EvaluationError, match="after 100 ticks: 2 zones have the state"):
        measure_sharding(lambda k: other(k) if k == 2 else make(k), [2], after_s=10, repeats=1)


@pytest.mark.parametrize(
    ("zones", "after_s", "repeats", "words"),
    [
        ([4], 0, 1, "after = 0: must be from 1 to 3600"),
        ([4], 1, 0, "repeats = 0: must be from 1 to 100"),
        ([0], 1, 1, "zones = 0: must be from 1 to 256"),
        ([], 1, 1, "give at least one"),
    ],
)
def test_numbers_out_of_range_are_refused(
    make: Callable[[int], Simulation], zones: list[int], after_s: int, repeats: int, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        measure_sharding(make, zones, after_s=after_s, repeats=repeats)


def test_a_map_without_vehicles_is_refused() -> None:
    make = world_maker("grid4x4", agents=0, background=0, seconds=20)
    with pytest.raises(ConfigError, match="no vehicle drives"):
        measure_sharding(make, [1], after_s=1, repeats=1)


def test_more_zones_than_the_map_can_hold_are_refused() -> None:
    make = world_maker("ring", agents=0, background=2, seconds=20, layout="strips")
    with pytest.raises(ConfigError, match="zones"):
        measure_sharding(make, [200], after_s=1, repeats=1)


def test_the_command_prints_the_phases_and_writes_json(
    capsys: pytest.CaptureFixture[str], demand: Path, tmp_path: Path
) -> None:
    path = tmp_path / "cost.json"
    words = ("grid4x4", "-d", str(demand), "--zones", "1,4")
    assert _run(*words, "--after", "10", "--repeats", "1", "--check", "--json", str(path)) == 0
    shown = " ".join(capsys.readouterr().out.split())
    told = (*PHASES, "sum", "without stopwatches", "monitor", "equal")
    assert all(word in shown for word in told)
    assert [row["zones"] for row in json.loads(path.read_text())["rows"]] == [1, 4]


def test_the_command_refuses_to_compare_worlds_that_differ(
    capsys: pytest.CaptureFixture[str], demand: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Simulation, "state_hash", lambda self: hex(id(self)))
    words = ("grid4x4", "-d", str(demand), "--zones", "2")
    assert _run(*words, "--after", "1", "--repeats", "1") == 2
    assert "are not compared" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--zones", "1;4"), "--zones 1;4: must be comma-separated whole numbers"),
        (("--zones", "0"), "zones = 0"),
        (("--layout", "rings"), "does not exist; use grid, strips, bisection"),
        (("--layout", "none.json"), "none.json"),
        (("-d", "none.rou.xml"), "none.rou.xml"),
        (("-d", "none.rou.xml", "--agents", "2"), "omit --agents and --background"),
    ],
)
def test_the_command_refuses_invalid_options(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], said: str
) -> None:
    assert _run("ring", *words) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def _at_end(make: Callable[[int], Simulation], seconds: int, zones: int = 1) -> Simulation:
    from cavmarl.evaluate.traffic.native_side import idle_commands

    simulation = make(zones)
    for _ in range(seconds * 10):
        simulation.step(idle_commands(simulation))
    return simulation


def _run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        run(measure, words)
    return int(ended.value.code or 0)
