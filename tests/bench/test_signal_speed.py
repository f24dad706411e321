"""The benchmark that compares signal control with sumo-rl."""

from __future__ import annotations

import stat
import sys
from pathlib import Path

import pytest

from cavmarl import ConfigError
from cavmarl.bench.signal_speed import PYTHON, measure_signal_speed

NET = Path("envs/grid4x4/map/map.net.xml").resolve()
SIDE = """#!/bin/sh
echo "Step #0"
echo ready
while read line; do echo 0.5; done
"""


def config_in(folder: Path) -> Path:
    (folder / "few.rou.xml").write_text(
        '<routes><flow id="a" from="left0A0" to="D0right0" begin="0" end="60" period="6"/></routes>'
    )
    path = folder / "few.sumocfg"
    path.write_text(
        f'<configuration><input><net-file value="{NET}"/><route-files value="few.rou.xml"/>'
        "</input></configuration>"
    )
    return path


def test_rates_are_decisions_of_all_worlds_per_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A script in the place of sumo-rl reports half a second for each turn."""
    program = tmp_path / "python"
    program.write_text(SIDE)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv(PYTHON, str(program))
    found = measure_signal_speed(
        config_in(tmp_path), worlds=(1, 2), after_s=5, turn=3, repeats=2, seed=1
    )
    assert found.signals == 16
    assert found.sumo_rl.median == 6.0
    for number, rates in found.ours.items():
        assert found.ratios[number] == rates.median / 6.0
        assert rates.low > 0.0


def test_the_error_for_a_python_without_sumo_rl_names_the_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON, sys.executable)
    with pytest.raises(ConfigError, match=f"sumo-rl ended: .*sumo_rl.*\nCure: .* {PYTHON}"):
        measure_signal_speed(config_in(tmp_path), worlds=(1,), after_s=5, turn=1, repeats=1)


def test_a_map_without_demand_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"map\.net\.xml"):
        measure_signal_speed(NET)
