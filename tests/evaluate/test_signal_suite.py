"""Metrics of signal controllers, and the suite that compares controllers."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl import ConfigError
from cavmarl.cli import app
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.evaluate.signals.signal_meter import SignalFigures, SignalMeter, is_jammed
from cavmarl.evaluate.signals.signal_runs import run_controller, run_sumo
from cavmarl.evaluate.traffic.sumo_side import SumoJob
from cavmarl.roads.cache import load_network
from cavmarl.traffic.sumo.sumo_input import read_input

MAP = Path("envs/grid4x4/map/map.net.xml")


def test_the_meter_measures_waiting_time_stops_queues_and_red() -> None:
    """One vehicle stands three seconds at red, drives, and stands again."""
    network = load_network(MAP)
    meter = SignalMeter(network, 0.5)
    link = int(np.flatnonzero(network.links["signal"] >= 0)[0])
    rows = np.zeros(1, VEHICLE)
    rows["lane"], rows["departed"], rows["order"] = network.links["from_lane"][link], 8, 0
    red = np.zeros(len(network.links), np.uint8)
    green = np.full(len(network.links), 3, np.uint8)
    due = np.array([4])
    shown = [(0.0, red), (0.0, red), (0.0, red), (5.0, red), (0.0, red), (0.0, green)]
    for second, (speed, codes) in enumerate(shown, start=5):
        rows["speed"], rows["free_s"] = speed, 0.25
        meter.sample(rows, 2 * second, due, codes)
    figures = meter.result(
        arrived=0,
        trip_s=0.0,
        delay_s=0.0,
        waiting_s=np.array([7.0]),
        switches_per_h=None,
        jams=None,
    )
    assert figures.waiting_s == 5.0
    assert figures.stops == 2.0
    assert figures.longest_red_s == 3.0
    assert figures.most_queued == 1
    assert figures.queue == pytest.approx(5 / 6)
    assert figures.never_departed == 1
    assert figures.delay_s is None
    # The vehicle has lost (20 - 8) / 2 - 0.25 s on its way, and 2 s before its departure. The
    # vehicle that has not departed has lost 7 s.
    assert figures.delay_of_all_s == pytest.approx((6.0 - 0.25 + 2.0 + 7.0) / 2)


@pytest.mark.parametrize(
    ("arrived", "late", "seconds", "expected"),
    [
        (600, 100, 3600, False),  # 500 vehicles in the first 50 minutes, and 100 in the last ten
        (550, 50, 3600, False),  # the rate in the last ten minutes is half the rate before
        (549, 49, 3600, True),
        (0, 0, 3600, False),
        (549, 49, 1199, None),
        (100, 20, 1200, True),
    ],
)
def test_a_run_jams_if_the_rate_of_arrivals_falls_below_half_in_the_last_ten_minutes(
    arrived: int, late: int, seconds: int, expected: bool | None
) -> None:
    assert is_jammed(arrived, late, seconds) is expected


def test_a_run_with_a_blocked_exit_jams_in_cavmarl_and_in_sumo(tmp_path: Path) -> None:
    demand = tmp_path / "closed.rou.xml"
    demand.write_text(
        '<routes><route id="r" edges="left0A0 A0B0 B0C0 C0D0 D0right0"/>'
        '<flow id="f" route="r" begin="0" end="1200" period="6"/>'
        '<vehicle id="x" route="r" depart="300"><stop lane="C0D0_0" duration="9999"/></vehicle>'
        '<vehicle id="y" route="r" depart="300"><stop lane="C0D0_1" duration="9999"/></vehicle>'
        "</routes>"
    )
    keys = {"traffic.demand": [str(demand)], "population.background": 0}
    (jammed,) = run_controller("grid4x4", "map", seconds=1200, seeds=[1], overrides=keys)
    sumo = run_sumo(SumoJob(MAP, read_input([demand]), 1200, 0.2, 1))
    assert jammed.jams is True
    assert sumo.jams is True


def test_controllers_and_sumo_are_measured_in_the_same_way(tmp_path: Path) -> None:
    demand = tmp_path / "regular.rou.xml"
    demand.write_text(
        '<routes><vType id="car" sigma="0" speedDev="0"/>'
        '<route id="along" edges="left0A0 A0B0 B0C0 C0D0 D0right0"/>'
        '<route id="across" edges="bottom1B0 B0B1 B1B2 B2B3 B3top1"/>'
        '<flow id="a" type="car" route="along" begin="0" end="200" period="6"/>'
        '<flow id="b" type="car" route="across" begin="0" end="200" period="8"/>'
        "</routes>"
    )
    keys = {"traffic.demand": [str(demand)], "population.background": 0}
    ours = run_controller("grid4x4", "map", seconds=400, seeds=[1], overrides=keys)
    chosen = run_controller("grid4x4", "max_pressure", seconds=400, seeds=[1], overrides=keys)
    sumo = run_sumo(SumoJob(MAP, read_input([demand]), 400, 0.2, 1))
    assert ours[0].departed == chosen[0].departed == sumo.departed > 0
    assert ours[0].arrived == sumo.arrived > 0
    assert ours[0].trip_s == pytest.approx(sumo.trip_s, rel=0.15)
    assert ours[0].co2_g_per_km == pytest.approx(sumo.co2_g_per_km, rel=0.25)
    assert ours[0].switches_per_h is None
    assert chosen[0].switches_per_h is not None
    assert chosen[0].switches_per_h > 0.0
    assert sumo.queue is None
    assert ours[0].jams is None  # the run is too short to decide


def test_a_step_of_another_length_and_an_unknown_controller_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"clock\.ctrl_dt_s: figures are sampled every second"):
        run_controller(
            "grid4x4", "program", seconds=9, seeds=[1], overrides={"clock.ctrl_dt_s": 0.2}
        )
    with pytest.raises(ConfigError, match=r"signals\.controller = 'greedy'"):
        run_controller("grid4x4", "greedy", seconds=9, seeds=[1])


def test_the_suite_prints_a_table(tmp_path: Path) -> None:
    suite = tmp_path / "small.yaml"
    suite.write_text(
        "maps: [grid4x4]\nmore_maps: [none.sumocfg]\ncontrollers: [map, longest_queue]\n"
        "background: 60\nhorizon_s: 120\n"
    )
    found = CliRunner().invoke(
        app, ["suite", str(suite), "--repeats", "2", "--json", str(tmp_path / "all.json")]
    )
    assert found.exit_code == 0, found.output
    assert "left out: none.sumocfg" in found.output
    assert "longest queue" in found.output
    assert "runs that jam" in found.output
    content = (tmp_path / "all.json").read_text()
    for name in asdict(SignalFigures(0, 0, 0, None, 0.0, None, 0.0, 0.0, *[None] * 6)):
        assert f'"{name}"' in content
    refused = CliRunner().invoke(app, ["suite", str(suite), "--policy", "idm"])
    assert refused.exit_code != 0


def test_further_keys_change_the_worlds_of_a_suite(tmp_path: Path) -> None:
    suite = tmp_path / "small.yaml"
    suite.write_text(
        "maps: [grid4x4]\ncontrollers: [longest_queue]\nbackground: 90\nhorizon_s: 300\n"
    )

    def delay_s(*keys: str) -> float:
        path = tmp_path / "figures.json"
        settings = [word for key in keys for word in ("--set", key)]
        arguments = ["suite", str(suite), "--repeats", "1", "--json", str(path), *settings]
        found = CliRunner().invoke(app, arguments)
        assert found.exit_code == 0, found.output
        figures = json.loads(path.read_text())["grid4x4"]["longest_queue"]
        return float(figures[0]["delay_of_all_s"])

    # With a camera that misses every vehicle, the controller never ends the first green.
    blind = ("signals.sensing=camera", "signals.camera_misses=1", "signals.max_green_s=0")
    assert delay_s(*blind) > 2.0 * delay_s()
    refused = CliRunner().invoke(app, ["suite", str(suite), "--set", "horizon_s=9"])
    assert isinstance(refused.exception, ConfigError)
    assert "horizon_s: the argument `seconds` sets the simulated time" in str(refused.exception)
