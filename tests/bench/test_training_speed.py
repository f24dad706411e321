"""The benchmark that compares PPO of cavmarl with PPO of stable-baselines3."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from cavmarl.bench import training_speed
from cavmarl.bench.training_speed import TrainingRow, TrainingSpeed, measure_training
from cavmarl.core.errors import ConfigError, MissingExtraError
from tests.cli.test_main import run

pytestmark = pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code


def test_both_programs_learn_from_equal_numbers_of_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("torch", "highway_env", "stable_baselines3"):
        pytest.importorskip(module)
    path = tmp_path / "speed.json"
    small = ("--agents", "2", "--worlds", "2", "--repeats", "1")
    assert run("bench", "train", *small, "--at-least", "1e9", "--json", str(path)) == 1
    found = json.loads(path.read_text())
    ours, recipe, theirs = found["rows"]
    assert (ours["name"], theirs["name"]) == ("cavmarl", "stable_baselines3")
    assert ours["worlds"] * training_speed.OUR_STEPS * 2 == theirs["decisions"]
    assert 0 < ours["decisions"] <= theirs["decisions"]
    assert found["numbers"] == 25
    for row in (ours, recipe, theirs):
        assert sum(row["shares"].values()) == pytest.approx(1.0)
        assert all(rate > 0.0 for rate in row["rates"])
    assert found["end_to_end"]["kind"] != found["stepping"]["kind"]
    assert found["stepping"]["agent_steps_per_s"][0] > 0.0
    assert found["hardware"]["usable_cores"] >= 1
    assert "without learning" in capsys.readouterr().out


def test_ratios_compare_rates_of_the_same_turn() -> None:
    def row(name: str, *rates: float) -> TrainingRow:
        return TrainingRow(name, 2, 100, rates, {})

    rows = (
        row("cavmarl", 10.0, 30.0, 20.0),
        row("cavmarl_recipe", 20.0, 30.0, 30.0),
        row("stable_baselines3", 1.0, 2.0, 1.0),
    )
    found = TrainingSpeed(2, 3, 25, 105, rows, (1.0,), {"usable_cores": 2})
    assert found.ratio == 15.0
    assert found.recipe_rate == 30.0
    assert found.is_crowded


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"agents": 0}, "agents = 0"), ({"repeats": 0}, "repeats"), ({"worlds": 3}, "3 worlds")],
)
def test_invalid_numbers_are_refused(wrong: dict[str, int], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        measure_training(**wrong)


def test_the_error_without_highway_env_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "highway_env", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[bench\]"):
        measure_training()
