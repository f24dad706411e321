"""Options of a configuration: effects on vehicles, and reports about ignored options."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import defusedxml.ElementTree
import numpy as np
import pytest

from cavmarl.core.errors import CapacityError, DemandError, RouteError
from cavmarl.core.records.codes import MODEL_IDM, MODEL_KRAUSS
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import DemandFile, read_demand
from cavmarl.traffic.sumo.sumo_input import begun, read_input
from tests.traffic.demand.conftest import sumo_binary

CARS = "".join(
    f'<vehicle id="v{k}" depart="{3 * k}"><route edges="AB BC"/></vehicle>' for k in range(10)
)
FLOW = '<flow id="f" begin="0" end="60" number="7" from="AB" to="BC"/>'
FLOWS = {
    "vehicles": CARS,
    "number": FLOW,
    "period": FLOW.replace('number="7"', 'period="9"'),
    "rate": FLOW.replace('number="7"', 'vehsPerHour="400"'),
    "number and period": FLOW.replace('end="60"', 'period="9"'),
}
READ = '<net-file value="town.net.xml"/><route-files value="x.rou.xml"/>'

Read = Callable[..., DemandFile]


@pytest.fixture
def read(town_file: Path, town: RoadNetwork, tmp_path: Path) -> Read:
    """Return a function that reads a configuration with the given options and demand."""
    (tmp_path / "town.net.xml").write_bytes(town_file.read_bytes())

    def configured(options: str, demand: str = CARS, **keys: object) -> DemandFile:
        (tmp_path / "x.rou.xml").write_text(f"<routes>{demand}</routes>", encoding="utf-8")
        path = tmp_path / "x.cfg"
        path.write_text(f"<configuration>{READ}\n{options}</configuration>", encoding="utf-8")
        return read_demand([path], town, **keys)  # type: ignore[arg-type]

    return configured


def departures(file: DemandFile) -> set[tuple[str, float]]:
    return {(file.vehicle_id(order), float(order["depart"])) for order in file.draw(0)}


def departures_of_sumo(folder: Path) -> set[tuple[str, float]]:
    words = [sumo_binary("sumo"), "-c", "x.cfg", "--vehroute-output", "o.xml", "--precision", "3",
             "--vehroute-output.intended-depart", "--xml-validation", "never"]  # fmt: skip
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    root = defusedxml.ElementTree.parse(folder / "o.xml").getroot()
    return {(v.attrib["id"], float(v.attrib["depart"])) for v in root.iter("vehicle")}


@pytest.mark.parametrize("scale", ["0", "0.3", "0.5", "1.0", "2", "3.0"])
@pytest.mark.parametrize("demand", FLOWS)
def test_a_scale_multiplies_departures_as_in_sumo(
    read: Read, tmp_path: Path, scale: str, demand: str
) -> None:
    file = read(f'<scale value="{scale}"/>', FLOWS[demand])
    assert departures(file) == departures_of_sumo(tmp_path)
    assert not file.report.tolerated


@pytest.mark.parametrize(("chance", "scale", "low", "high"), [
    ('probability="0.5"', "2", 900, 1100), ('probability="0.5"', "1.5", 675, 825),
    ('period="exp(0.5)"', "2", 900, 1100), ('period="exp(0.5)"', "0.5", 190, 310),
])  # fmt: skip
def test_a_scale_multiplies_random_flows(
    read: Read, chance: str, scale: str, low: int, high: int
) -> None:
    flow = FLOW.replace('number="7"', chance).replace('end="60"', 'end="1000"')
    orders = read(f'<scale value="{scale}"/>', flow).draw(5)
    assert low < len(orders) < high
    assert np.unique(orders["number"]).tolist() == list(range(len(orders)))


def test_copies_of_a_vehicle_have_different_numbers(read: Read) -> None:
    orders = read('<scale value="100"/>', '<vType id="t" speedDev="0.1"/>' + FLOW).draw(3)
    assert len(orders) == 700
    assert np.unique(orders["number"]).size == 700


def test_a_scale_changes_the_hash_and_the_number_of_departures(read: Read) -> None:
    plain = read("").content_hash
    assert read('<scale value="1"/>').content_hash == plain
    assert read('<scale value="2"/>').content_hash != plain
    with pytest.raises(CapacityError, match="more than 15 departures"):
        read('<scale value="2"/>', max_departures=15)
    with pytest.raises(DemandError, match=r"x\.cfg, line 2.*must be at least 0"):
        read('<scale value="-1"/>')


def test_types_get_the_model_and_the_speed_deviation_of_the_configuration(read: Read) -> None:
    types = (
        '<vType id="own" carFollowModel="Krauss" speedDev="0.3"/>'
        '<vType id="drawn" speedFactor="normc(1,0.2,0.5,1.5)"/><vType id="plain"/>'
    )
    options = '<carfollow.model value="IDM"/><default.speeddev value="0"/>'
    file = read(options, types + CARS)
    found = dict(zip(file.type_ids, file.types, strict=True))
    assert found["own"]["model"] == MODEL_KRAUSS
    assert [found[name]["model"] for name in ("drawn", "plain")] == [MODEL_IDM] * 2
    assert [float(found[name]["speed_dev"]) for name in ("own", "drawn", "plain")] == [0.3, 0.2, 0]
    assert found["DEFAULT_VEHTYPE"]["model"] == MODEL_IDM
    assert not file.report.tolerated


def test_bad_routes_are_left_out_if_the_configuration_ignores_them(read: Read) -> None:
    bad = CARS + '<vehicle id="b" depart="50"><route edges="AB BX"/></vehicle>'
    assert len(read('<ignore-route-errors value="true"/>', bad).draw(0)) == 10
    with pytest.raises(RouteError):
        read('<ignore-route-errors value="false"/>', bad)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ('<max-num-vehicles value="3"/>', "option max-num-vehicles = 3 is not modelled"),
        ('<step-length value="0.5"/>', "option step-length = 0.5 is not used; a tick lasts"),
        ('<time-to-teleport value="300"/>', "option time-to-teleport = 300 is not modelled"),
        ('<seed value="5"/>', "option seed = 5 is not used; the world's own seed is used instead"),
        ('<load-state value="s.xml"/>', "option load-state = s.xml is not read"),
        ('<with-taz value="true"/>', "option device.rerouting.with-taz = true is not modelled"),
        ('<default.emergencydecel value="9"/>', "option default.emergencydecel = 9 is not"),
        ('<max-depart-delay value="10"/>', "option max-depart-delay = 10 is not modelled"),
    ],
)
def test_ignored_options_that_change_traffic_are_reported(
    read: Read, option: str, words: str
) -> None:
    ((what, tally),) = read(option).report.tolerated.items()
    assert what.startswith(words)
    assert (tally.count, tally.first.endswith("x.cfg, line 2")) == (1, True)


@pytest.mark.parametrize(
    "option",
    [
        '<time-to-teleport value="-1"/>',
        '<time-to-teleport value="0"/>',
        '<max-num-vehicles value="-1"/>',
        '<tripinfo-output value="o.xml"/><X value="never"/><gui-settings-file value="g"/>',
        '<pedestrian.model value="jupedsim"/><threads value="4"/>',
    ],
)
def test_options_without_effect_on_traffic_are_ignored(read: Read, option: str) -> None:
    assert not read(option).report.tolerated


def test_two_configurations_are_refused(read: Read, town: RoadNetwork, tmp_path: Path) -> None:
    read("")
    with pytest.raises(DemandError, match="a second SUMO configuration"):
        read_demand([tmp_path / "x.cfg", tmp_path / "x.cfg"], town)


LATE = '<flow id="f" begin="25200" end="25260" number="6" from="AB" to="BC"/>'


def test_a_demand_without_early_departures_begins_with_its_first_departure(read: Read) -> None:
    file = read("", LATE).begun(60.0)
    assert (file.begin_ms, len(file.draw(0, 25260.0))) == (25_200_000, 6)
    ((what, tally),) = file.report.tolerated.items()
    assert what == "the demand begins at 25200 s, as no vehicle departs from 0 s to 60 s"
    assert tally.first.endswith("x.rou.xml, line 1")
    assert read("", LATE).begun(25300.0).begin_ms == 0, "a vehicle departs within the horizon"
    random = LATE.replace('number="6"', 'period="exp(0.1)"')
    assert read("", random).begun(60.0).begin_ms == 25_200_000


@pytest.mark.parametrize("option", ['<begin value="0"/>', '<end value="60"/>'])
def test_a_demand_without_departures_is_reported(read: Read, option: str) -> None:
    file = read(option, LATE).begun(60.0)
    assert file.begin_ms == 0
    (what,) = file.report.tolerated
    assert what.startswith("no vehicle departs from 0 s to 60 s, only from 25200 s: change")


def test_a_begin_of_the_configuration_is_kept(read: Read) -> None:
    file = read('<begin value="7:0:10"/>', LATE).begun(60.0)
    assert file.begin_ms == 25_210_000
    assert not file.report.tolerated


@pytest.mark.parametrize(
    ("option", "begin_s", "words"),
    [
        ("", 25_200.0, "the demand begins at 25200 s, as no vehicle"),
        ('<begin value="0"/>', 0.0, "no vehicle departs from 0 s to 60 s, only from 25200 s"),
        ('<begin value="25190"/>', 25_190.0, None),
    ],
)
def test_a_coupled_sumo_begins_with_the_first_departure(
    read: Read, tmp_path: Path, option: str, begin_s: float, words: str | None
) -> None:
    read(option, LATE)
    given = begun(read_input([tmp_path / "x.cfg"]), 60.0)
    assert given.begin_s == begin_s
    assert [words in line for line in given.tolerated if words] == ([True] if words else [])
    assert words or not given.tolerated
