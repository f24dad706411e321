"""`cavmarl bench traffic --model` compares generated traffic of several drivers with SUMO's."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.traffic.model_comparison import compare_models

pytest.importorskip("libsumo", reason="needs the extra 'sumo'")


def run(*words: str) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def test_each_driver_and_sumo_have_a_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "out.json"
    words = ("bench", "traffic", "grid4x4", "--background", "24", "--seconds", "40")
    models = ("--model", "IDM", "--model", "zoo:cities_ippo", "--model", "zoo:cities_ippo=1,ACC=1")
    assert run(*words, *models, "--json", str(file)) == 0
    shown = capsys.readouterr().out
    assert "grid4x4, 24 vehicles, 40 s" in shown
    assert "per 1,000 km of all vehicles" in " ".join(shown.split())
    found = json.loads(file.read_text(encoding="utf-8"))
    names = ["IDM", "zoo:cities_ippo", "zoo:cities_ippo 1, ACC 1", "SUMO"]
    assert [side["name"] for side in found["sides"]] == names
    for side in found["sides"]:
        figures = side["figures"]
        assert figures["departed"] >= 20
        assert figures["distance_km"] > 3.0
        assert figures["mean_speed_mps"] == pytest.approx(9.0, abs=5.0)
        assert figures["flow_per_h"] > 10.0
        per_km = figures["contacts"] / figures["distance_km"]
        assert figures["contacts_per_1000_km"] == pytest.approx(1000.0 * per_km)
    idm, learned = (found["sides"][k]["figures"] for k in (0, 1))
    assert idm["mean_speed_mps"] != learned["mean_speed_mps"]
    sumo = found["sides"][-1]
    assert sumo["figures"]["departed"] <= idm["departed"]
    assert (found["sides"][0]["removed"], sumo["removed"]) == (0, None)


def test_wrong_arguments_are_refused() -> None:
    for models, keys, said in (
        ([], {}, "name at least one driver"),
        (["IDM"], {"vehicles": 0}, "background = 0"),
        (["IDM"], {"dt_s": 0.15}, "whole number of steps"),
        (["IDM"], {"seconds": 0}, "seconds = 0"),
        (["IDN"], {}, "'IDN' is not a driver model"),
    ):
        with pytest.raises(ConfigError, match=said):
            compare_models("grid4x4", models, **({"vehicles": 5, "seconds": 5} | keys))


def test_a_demand_with_generated_vehicles_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("bench", "traffic", "grid4x4", "--model", "IDM")
    assert run(*words, "--demand", "a.rou.xml") != 0
    assert "leave out --demand" in capsys.readouterr().err
    assert run("bench", "traffic", "grid4x4", "--model", "IDM=much") != 0
    assert "with its share" in capsys.readouterr().err
