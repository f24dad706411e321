"""Realism of rollouts of a logged scene: driving, comparison with the log, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl import ConfigError
from cavmarl.cli import app
from cavmarl.evaluate.realism.logged_rollouts import measure_realism
from tests.support.logged_scenes import scenario, write_pickle

REACTIVE: dict[str, Any] = {"scenario.params": {"reactive": True, "start_s": 1.0}}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pickle(tmp_path_factory.mktemp("scene"))


def test_the_realism_of_reactive_drivers_is_repeatable_and_independent_of_zones(
    scene: Path,
) -> None:
    found = measure_realism(scene, rollouts=3, overrides=REACTIVE)
    assert (found.rollouts, found.steps, found.evaluated, found.replayed) == (3, 80, 3, 3)
    assert 0.0 < found.realism.meta < 1.0
    assert found.min_ade_m <= found.ade_m
    again = measure_realism(scene, rollouts=3, overrides=REACTIVE)
    assert again == found
    divided = measure_realism(scene, rollouts=3, overrides={**REACTIVE, "zones.count": 2})
    assert divided == found


def test_an_agent_that_moves_like_the_logged_vehicle_has_high_realism(
    scene: Path, tmp_path: Path
) -> None:
    """The logged vehicle drove at a constant speed, as this policy does."""
    policy = tmp_path / "constant.py"
    policy.write_text(
        "import numpy as np\n"
        "from cavmarl.policies.policy import Policy\n"
        "class Constant(Policy):\n"
        "    def act_batch(self, observations, mask):\n"
        "        return np.zeros((*mask.shape, 2))\n"
        "def make_policy(env):\n"
        "    return Constant(env)\n",
        encoding="utf-8",
    )
    overrides = {"scenario.seats": ["8"]}
    constant = measure_realism(scene, str(policy), rollouts=2, overrides=overrides)
    assert constant.ade_m < 0.01
    assert constant.realism.likelihoods["linear_speed"] > 0.9
    slow = measure_realism(scene, "random_actions", rollouts=2, overrides=overrides)
    assert slow.ade_m > 0.5
    assert slow.realism.meta < constant.realism.meta


def test_worlds_that_cannot_be_compared_are_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a logged scene"):
        measure_realism("merge", rollouts=1)
    with pytest.raises(ConfigError, match=r"clock\.ctrl_dt_s = 0\.2: must be 0\.1"):
        measure_realism(scene, rollouts=1, overrides={"clock.ctrl_dt_s": 0.2})
    with pytest.raises(ConfigError, match="rollouts = 0"):
        measure_realism(scene, rollouts=0)


def test_the_realism_command_prints_and_writes_the_components(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "realism.json"
    words = ["scenario", "realism", str(scene), "--param", "reactive=true", "--rollouts", "2"]
    result = CliRunner().invoke(app, [*words, "--json", str(path)])
    assert result.exit_code == 0, result.output
    assert "meta-metric (2024)" in result.output
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["challenge_year"] == 2024
    assert document["realism"]["meta_metric"] == pytest.approx(
        0.2 * document["realism"]["kinematic"]
        + 0.45 * document["realism"]["interactive"]
        + 0.35 * document["realism"]["map_based"]
    )


def test_the_command_reports_a_scene_without_road_edges(tmp_path: Path) -> None:
    scene = scenario()
    for name in [name for name in scene["map_features"] if name.startswith("edge")]:
        del scene["map_features"][name]
    result = CliRunner().invoke(
        app, ["scenario", "realism", str(write_pickle(tmp_path, scene)), "--rollouts", "1"]
    )
    assert result.exit_code != 0
    assert np.char.find(str(result.exception or result.output), "no road edges") >= 0
