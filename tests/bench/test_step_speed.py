"""The comparison with highway-env, small: both sides run, on the same road."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cavmarl.bench import step_speed
from cavmarl.bench.highway_worlds import RUN_OUT_M, straight_road
from cavmarl.bench.step_speed import MORE, measure_step_speed
from cavmarl.core.errors import ConfigError, MissingExtraError
from cavmarl.maps.check import check_map


def test_every_row_is_measured_each_turn() -> None:
    pytest.importorskip("highway_env")
    told: list[str] = []
    found = measure_step_speed(agents=3, worlds=2, repeats=2, progress=told.append)
    rows = {(row.sensors, row.who): row for row in found.rows}
    assert len(rows) == len(found.rows) == 9
    for row in found.rows:
        assert 0.0 < row.low <= row.median <= row.high
    assert rows["kinematics", "more"].agents == MORE * 3
    batched, theirs = rows["lidar", "batched"], rows["lidar", "highway_env"]
    assert (batched.worlds, theirs.worlds) == (2, 1)
    assert found.ratio == batched.median / theirs.median
    assert found.cost_of_more == pytest.approx(
        rows["kinematics", "more"].agent_step_s / rows["kinematics", "batched"].agent_step_s
    )
    assert [text for text in told if text.startswith("measuring")] == [
        "measuring, 1 of 2",
        "measuring, 2 of 2",
    ]


def test_the_road_can_be_driven(tmp_path: Path) -> None:
    report = check_map(straight_road(tmp_path, 500.0))
    assert report.drivable
    assert report.road_km == pytest.approx((500.0 + RUN_OUT_M) / 1000.0)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
def test_the_cores_are_given_back() -> None:
    before = os.sched_getaffinity(0)
    with step_speed.one_core():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize("wrong", [{"agents": 0}, {"worlds": 0}, {"repeats": 0}, {"agents": 10**6}])
def test_numbers_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        measure_step_speed(**wrong)


def test_without_highway_env_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(module: str) -> None:
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("cavmarl.core.errors.importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install 'cavmarl\[highway\]'"):
        measure_step_speed(agents=1)
