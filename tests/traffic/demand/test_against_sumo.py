"""Demand as SUMO reads it: defaults of types, times of flows, whole scenarios."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cavmarl.driving.vehicle_types import CLASS_DEFAULTS
from cavmarl.roads.sumo_net.sumo_options import map_of_config
from cavmarl.traffic.demand import DemandFile, read_demand
from cavmarl.traffic.demand.element import DemandReport, Element
from cavmarl.traffic.demand.type_table import vtype_record
from tests.support.kept_maps import network_of
from tests.traffic.demand.conftest import Reader, sumo_binary

VEHICLE = re.compile(
    r'<vehicle id="([^"]*)"[^>]*? depart="([^"]*)".*?<route [^>]*?edges="([^"]*)"', re.DOTALL
)
Way = tuple[float, str]

# Attributes that each type sets; SUMO's defaults apply to its other attributes.
TYPES = {f"class_{name}": {"vClass": name} for name in CLASS_DEFAULTS} | {
    "factor": {"speedFactor": "1.2"},
    "factor_dev": {"speedFactor": "normc(1,0.1,0.2,2)", "speedDev": "0.3"},
    "normal": {"speedFactor": "norm(1.1,0.2)"},
    "bus_factor": {"vClass": "bus", "speedFactor": "1.1"},
    "certain": {"speedDev": "0"},
    "hard": {"vClass": "bus", "decel": "8"},
    "soft": {"decel": "2"},
    "given": {"length": "7", "width": "2", "height": "3", "minGap": "1", "tau": "2", "sigma": "0"},
}


def sumo(folder: Path, *arguments: str | Path) -> dict[str, Way]:
    """Run SUMO and return the departure time and the edges of each vehicle."""
    command = [
        sumo_binary("sumo"),
        *arguments,
        "--no-step-log",
        "--no-warnings",
        "--precision",
        "3",
    ]
    command += ["--vehroute-output", "out.xml", "--vehroute-output.intended-depart"]
    command += ["--vehroute-output.write-unfinished", "--time-to-teleport", "5"]
    subprocess.run([str(part) for part in command], cwd=folder, check=True, capture_output=True)
    text = (folder / "out.xml").read_text(encoding="utf-8")
    return {m[1]: (float(m[2]), m[3]) for m in VEHICLE.finditer(text)}


def ours(file: DemandFile) -> dict[str, Way]:
    found = {}
    for order in file.draw(0):
        route = file.routes[order["route"]]
        edges = file.route_edges[route["first_edge"] :][: route["num_edges"]]
        names = " ".join(file.network.edge_ids[edge] for edge in edges)
        found[file.vehicle_id(order)] = (float(order["depart"]), names)
    return found


def test_types_have_sumos_values(tmp_path: Path, town_file: Path) -> None:
    libsumo = pytest.importorskip("libsumo", reason="needs SUMO's library")
    lines = (
        "<vType "
        + " ".join(f'{key}="{value}"' for key, value in {"id": name, **attrs}.items())
        + "/>"
        for name, attrs in TYPES.items()
    )
    path = tmp_path / "t.add.xml"
    path.write_text(f"<additional>{''.join(lines)}</additional>", encoding="utf-8")
    libsumo.start(["sumo", "-n", str(town_file), "-a", str(path), "--no-step-log"])
    kinds = libsumo.vehicletype
    try:
        for name, attrs in TYPES.items():
            record = vtype_record(Element("vType", {"id": name, **attrs}, "", 0), DemandReport())
            assert record is not None
            theirs = (
                kinds.getLength(name),
                kinds.getWidth(name),
                kinds.getHeight(name),
                kinds.getMinGap(name),
                kinds.getAccel(name),
                kinds.getDecel(name),
                kinds.getEmergencyDecel(name),
                kinds.getMaxSpeed(name),
                kinds.getTau(name),
                kinds.getImperfection(name),
                kinds.getSpeedFactor(name),
                kinds.getSpeedDeviation(name),
            )
            fields = "length width height min_gap accel decel emergency_decel max_speed tau sigma"
            mine = [record[field] for field in (*fields.split(), "speed_factor", "speed_dev")]
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, err_msg=name)
    finally:
        libsumo.close()


@pytest.mark.parametrize(
    "timing",
    [
        'begin="0" end="20" number="6"', 'begin="1.5" end="21.7" number="7"',
        'begin="0" end="30" period="7"', 'begin="0" end="28" period="7"',
        'begin="0" end="50" vehsPerHour="700"', 'begin="3" number="4" period="5"',
        'begin="0" end="30" perHour="360"', 'begin="0:00:10" end="0:0:20" period="4"',
        'begin="10" end="10" number="3"', 'begin="10" end="10" period="3"',
        'begin="0" end="10" number="0"', 'begin="0.2" end="9.7" probability="1"',
        'begin="5" number="3" probability="1"', 'end="9" period="0.4"',
    ],
)  # fmt: skip
def test_flows_depart_at_sumos_times(
    demand: Reader, tmp_path: Path, town_file: Path, timing: str
) -> None:
    body = f'<flow id="f" {timing}><route edges="AB BC"/></flow>'
    file = demand(body)
    theirs = sumo(tmp_path, "-n", town_file, "-r", "x.rou.xml", "--end", "2000")
    assert ours(file) == theirs


def test_bologna_is_read_as_sumo_reads_it(shared_maps: Path, tmp_path: Path) -> None:
    folder = tmp_path / "acosta"
    folder.mkdir()
    # Copy the folder, because detectors write their output into the folder of their file.
    for path in (shared_maps / "net/bologna_acosta").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    network = network_of(folder / "acosta_buslanes.net.xml")
    file = read_demand([folder / "run.sumocfg"], network)
    theirs = sumo(folder, "-c", "run.sumocfg", "--end", "5000")
    assert len(theirs) == 8779
    assert ours(file) == theirs


GAMES = ("A10KW", "bs3d", "corridor", "cross", "DRT", "fkk_in", "fokr_bs_demo", "grid6", "ramp")


@pytest.mark.parametrize("game", [*GAMES, "square"])
def test_scenarios_of_the_wheel_are_read(game: str) -> None:
    config = Path(sumo_binary("sumo")).parents[1] / f"tools/game/{game}.sumocfg"
    if not config.exists():
        pytest.skip(f"this version of SUMO has no {game}")
    file = read_demand([config], network_of(map_of_config(config)))
    orders = file.draw(1)
    assert len(orders) > 0
    assert np.all(np.diff(orders["depart"]) >= 0.0)


@pytest.mark.parametrize("name", ["town10hd_25", "town10hd_50", "town10hd_100"])
def test_town10_is_read(shared_maps: Path, name: str) -> None:
    network = network_of(shared_maps / "net/Town10HD.net.xml")
    file = read_demand([shared_maps / f"demand/{name}.rou.xml"], network)
    assert len(file.draw(0)) == int(name.rpartition("_")[2])


def test_mcity_is_read_without_its_cycle_lanes(shared_maps: Path) -> None:
    folder = shared_maps / "net/mcity"
    paths = [folder / "mcity.rou.xml", folder / "mcity.add.xml"]
    file = read_demand(paths, network_of(folder / "mcity.net.xml"))
    assert len(file.elements) == 23
    assert len(file.draw(0, until_s=3600.0)) > 2000
    assert file.report.tolerated["<personFlow> is not read"].count == 7
    left_out = "type 'bike' has no route: maps lack lanes of its class"
    assert file.report.tolerated[left_out].count == 1
