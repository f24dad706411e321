"""Runs of SUMO for comparisons, on small maps of SUMO."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, MissingExtraError
from cavmarl.evaluate.traffic.sumo_side import (
    SumoJob,
    VehicleReader,
    run_seeds,
    start_sumo,
    sumo_process,
)
from cavmarl.evaluate.traffic.traffic_metrics import TrafficRun
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.sumo.sumo_input import SumoInput, read_input, without_outputs

sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

GAME = Path(sumo.SUMO_HOME) / "tools" / "game"
MAP = GAME / "kuehne" / "kuehne.net.xml"
ROUTES = GAME / "kuehne" / "kuehne.rou.xml"


def job(demand: SumoInput, map_file: Path = MAP, seconds: int = 60, seed: int = 1) -> SumoJob:
    return SumoJob(map_file, demand, seconds, dt_s=0.5, seed=seed)


def run_sumo(job: SumoJob) -> TrafficRun:
    return run_seeds(job, ())[0]


def one_car(tmp_path: Path) -> SumoInput:
    """Write a demand of one car that departs in the first second, at its maximum speed."""
    path = tmp_path / "one.rou.xml"
    path.write_text(
        '<routes><vType id="steady" sigma="0" speedDev="0" length="4"/>'
        '<vehicle id="a" type="steady" depart="0" departSpeed="max">'
        '<route edges="left0A0 A0B0 B0right0"/></vehicle></routes>'
    )
    return read_input([path])


@pytest.mark.usefixtures("fresh_processes")
def test_a_run_of_sumo_has_counts_and_metrics() -> None:
    run = run_sumo(job(read_input([ROUTES]), seconds=120))
    figures = run.figures
    # From second 0 on, one flow has a vehicle every 2 s, the other flow one every 4 s.
    assert figures.departed + figures.waiting == 90
    assert 0 < figures.arrived < figures.departed
    assert figures.mean_speed_mps is not None
    assert 3.0 < figures.mean_speed_mps < 13.0
    assert figures.mean_delay_s is not None
    assert figures.mean_delay_s > 0.0
    assert figures.queue > 0.0
    assert figures.teleports == 0
    assert set(np.unique(run.edge_minutes["minute"])) == {0, 1}


def test_equal_seeds_give_equal_runs() -> None:
    demand = read_input([ROUTES])
    first, second, other = (run_sumo(job(demand, seed=seed)).figures for seed in (1, 1, 2))
    assert first == second
    assert first != other


def test_a_single_car_is_counted_and_passes_three_edges(tmp_path: Path) -> None:
    run = run_sumo(job(one_car(tmp_path), seconds=180))
    figures = run.figures
    assert (figures.departed, figures.waiting, figures.arrived) == (1, 0, 1)
    assert (figures.contacts, figures.teleports) == (0, 0)
    assert len(set(run.edge_minutes["edge"].tolist())) == 3


def test_sumo_does_not_teleport_vehicles_if_teleports_are_off() -> None:
    cross = read_input([GAME / "cross.sumocfg"])
    # The signals of this map wait for a player, so vehicles wait long enough to be teleported.
    eager = SumoInput(cross.route_files, cross.additional_files, options={"time-to-teleport": "20"})
    moved, stuck = (
        SumoJob(GAME / "cross" / "cross.net.xml", eager, 120, 0.5, 1, teleports)
        for teleports in (True, False)
    )
    assert run_sumo(moved).figures.teleports > 0
    assert run_sumo(stuck).figures.teleports == 0


def test_demand_of_another_map_is_refused_with_sumos_message() -> None:
    with pytest.raises(ConfigError, match=r"cross\.net\.xml: SUMO refuses this demand: .*edge"):
        run_sumo(job(read_input([ROUTES]), GAME / "cross" / "cross.net.xml"))


def test_a_refusal_names_the_map_of_a_configuration() -> None:
    with pytest.raises(ConfigError, match=r"the map of this demand, .*cross\.net\.xml"):
        run_sumo(job(read_input([GAME / "cross_demo.sumocfg"])))


def test_the_error_without_sumo_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    demand = read_input([ROUTES])

    def absent(module: str) -> None:
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("cavmarl.core.errors.importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[sumo\]'"):
        run_sumo(job(demand))


def test_a_configuration_gives_the_files_the_begin_and_the_options() -> None:
    found = read_input([GAME / "fokr_bs_demo.sumocfg"])
    assert found.net_file == GAME / "fokr_bs_demo" / "fokr_bs.net.xml.gz"
    assert [path.name for path in found.additional_files] == [
        "vtypes_default.add.xml",
        "signalPlan.add.xml",
    ]
    assert len(found.route_files) == 3
    assert found.begin_s == 15 * 3600.0
    assert "pedestrian.striping.stripe-width" in found.options
    assert found.options["end"] == "16:0:0"
    assert not {"step-length", "gui-settings-file", "demo"} & found.options.keys()
    (ignored,) = found.tolerated
    assert "option step-length = 0.05 is not used" in ignored


def test_files_are_sorted_by_their_content(tmp_path: Path) -> None:
    routes, types = tmp_path / "a.xml", tmp_path / "b.xml.gz"
    routes.write_text("<!-- first --><routes/>")
    types.write_bytes(gzip.compress(b"<additional/>"))
    found = read_input([types, routes])
    assert found == SumoInput((routes,), (types,))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<routes", "line 1: broken XML"),
        ("<net/>", "<net> is not demand"),
        ("<!DOCTYPE a><routes/>", "document type"),
    ],
)
def test_files_without_demand_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "wrong.rou.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        read_input([path])


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no demand"):
        read_input([])
    with pytest.raises(ConfigError, match=r"none\.rou\.xml: cannot be read"):
        read_input([tmp_path / "none.rou.xml"])
    config = tmp_path / "run.sumocfg"
    config.write_text(
        '<configuration><input><net-file value="gone.net.xml"/></input></configuration>'
    )
    with pytest.raises(ConfigError, match=r"run\.sumocfg, line 1: .*gone\.net\.xml"):
        read_input([config])


def test_files_that_detectors_would_write_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "detectors.add.xml"
    path.write_text(
        '<additional><vType id="a"/>\n<e1Detector id="d" lane="x" file="out.xml" freq="60"/>'
        '<rerouter id="r" edges="x" file="in.xml"/></additional>'
    )
    copies = tmp_path / "copies"
    copies.mkdir()
    written = without_outputs(path, copies).read_text()
    assert 'file="NUL"' in written
    assert "out.xml" not in written
    assert f'file="{tmp_path / "in.xml"}"' in written, "the copy does not refer to the input file"
    path.write_text("<additional/>")
    assert without_outputs(path, copies) == path


def test_positions_are_converted_from_front_bumpers_and_headings_from_compass_angles(
    tmp_path: Path,
) -> None:
    """The car drives east, so its heading is 0, and its centre is 2 m west of its front."""
    with sumo_process(job(one_car(tmp_path))) as process:
        x, y, heading, length, front = process.submit(
            _first_place, job(one_car(tmp_path)), tmp_path
        ).result()
    assert heading == pytest.approx(0.0, abs=1e-6)
    assert length == 4.0
    assert (x, y) == pytest.approx((front[0] - 2.0, front[1]))


def _first_place(
    given: SumoJob, folder: Path
) -> tuple[float, float, float, float, tuple[float, float]]:
    libsumo = start_sumo(given, folder)
    libsumo.simulationStep()
    row = VehicleReader(libsumo, read_network(given.map_file)).rows()[0]
    front = libsumo.vehicle.getPosition("a")
    return row["x"], row["y"], row["heading"], row["length"], front
