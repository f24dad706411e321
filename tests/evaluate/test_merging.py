"""Evaluations of single runs are merged into one evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ManifestError
from cavmarl.evaluate import evaluate, load_report
from cavmarl.evaluate.evaluation import run_seeds
from cavmarl.evaluate.merging import merge_runs

WORLD: dict[str, Any] = {"agents": 2, "background": 4, "max_cycles": 15, "episodes": 2}
SEED = 11


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folders = []
    for seed in run_seeds(SEED, 2):
        folders.append(tmp_path_factory.mktemp("part"))
        evaluate("ring", ["idm", "random_actions"], out=folders[-1], seed=seed, **WORLD)
    return folders


def test_merged_runs_equal_the_runs_of_one_evaluation(parts: list[Path], tmp_path: Path) -> None:
    whole, merged = tmp_path / "whole", tmp_path / "merged"
    together = evaluate("ring", ["idm", "random_actions"], out=whole, seed=SEED, repeats=2, **WORLD)
    merged.mkdir()
    merge_runs(parts, merged)
    for name in ("trips.csv", "episodes.csv", "tracks.csv", "map.json"):
        assert (merged / name).read_bytes() == (whole / name).read_bytes()
    report = load_report(merged)
    assert report.seeds == together.seeds
    for name, driver in together.policies.items():
        assert report[name].metrics == driver.metrics
        assert report[name].minus_first == driver.minus_first
    assert [part["seeds"] for part in report.manifest["parts"]] == [[s] for s in report.seeds]


def test_runs_of_different_evaluations_are_not_merged(parts: list[Path], tmp_path: Path) -> None:
    other, divided = tmp_path / "other", tmp_path / "divided"
    evaluate("ring", "idm", out=other, seed=SEED, **WORLD)
    evaluate("ring", ["idm", "random_actions"], out=divided, seed=SEED, zones=2, **WORLD)
    with pytest.raises(ManifestError, match=r"its policies differs from that of .*same evaluation"):
        merge_runs([parts[0], other], tmp_path)
    with pytest.raises(ManifestError, match=r"its world differs"):
        merge_runs([parts[0], divided], tmp_path)
    with pytest.raises(ManifestError, match=r"places\.json, which cannot be merged; merge runs of"):
        merge_runs([divided], tmp_path)
    with pytest.raises(ManifestError, match=r"no manifest\.json"):
        merge_runs([tmp_path], tmp_path)
    with pytest.raises(ManifestError, match="holds the results of another run"):
        merge_runs(parts, parts[0])


def test_an_evaluation_of_several_runs_is_not_merged(tmp_path: Path) -> None:
    evaluate("ring", "idm", out=tmp_path, repeats=2, **WORLD | {"max_cycles": 2})
    with pytest.raises(ManifestError, match="has 2 runs; merge single runs"):
        merge_runs([tmp_path], tmp_path)
