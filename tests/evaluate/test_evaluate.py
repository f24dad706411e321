"""Evaluation: its metrics, its repeatability, and the arguments that it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, PolicyError, UnknownEnvironmentError
from cavmarl.core.processes import start_python
from cavmarl.evaluate import EvaluationReport, episodes, evaluate, load_report, subprocess_calls
from cavmarl.evaluate.episodes import worlds_at_once
from cavmarl.evaluate.evaluation import load_tables, run_seeds
from cavmarl.evaluate.metrics import METRICS
from cavmarl.evaluate.statistics import student_quantile

SMALL: dict[str, Any] = {"episodes": 3, "agents": 3, "background": 3, "max_cycles": 60}


def results(report: EvaluationReport) -> list[Any]:
    """Return the parts of a report that do not depend on time and machine."""
    return [(policy.trips, policy.metrics) for policy in report.policies.values()]


@pytest.fixture(scope="module")
def by_chance() -> EvaluationReport:
    return evaluate("merge", "random_actions", seed=4, **SMALL)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results folder of two policies and three runs, each run in a new interpreter."""
    folder = tmp_path_factory.mktemp("compared")
    policies = {"driver": "idm", "chance": "random_actions"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            subprocess_calls, "start_python", start_python
        )  # other tests fork from a warm process instead
        evaluate("merge", policies, seed=4, repeats=3, out=folder, **SMALL)
    return folder


def test_the_shares_of_trip_ends_sum_to_one(by_chance: EvaluationReport) -> None:
    found = by_chance["random_actions"]
    ends = [found[name].mean for name in ("arrived", "collision", "off_road", "unfinished")]
    assert sum(end or 0.0 for end in ends) == pytest.approx(1.0)
    assert found.trips >= SMALL["episodes"] * SMALL["agents"]
    assert (found["off_road"].mean or 0.0) > 0.5


def test_the_parts_of_the_return_sum_to_the_return(by_chance: EvaluationReport) -> None:
    found = by_chance["random_actions"]
    parts = [found[m.name].mean or 0.0 for m in METRICS if m.name.startswith("reward_")]
    assert sum(parts) == pytest.approx(found["episode_return"].mean, rel=1e-4)


def test_the_same_seed_gives_the_same_report(by_chance: EvaluationReport) -> None:
    again = evaluate("merge", "random_actions", seed=4, **SMALL)
    other = evaluate("merge", "random_actions", seed=5, **SMALL)
    assert results(again) == results(by_chance)
    assert results(other) != results(by_chance)


def test_a_world_without_agents_reports_the_other_vehicles() -> None:
    report = evaluate("merge", "idm", **SMALL | {"agents": 0})
    (found,) = report.policies.values()
    assert found.trips == 0
    assert found.metrics["background_co2_g_per_km"].mean > 0.0
    assert found.metrics["episode_return"].mean is None


def test_a_report_is_json(by_chance: EvaluationReport) -> None:
    document = json.loads(json.dumps(by_chance.to_dict(), allow_nan=False))
    assert list(document["manifest"]["policies"]) == ["random_actions"]
    assert set(document["metrics"]) == {metric.name for metric in METRICS}


def test_one_run_has_no_interval_between_runs(by_chance: EvaluationReport) -> None:
    found = by_chance["random_actions"]
    assert all(found[metric.name].between_run_ci95 is None for metric in METRICS)
    assert found["off_road"].interval == found["off_road"].within_run[0].wilson95
    assert found["episode_return"].interval is None
    assert "not available" in by_chance.to_dict()["between_run_ci95"]


def test_the_built_in_driver_arrives_and_random_actions_do_not(
    by_chance: EvaluationReport,
) -> None:
    report = evaluate("merge", "idm", episodes=2, agents=3, background=3, seed=4)
    driver, chance = report["idm"], by_chance["random_actions"]
    assert (driver["success"].mean or 0.0) > 0.8
    assert driver["collision"].mean == 0.0
    assert chance["success"].mean == 0.0
    assert (driver["episode_return"].mean or 0.0) > (chance["episode_return"].mean or 0.0)
    assert (driver["background_arrivals_per_h"].mean or 0.0) > 0.0


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
def test_every_population_mode_can_be_evaluated(mode: str) -> None:
    report = evaluate(
        "merge", "idm", overrides={"population.mode": mode}, **{**SMALL, "max_cycles": 600}
    )
    assert (report["idm"]["success"].mean or 0.0) > 0.5


def test_episodes_do_not_depend_on_how_many_worlds_run_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = {**SMALL, "episodes": 5}
    together = evaluate("merge", "idm", seed=4, **settings)
    monkeypatch.setattr(episodes, "MAX_VEHICLES", 2 * (SMALL["agents"] + SMALL["background"]))
    apart = evaluate("merge", "idm", seed=4, **settings)
    assert apart["idm"].speed[0].worlds == 2
    assert results(apart) == results(together)


