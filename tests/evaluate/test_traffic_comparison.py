"""The comparison with SUMO: table, picture, and speed of simulation."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.bench import traffic_speed
from cavmarl.bench.traffic_speed import measure_traffic_speed
from cavmarl.cli import main
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.traffic import sumo_side
from cavmarl.evaluate.traffic.native_side import make_world
from cavmarl.evaluate.traffic.sumo_side import SumoJob
from cavmarl.evaluate.traffic.traffic_comparison import RATIOS, TrafficComparison, compare_traffic
from cavmarl.evaluate.traffic.traffic_metrics import EDGE_MINUTE, TrafficFigures, TrafficRun
from cavmarl.evaluate.traffic.traffic_plot import binned_means, plot_fundamental_diagram
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netgenerate

sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

GAME = Path(sumo.SUMO_HOME) / "tools" / "game"
MAP = GAME / "kuehne" / "kuehne.net.xml"
ROUTES = GAME / "kuehne" / "kuehne.rou.xml"
WORDS = ("bench", "traffic", str(MAP), "--demand", str(ROUTES))


def run(*words: str) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def side(arrived: int, mean_speed_mps: float | None) -> TrafficRun:
    figures = TrafficFigures(9, 0, arrived, mean_speed_mps, None, 2.0, 0, 0.0, "", 0)
    points = np.zeros(40, EDGE_MINUTE)
    points["length_m"] = 80.0
    points["density_per_km"] = np.linspace(1.0, 30.0, 40)
    points["flow_per_h"] = 600.0
    points["speed_mps"] = 9.0
    return TrafficRun(figures, {}, points)


def comparison(ours: TrafficRun, theirs: TrafficRun) -> TrafficComparison:
    return TrafficComparison("town", 900, 0.1, 1, ours, theirs, ("a", "b"))


def test_a_ratio_divides_cavmarls_figure_by_sumos_figure_if_both_are_defined() -> None:
    found = comparison(side(6, 3.0), side(8, None))
    assert found.ratio("arrived") == 0.75
    assert found.ratio("mean_speed_mps") is None
    assert found.ratio("waiting") is None
    assert found.ratio("contacts") is None


def test_the_command_prints_the_table_and_writes_both_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    picture, document = tmp_path / "fd.png", tmp_path / "out.json"
    words = ("--seconds", "20", "--dt", "0.2", "--plot", str(picture), "--json", str(document))
    assert run(*WORDS, *words) == 0
    shown = capsys.readouterr().out
    for label in ("departed", "waiting", "arrived", "mean speed", "mean delay", "queue"):
        assert label in shown
    assert picture.read_bytes().startswith(b"\x89PNG")
    written = json.loads(document.read_text())
    assert written["sumo"]["figures"]["departed"] > 0
    assert set(written["ratios"]) == set(RATIOS)
    edges = set(read_network(MAP).edge_ids)
    for side in ("ours", "sumo"):
        assert set(written[side]["edge_minutes"]["edge"]) <= edges


def test_the_world_has_the_signal_programs_of_the_demand() -> None:
    roads = GAME / "cross" / "cross.net.xml"
    plain = read_network(roads)
    world = make_world(roads, [GAME / "cross_demo.sumocfg"], 10, 0, 0.1)
    assert set(world.network.program_ids) > set(plain.program_ids)
    on = world.network.signals["program"][0]
    assert world.network.program_ids[on] not in plain.program_ids


def test_the_speeds_of_cavmarl_and_sumo_are_measured() -> None:
    found = measure_traffic_speed(MAP, [ROUTES], dt_s=0.2, after_s=10, repeats=2)
    for rates in (found.ours, found.sumo):
        assert 0.0 < rates.low <= rates.median <= rates.high
    assert found.sumo_vehicles > 1.0


class StillSumo:
    """A fake libsumo with seven vehicles that never move; `words` are its start options."""

    TraCIException = RuntimeError

    def __init__(self) -> None:
        self.words: list[str] = []
        self.steps = 0
        self.vehicle = SimpleNamespace(getIDCount=lambda: 7)

    def start(self, words: list[str]) -> None:
        self.words = words

    def simulationStep(self) -> None:
        self.steps += 1


@pytest.fixture
def still(monkeypatch: pytest.MonkeyPatch) -> StillSumo:
    """Replace SUMO by a fake in this process, and return the fake."""
    found = StillSumo()

    @contextmanager
    def here(_: SumoJob) -> Iterator[Any]:
        yield SimpleNamespace(
            submit=lambda work, *given: SimpleNamespace(result=lambda: work(*given))
        )

    monkeypatch.setattr(sumo_side, "free_libsumo", lambda: found)
    monkeypatch.setattr(traffic_speed, "require", lambda *_: found)
    monkeypatch.setattr(traffic_speed, "sumo_process", here)
    return found


def test_cavmarl_and_sumo_run_the_same_demand_for_equal_times_and_write_nothing(
    still: StillSumo, monkeypatch: pytest.MonkeyPatch
) -> None:
    worlds: list[Simulation] = []
    given: list[Any] = []

    def noted(*made_of: Any) -> Simulation:
        given.extend(made_of)
        worlds.append(make_world(*made_of))
        return worlds[-1]

    monkeypatch.setattr(traffic_speed, "make_world", noted)
    found = measure_traffic_speed(MAP, [ROUTES], dt_s=0.2, seed=4, after_s=10, repeats=2)
    options = dict(word.removeprefix("--").split("=", 1) for word in still.words[1:])
    assert (options["net-file"], options["route-files"]) == (str(given[0]), str(given[1][0]))
    assert (float(options["step-length"]), int(options["seed"])) == (given[4], given[3])
    assert (given[4], given[3], given[2]) == (0.2, 4, 30)
    assert [name for name in options if re.search("output|log|dump", name)] == [
        "no-step-log", "duration-log.disable", "error-log",
    ]  # fmt: skip
    assert still.steps == worlds[0].ticks()[0] == 150
    assert worlds[0].config.clock.sim_dt_s == worlds[0].config.clock.ctrl_dt_s == 0.2
    assert found.sumo_vehicles == 7.0


def test_cavmarl_and_sumo_count_each_vehicle_once_per_step(still: StillSumo) -> None:
    moved: list[None] = []
    world: Any = SimpleNamespace(
        outputs=SimpleNamespace(present=np.zeros((1, 2))),
        step=lambda _: moved.append(None),
        vehicles=lambda: [None] * 7,
    )
    ours, theirs = traffic_speed.our_turn(world, 4), traffic_speed.turn_of_sumo(4)
    assert ours.vehicle_steps == theirs.vehicle_steps == 28
    assert len(moved) == still.steps == 4


@pytest.mark.parametrize(
    ("wrong", "says"),
    [({"seconds": 0}, "seconds = 0"), ({"dt_s": 0.3}, "dt = 0.3"), ({"dt_s": 0.0}, "dt = 0")],
)
def test_numbers_out_of_range_are_refused(wrong: dict[str, float], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        compare_traffic(MAP, [ROUTES], **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("bench", "traffic", "nowhere", "-d", str(ROUTES)), "nowhere"),
        (("bench", "traffic", str(MAP), "-d", "none.rou.xml"), "none.rou.xml: cannot be read"),
        (
            ("bench", "traffic", str(GAME / "cross" / "cross.net.xml"), "-d", str(ROUTES)),
            "use files that were made for this map",
        ),
        ((*WORDS, "--speed", "--plot", "x.png"), "--plot"),
        ((*WORDS, "--speed", "--after", "0"), "after = 0"),
    ],
)
def test_bad_input_is_reported_without_a_traceback(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], says: str
) -> None:
    assert run(*words) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert says in said
    assert "Traceback" not in said


def test_binned_means_average_the_values_of_a_bin() -> None:
    density = np.array([1.0, 3.0, 2.0, 5.0, 4.0, 11.0])
    means = binned_means(density, np.array([1.0, 1.0, 1.0, 1.0, 6.0, 100.0]))
    assert means[0].tolist() == [3.0]
    assert means[1].tolist() == [2.0]


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    found = comparison(side(6, 3.0), side(8, 3.0))
    for name in ("gone/fd.png", "fd.xyz"):
        with pytest.raises(ConfigError, match="cannot be written"):
            plot_fundamental_diagram(found, tmp_path / name)


def test_cavmarl_and_sumo_drive_the_same_demand(tmp_path: Path) -> None:
    """cavmarl does not read persons, nor bicycles on their own lanes; SUMO's figures omit them."""
    words = ("--grid", "--grid.number", "3", "--grid.length", "100", "--sidewalks.guess")
    network = netgenerate(tmp_path / "bikes.net.xml", *words, "--bikelanes.guess")
    demand = tmp_path / "mixed.rou.xml"
    demand.write_text(
        '<routes><vType id="bike" vClass="bicycle"/>'
        '<route id="r" edges="A0A1 A1A2"/>'
        '<flow id="cars" route="r" begin="0" end="40" number="5"/>'
        '<flow id="bikes" type="bike" route="r" begin="0" end="40" number="7"/>'
        '<person id="p" depart="1"><walk edges="A0A1 A1A2"/></person></routes>'
    )
    found = compare_traffic(network, [demand], seconds=90)
    assert found.ours.figures.departed == found.sumo.figures.departed == 5
    assert found.ours.figures.arrived == found.sumo.figures.arrived == 5
    assert found.sumo.figures.waiting == 0
