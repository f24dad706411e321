"""Runs of many worlds: rows, their summary, and continuation after an interruption."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from benchmarks import traffic_worlds, world_runs
from benchmarks.program import run
from benchmarks.world_rows import (
    Row,
    comparable,
    deviation,
    has_own_lock,
    in_spread,
    is_delay_near,
    is_near,
    summary,
    sumo_beside_itself,
    worst,
)
from benchmarks.world_runs import KEPT, ROWS_FILE, WorldSeries, read_rows, run_worlds, world_folder
from cavmarl.core.errors import ConfigError, MissingExtraError

pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
pytest.importorskip("matplotlib", reason="needs the extra 'report'")

FIGURES = {
    "departed": 100, "waiting": 0, "arrived": 80, "mean_speed_mps": 10.0, "mean_delay_s": 20.0,
    "queue": 3.0, "contacts": 0, "longest_lock_s": 5.0, "locked_junction": "a", "teleports": 0,
}  # fmt: skip
SPREAD = {
    "departed": [100, 100, 100],
    "arrived": [78, 80, 82],
    "mean_speed_mps": [9.0, 10.0, 11.0],
    "mean_delay_s": [19.0, 20.0, 21.0],
    "queue": [3.0, 3.0, 3.0],
    "longest_lock_s": [5.0, 9.0, 7.0],
}


def a_row(seed: int = 0, **ours: Any) -> Row:
    own = {"seed": seed, "features": ["grid"], "seconds": 300, "dt_s": 0.1}
    return own | {"ours": FIGURES | ours, "sumo": FIGURES, "sumo_spread": SPREAD}


def test_a_deviation_is_relative_to_the_mean_over_seeds_of_sumo() -> None:
    assert deviation(a_row(mean_speed_mps=11.5), "mean_speed_mps") == pytest.approx(0.15)
    assert deviation(a_row(arrived=60), "arrived") == pytest.approx(-0.25)
    assert deviation(a_row(mean_delay_s=None), "mean_delay_s") is None


def test_worlds_with_features_that_cavmarl_treats_differently_are_not_comparable() -> None:
    rows = [a_row() | {"features": ["grid", name]} for name in ("priority_stop", "stub_lanes")]
    assert comparable(rows) == rows[:1]


def test_a_metric_is_near_if_it_is_within_a_share_of_the_mean_or_the_range_of_sumos_seeds() -> None:
    assert in_spread(a_row(mean_speed_mps=9.0), "mean_speed_mps")
    assert not in_spread(a_row(mean_speed_mps=8.9), "mean_speed_mps")
    assert is_near(a_row(mean_speed_mps=8.9), "mean_speed_mps", 0.15)
    assert not is_near(a_row(mean_speed_mps=8.4), "mean_speed_mps", 0.15)
    assert is_near(a_row(mean_speed_mps=9.0), "mean_speed_mps", 0.01)


@pytest.mark.parametrize(
    ("delay_s", "near"), [(23.0, True), (25.0, True), (25.1, False), (14.9, False), (None, False)]
)
def test_a_delay_is_near_if_it_differs_by_a_share_or_some_seconds(
    delay_s: float | None, near: bool
) -> None:
    assert is_delay_near(a_row(mean_delay_s=delay_s)) == near


def test_a_deadlock_counts_if_no_seed_of_sumo_has_one() -> None:
    assert has_own_lock(a_row(longest_lock_s=121.0))
    assert not has_own_lock(a_row(longest_lock_s=120.0))
    both = a_row(longest_lock_s=200.0) | {"sumo_spread": SPREAD | {"longest_lock_s": [9.0, 121.0]}}
    assert not has_own_lock(both)


def test_each_seed_of_sumo_is_compared_with_the_other_seeds_like_a_run_of_cavmarl() -> None:
    row = a_row() | {"sumo_spread": SPREAD | {"arrived": [100, 104, 120]}}
    peers = sumo_beside_itself(row)
    assert [peer["ours"]["arrived"] for peer in peers] == [100, 104, 120]
    assert [peer["sumo_spread"]["arrived"] for peer in peers] == [
        [104, 120],
        [100, 120],
        [100, 104],
    ]
    assert [is_near(peer, "arrived", 0.05) for peer in peers] == [False, True, False]
    assert summary([row])["arrived"]["sumo_near"] == pytest.approx(1 / 3)


def test_the_summary_counts_deviations_contacts_and_failures() -> None:
    rows = [a_row(k, mean_speed_mps=10.0 + k) for k in range(5)]
    rows.append(a_row(5, contacts=3, arrived=70, longest_lock_s=150.0))
    failed = {"seed": 6, "features": ["cut"], "error": "MapError: no roads"}
    found = summary([*rows, failed])
    assert (found["worlds"], found["failed"]) == (7, 1)
    # The deviations of speed are 0, 10, 20, 30, 40 and 0 per cent.
    assert found["mean_speed"]["median"] == pytest.approx(0.15)
    assert found["mean_speed"]["size_90"] == pytest.approx(0.35)
    assert found["mean_speed"]["share_near"] == pytest.approx(3 / 6)
    assert found["arrived"]["share_near"] == pytest.approx(5 / 6)
    assert found["contacts"] == {"ours": 3, "sumo": 0, "worlds": 1}
    assert found["own_locks"] == 1
    assert summary([failed]) == {"worlds": 1, "failed": 1}


def test_the_worst_worlds_are_sorted_by_failure_contacts_and_deviation_of_speed() -> None:
    rows = [a_row(0), a_row(1, mean_speed_mps=6.0), a_row(2, contacts=1)]
    rows.append({"seed": 3, "features": [], "error": "x"})
    assert [row["seed"] for row in worst(rows, 3)] == [3, 2, 1]


def test_the_table_of_the_worst_worlds_breaks_no_word_on_a_narrow_terminal(tmp_path: Path) -> None:
    features = ["grid", "right_before_left", "turn_lanes", "random_priority", "near_capacity"]
    row = a_row(7, mean_speed_mps=9.0, contacts=3) | {"features": features}
    console = Console(width=80, record=True)
    console.print(
        traffic_worlds.worst_table(
            [row, {"seed": 8, "features": [], "error": "no net\nmore"}], tmp_path
        )
    )
    text = console.export_text()
    lines = [line.split() for line in text.splitlines() if line.split()[:1] == ["world_000007"]]
    assert lines[0][1:4] == ["grid,", "right_before_left,", "turn_lanes,"]
    assert lines[0][-1] == "3"
    assert "no net" in text
    assert str(tmp_path) in "".join(text.split())


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Replace each run by a folder and a row; return the list of requested seeds."""
    ran: list[int] = []

    def run_world(job: WorldSeries, seed: int) -> Row:
        ran.append(seed)
        world_folder(job.out, seed).mkdir()
        return a_row(seed, mean_speed_mps=10.0 + 0.1 * seed)

    monkeypatch.setattr(world_runs, "run_world", run_world)
    return ran


