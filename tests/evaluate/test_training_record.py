"""A training run records the placement of its worlds on workers."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl import make_vec
from cavmarl.evaluate.provenance.manifest import MANIFEST_FILE, read_closed
from cavmarl.evaluate.provenance.training_record import begin_training, end_training
from tests.cli.test_main import refusal, run


@pytest.mark.filterwarnings("ignore:workers = :RuntimeWarning")
@pytest.mark.parametrize(
    ("worlds", "zones", "sources"),
    # In the first case, no world is divided, so each world runs on one worker.
    [(5, 1, ["measured"]), (2, 4, ["length of lanes", "measured"])],
)
def test_plans_are_recomputed_from_the_manifest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], worlds: int, zones: int, sources: list[str]
) -> None:
    overrides = {"workers.balance_steps": 3, "workers.imbalance_tolerance": 0.0}
    vec = make_vec("ring", num_envs=worlds, zones=zones, workers=3, overrides=overrides)
    try:
        begin_training(tmp_path, "test", {"seed": 1}, vec.worlds.world, vec.plans)
        first = vec.plan_text()
        vec.reset(seed=1)
        for _ in range(8):
            vec.step(vec.suggest_actions())
        end_training(tmp_path, [], vec.plans)
    finally:
        vec.close()
    document = read_closed(tmp_path)
    assert all(plan["cost_source"] != "measured" for plan in document["placement"])
    at_end = [plan["cost_source"] for plan in document["placement_at_end"]]
    assert at_end == sources
    assert run("plan", "--again", str(tmp_path / MANIFEST_FILE)) == 0
    assert capsys.readouterr().out == f"{first}\n\n{vec.plan_text()}\n"


def test_a_run_without_workers_has_no_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vec = make_vec("ring")
    begin_training(tmp_path, "test", {"seed": 1}, vec.worlds.world, vec.plans)
    end_training(tmp_path, [])
    said = refusal(capsys, "plan", "--again", str(tmp_path / MANIFEST_FILE))
    assert "had no workers" in said