def test_the_number_of_worlds_at_once_is_limited() -> None:
    most = max(worlds_at_once(count, 20) for count in range(1, 2000))
    assert worlds_at_once(100_000, 20) <= most == episodes.MAX_WORLDS
    assert worlds_at_once(100_000, 1_000_000) == 1
    assert worlds_at_once(3, 20) == 3


def test_each_run_has_its_own_seed_and_the_first_run_has_the_given_seed() -> None:
    seeds = run_seeds(4, 5)
    assert seeds[0] == 4
    assert len(set(seeds)) == 5
    assert run_seeds(4, 3) == seeds[:3]
    assert not set(run_seeds(5, 5)) & set(seeds)


def test_a_run_in_a_new_process_equals_a_run_in_this_process(
    compared: Path, by_chance: EvaluationReport
) -> None:
    found = load_report(compared)["chance"]["episode_return"].within_run[0]
    assert found == by_chance["random_actions"]["episode_return"].within_run[0]
    seed = run_seeds(4, 3)[2]
    third = evaluate("merge", {"driver": "idm"}, seed=seed, **SMALL)
    mine = third["driver"]["episode_return"].within_run[0]
    assert load_report(compared)["driver"]["episode_return"].within_run[2] == mine


def test_the_interval_between_runs_is_computed_from_the_run_means(compared: Path) -> None:
    found = load_report(compared)["driver"]["episode_return"]
    means = np.array([run.mean for run in found.within_run])
    half = student_quantile(2) * means.std(ddof=1) / np.sqrt(3.0)
    assert found.mean == pytest.approx(means.mean())
    assert found.between_run_ci95 is not None
    assert found.between_run_ci95.low == pytest.approx(means.mean() - half)
    assert found.between_run_ci95.high == pytest.approx(means.mean() + half)


def test_intervals_of_bounded_metrics_stay_in_bounds_and_have_a_width(compared: Path) -> None:
    for policy in load_report(compared).policies.values():
        for metric in METRICS:
            interval = policy[metric.name].between_run_ci95
            if metric.share and policy[metric.name].mean is not None:
                assert interval is not None
            if metric.bounded and interval is not None:
                assert 0.0 <= interval.low < interval.high <= 1.0


def test_policies_are_compared_within_each_run(compared: Path) -> None:
    report = load_report(compared)
    assert report["driver"].minus_first == {}
    found = report["chance"].minus_first["episode_return"]
    pairs = zip(
        report["chance"]["episode_return"].within_run,
        report["driver"]["episode_return"].within_run,
        strict=True,
    )
    expected = [(mine.mean or 0.0) - (first.mean or 0.0) for mine, first in pairs]
    assert found.runs == pytest.approx(expected)
    assert found.mean == pytest.approx(np.mean(expected))
    assert found.distinct


def test_the_tables_contain_every_trip_and_episode(compared: Path) -> None:
    tables = load_tables(compared)
    for trips, rows in tables.values():
        assert rows["run"].tolist() == [0] * 3 + [1] * 3 + [2] * 3
        assert rows["episode"].tolist() == [0, 1, 2] * 3
        assert trips.size == rows["trips"].sum()
        assert np.isfinite(trips["end_x_m"]).all()
    with (compared / "trips.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    assert header[:4] == ["policy", "run", "episode", "agent"]
    assert len(lines) == sum(trips.size for trips, _ in tables.values())


@pytest.mark.parametrize("key", ["episodes", "repeats"])
@pytest.mark.parametrize("value", [0, -1, 10**9, 2.0, True, "3"])
def test_counts_that_are_not_positive_whole_numbers_are_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=f"{key} = "):
        evaluate("merge", "idm", **{key: value})


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownEnvironmentError, match="merg"):
        evaluate("merg", "idm", episodes=1)
    with pytest.raises(PolicyError, match="idn"):
        evaluate("merge", "idn", episodes=1, out=tmp_path)
    with pytest.raises(PolicyError, match="twice"):
        evaluate("merge", ["idm", "idm"], episodes=1)
    with pytest.raises(PolicyError, match="at least one"):
        evaluate("merge", [], episodes=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [-1, 1.5, 2**63])
def test_a_seed_that_is_not_a_whole_number_is_refused(seed: Any) -> None:
    with pytest.raises(ConfigError, match="seed"):
        evaluate("merge", "idm", episodes=1, seed=seed)


def test_progress_is_reported_after_every_step() -> None:
    told: list[tuple[str, int, int]] = []
    settings = {**SMALL, "max_cycles": 7}
    evaluate("ring", "idm", progress=lambda *words: told.append(words), **settings)
    assert told == [("idm", k, 7) for k in range(1, 8)]