def test_a_run_resumes_and_keeps_the_files_of_the_worst_worlds(
    tmp_path: Path, stubbed: list[int]
) -> None:
    told: list[tuple[int, int]] = []
    run_worlds(WorldSeries(tmp_path, 5, 0))
    rows = run_worlds(WorldSeries(tmp_path, KEPT + 5, 0), lambda *done: told.append(done))
    assert stubbed == list(range(KEPT + 5))
    assert [row["seed"] for row in rows] == stubbed
    assert told[-1] == (KEPT + 5, KEPT + 5)
    assert len(list(read_rows(tmp_path / ROWS_FILE))) == KEPT + 5
    kept = {path.name for path in tmp_path.iterdir() if path.is_dir()}
    assert kept == {f"world_{seed:06d}" for seed in range(5, KEPT + 5)}


def test_rows_with_other_settings_are_refused(tmp_path: Path, stubbed: list[int]) -> None:
    run_worlds(WorldSeries(tmp_path, 1, 0))
    with pytest.raises(ConfigError, match="rows with other settings"):
        run_worlds(WorldSeries(tmp_path, 1, 0, seconds=200))
    assert stubbed == [0]


def test_the_error_for_a_broken_row_names_its_line(tmp_path: Path) -> None:
    (tmp_path / ROWS_FILE).write_text('{"seed": 1}\n{"seed"\n')
    with pytest.raises(ConfigError, match="line 2: not a valid row"):
        list(read_rows(tmp_path / ROWS_FILE))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--worlds", "0"), "worlds = 0"),
        (("--first-seed", "-1"), "first_seed = -1"),
        (("--without", "hills"), "--without hills"),
        (("--dt", "0.5"), "sim_dt_s = 0.5"),
        (("--out", "/proc/nowhere"), "/proc/nowhere: cannot be written"),
    ],
)
def test_errors_of_bad_input_have_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], says: str
) -> None:
    out = () if "--out" in words else ("--out", str(tmp_path))
    with pytest.raises(SystemExit) as ended:
        run(traffic_worlds.measure, [*words, *out])
    assert ended.value.code == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_the_error_without_sumo_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(module: str) -> None:
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("cavmarl.core.errors.importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[sumo\]'"):
        WorldSeries(tmp_path, 1, 0)


@pytest.mark.slow
def test_the_benchmark_runs_and_prints_two_worlds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = tmp_path / "all.json"
    words = ("--worlds", "2", "--first-seed", "11", "--seconds", "30", "--dt", "0.2")
    with pytest.raises(SystemExit) as ended:
        run(traffic_worlds.measure, [*words, "--out", str(tmp_path), "--json", str(document)])
    assert not ended.value.code
    shown = capsys.readouterr().out
    assert "2 worlds, 0 failed" in shown
    rows = json.loads(document.read_text())["worlds"]
    assert [row["seed"] for row in rows] == [11, 12]
    assert all(len(row["sumo_spread"]["arrived"]) == 3 for row in rows)
    for row in rows:
        folder = world_folder(tmp_path, row["seed"])
        assert {"flow.png", "end.png"} <= {path.name for path in folder.iterdir()}
        readme = (folder / "README.txt").read_text()
        assert f"--first-seed={row['seed']}" in readme
        assert row["features"][0] in readme
