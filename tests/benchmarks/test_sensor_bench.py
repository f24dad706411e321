"""The benchmark of sensor workers: runs, parts of a step, resources and files."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import sensors
from benchmarks.program import run
from benchmarks.sensor_bench import SensorBench, measure_sensor_workers
from benchmarks.sensor_run import PARTS, describe_rig, load_rig
from cavmarl.config.registry import find_settings, load_config
from cavmarl.core.errors import ConfigError
from cavmarl.parallel.processes.process_barrier import usable_cores
from cavmarl.roads.cache import load_network
from tests.support.sumo_worlds import MODES, tiny_file

RIG: dict[str, dict[str, Any]] = {
    "lidar": {"type": "lidar", "rate_hz": 10, "rays": 30, "z_m": 1.6},
    "picture": {"type": "rgb_camera", "rate_hz": 10, "z_m": 1.5, "width": 32, "height": 18},
    "grid": {"type": "bev_grid", "rate_hz": 5},
    "wheels": {"type": "odometry", "rate_hz": 20},
}


@pytest.fixture(scope="module")
def found() -> SensorBench:
    """Return a result. It takes 8 s of processor time, so the tests that use it are slow."""
    return measure_sensor_workers(
        "grid4x4", RIG, workers=(1, 2), warmup=2, steps=6, repeats=1, background=3
    )


@pytest.mark.slow
def test_the_result_contains_every_run(found: SensorBench) -> None:
    assert sorted((turn.repeat, turn.workers) for turn in found.turns) == [(1, 1), (1, 2)]
    assert [turn.place for turn in found.turns] == [1, 2]
    assert all(len(turn.run.step_ms) == 6 for turn in found.turns)
    assert found.is_same
    assert all(len(turn.run.digests) == 3 for turn in found.turns)


@pytest.mark.slow
def test_the_speed_of_independent_programs_is_measured_with_the_workers(found: SensorBench) -> None:
    if len(usable_cores()) < 2:
        assert found.ceiling is None
        return
    assert found.ceiling is not None
    assert found.ceiling.programs == 2
    assert 0.0 < found.ceiling.ratio == found.facts()["ceiling"]["ratio"]


@pytest.mark.slow
def test_the_parts_of_a_step_sum_to_at_most_the_step(found: SensorBench) -> None:
    # No lower bound of the sum is checked, because other programs disturb the measurement.
    for row in found.rows:
        parts = found.parts_ms(row.workers)
        assert tuple(parts) == PARTS
        assert min(parts.values()) >= 0.0
        assert 0.0 < sum(parts.values()) <= row.step_ms * (1.0 + 1e-9)
        assert row.wait_ms < row.step_ms


@pytest.mark.slow
def test_the_time_of_sumo_is_a_separate_part(found: SensorBench, tmp_path: Path) -> None:
    """The part exists for both kinds of coupling, and is 0 in worlds without SUMO."""
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    assert found.parts_ms(1)["SUMO"] == 0.0
    for source in MODES:
        more = {
            "traffic.source": source,
            "traffic.demand": [str(tiny_file(tmp_path))],
            "sensors.signal.timing": False,
        }
        coupled = measure_sensor_workers(
            "grid4x4", RIG, workers=(1,), warmup=1, steps=4, repeats=1, overrides=more
        )
        parts = coupled.parts_ms(1)
        assert parts["SUMO"] > 0.0
        assert sum(parts.values()) <= coupled.rows[0].step_ms * (1.0 + 1e-9)
        assert "SUMO" in coupled.facts()["parts_ms"][1]


@pytest.mark.slow
def test_resources_of_all_processes_are_reported(found: SensorBench) -> None:
    ticks = 6 * found.turns[0].run.ticks_per_step
    for number in (1, 2):
        (window,) = found.windows(number)
        assert window.steps == 6
        assert len(window.worker_cpu_s) == len(window.worker_rss_mb) == number
        assert window.messages == 2 * number * ticks  # one message in each direction
        assert window.got_bytes > 6 * 32 * 18 * 3


@pytest.mark.slow
def test_the_placement_by_cost_and_the_placement_in_turn_are_reported(found: SensorBench) -> None:
    shares = found.shares(2)
    assert shares["in_turn"].homes == (0, 1, 0, 1)
    assert max(shares["cost"].loads_s) <= max(shares["in_turn"].loads_s)


@pytest.mark.slow
def test_the_result_is_json_with_every_sensor(found: SensorBench) -> None:
    told = json.loads(json.dumps(found.facts()))
    sensors = told["turns"][0]["run"]["sensors"]
    assert [sensor["name"] for sensor in sensors] == list(RIG)
    assert sensors[1]["resolution"] == [18, 32, 3]
    assert sensors[1]["placement"]["z_m"] == 1.5
    assert found.rows[0].ci95_between_runs is None


def test_the_description_of_the_rig_lists_ten_sensors() -> None:
    rig = load_rig(find_settings("rig", "ten_sensors"))
    config, _ = load_config("grid4x4", overrides={"rig": rig})
    told = describe_rig(config)
    assert len(told) == 10
    assert all(
        {"type", "resolution", "lines", "rate_hz", "placement"} <= sensor.keys() for sensor in told
    )


def test_the_default_map_is_the_map_of_the_papers() -> None:
    network = load_network(Path(sensors.TOWN))
    roads = network.edges[~network.edges["internal"]]
    assert len(roads) == 46
    assert 1500.0 < roads["length_m"].sum() < 1700.0


def test_the_benchmark_writes_every_step_and_a_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "small.yaml"
    rig.write_text("wheels: {type: odometry, rate_hz: 20}\n")
    words = ["grid4x4", "--rig", str(rig), "--workers", "1,2"]
    words += ["--warmup", "1", "--steps", "3", "--repeats", "1"]
    words += ["--csv", str(tmp_path / "steps.csv"), "--plot", str(tmp_path / "figure.png")]
    with pytest.raises(SystemExit) as ended:
        run(sensors.measure, [*words, "--json", str(tmp_path / "found.json")])
    assert not ended.value.code
    assert "step by step: the same" in capsys.readouterr().out
    with (tmp_path / "steps.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert sorted({line["workers"] for line in lines}) == ["1", "2"]
    assert len(lines) == 6
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    written = json.loads((tmp_path / "found.json").read_text())
    assert written["is_same"]
    assert [row["workers"] for row in written["rows"]] == [1, 2]


@pytest.mark.parametrize("option", ["--csv", "--plot", "--json"])
def test_an_unwritable_file_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    missing = tmp_path / "missing" / "x.png"
    with pytest.raises(SystemExit) as ended:
        run(sensors.measure, ["nowhere", option, str(missing)])
    assert ended.value.code == 2
    assert f"{option} {missing}: cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    "numbers",
    [
        {"workers": ()},
        {"workers": (0, 1)},
        {"workers": (1, 1)},
        {"workers": (1, 65)},
        {"steps": 1},
        {"repeats": 0},
        {"warmup": -1},
    ],
)
def test_invalid_numbers_are_refused(numbers: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        measure_sensor_workers("grid4x4", RIG, **numbers)


def test_an_unknown_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no rig or file 'nothing'"):
        find_settings("rig", "nothing")
    (tmp_path / "list.yaml").write_text("wheels: 20\n")
    with pytest.raises(ConfigError, match="must contain sensors by name"):
        load_rig(tmp_path / "list.yaml")
