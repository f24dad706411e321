"""Evaluation: what it counts, that it repeats itself, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from cavmarl.errors import ConfigError, PolicyError, UnknownEnvironmentError
from cavmarl.evaluate import EvaluationReport, evaluate
from cavmarl.evaluate.manifest import Manifest

SMALL: dict[str, Any] = {"episodes": 3, "agents": 3, "background": 3, "max_cycles": 60}


def without_speed(report: EvaluationReport) -> dict[str, Any]:
    return {name: value for name, value in report.to_dict().items() if name != "speed"}


@pytest.fixture(scope="module")
def by_chance() -> EvaluationReport:
    return evaluate("merge", "random_actions", seed=4, **SMALL)


def test_the_ends_of_trips_add_up(by_chance: EvaluationReport) -> None:
    ends = (by_chance.success, by_chance.collision, by_chance.off_road, by_chance.unfinished)
    assert sum(end.mean or 0.0 for end in ends) == pytest.approx(1.0)
    assert by_chance.trips >= SMALL["episodes"] * SMALL["agents"]
    assert (by_chance.off_road.mean or 0.0) > 0.5


def test_the_same_seed_gives_the_same_report(by_chance: EvaluationReport) -> None:
    again = evaluate("merge", "random_actions", seed=4, **SMALL)
    other = evaluate("merge", "random_actions", seed=5, **SMALL)
    assert without_speed(again) == without_speed(by_chance)
    assert without_speed(other) != without_speed(by_chance)


def test_a_report_is_json(by_chance: EvaluationReport) -> None:
    text = json.dumps(by_chance.to_dict(), allow_nan=False)
    assert json.loads(text)["manifest"]["policy"] == "random_actions"


def test_the_built_in_driver_arrives_where_chance_does_not(by_chance: EvaluationReport) -> None:
    report = evaluate("merge", "idm", episodes=2, agents=3, background=3, seed=4)
    assert report.success.mean is not None
    assert report.success.mean > 0.8
    assert report.collision.mean == 0.0
    assert by_chance.success.mean == 0.0
    assert (report.episode_return.mean or 0.0) > (by_chance.episode_return.mean or 0.0)


@pytest.mark.parametrize("mode", ["closed", "entering", "seats"])
def test_every_population_can_be_judged(mode: str) -> None:
    report = evaluate(
        "merge", "idm", overrides={"population.mode": mode}, **{**SMALL, "max_cycles": 600}
    )
    assert report.episodes == SMALL["episodes"]
    assert (report.success.mean or 0.0) > 0.5


def test_the_manifest_says_what_a_result_depends_on(by_chance: EvaluationReport) -> None:
    def manifest(env: str = "merge", **changed: Any) -> Manifest:
        settings = {**SMALL, "max_cycles": 1, **changed}
        return evaluate(env, "random_actions", seed=4, **settings).manifest

    first = manifest()
    assert manifest() == first
    assert manifest(agents=2).config_hash != first.config_hash
    assert manifest("ring").map_hash != first.map_hash
    assert asdict(first)["seed"] == by_chance.manifest.seed == 4


@pytest.mark.parametrize("episodes", [0, -1, 10**9, 2.0, True, "3"])
def test_episodes_must_be_a_count(episodes: Any) -> None:
    with pytest.raises(ConfigError, match="episodes = "):
        evaluate("merge", "idm", episodes=episodes)


def test_episodes_that_need_too_much_memory_are_refused() -> None:
    with pytest.raises(ConfigError, match="take at most 1960 episodes"):
        evaluate("merge", "idm", episodes=10_000, agents=20, background=1000)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UnknownEnvironmentError, match="merg"):
        evaluate("merg", "idm", episodes=1)
    with pytest.raises(PolicyError, match="idn"):
        evaluate("merge", "idn", episodes=1)


@pytest.mark.parametrize("seed", [-1, 1.5, 2**63])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(ConfigError, match="seed"):
        evaluate("merge", "idm", episodes=1, seed=seed)


def test_progress_is_told_after_every_step() -> None:
    told: list[tuple[int, int]] = []
    settings = {**SMALL, "max_cycles": 7}
    evaluate("ring", "idm", progress=lambda k, n: told.append((k, n)), **settings)
    assert told == [(k, 7) for k in range(1, 8)]
