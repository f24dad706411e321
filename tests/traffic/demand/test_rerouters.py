"""Reading <rerouter> and the rerouting device: parts are used, refused, or ignored and counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import CapacityError, DemandError
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.traffic.demand import DemandFile, read_demand
from cavmarl.traffic.demand import rerouters as reading
from cavmarl.traffic.demand.rerouters import KEEP_DESTINATION
from cavmarl.traffic.demand.rerouting_device import DeviceOptions
from tests.traffic.demand.conftest import Reader

KEY = 7
CAR = '<vehicle id="a" depart="0"><route edges="AB BC"/></vehicle>'
BUS = 1 << VEHICLE_CLASSES.index("bus")


def rerouter(inside: str, attrs: str = 'edges="AB"', span: str = 'begin="10" end="20"') -> str:
    return f'{CAR}<rerouter id="r" {attrs}><interval {span}>{inside}</interval></rerouter>'


def test_rules_of_rerouters_have_an_edge_a_time_and_vehicles(demand: Reader) -> None:
    file = demand(
        '<vType id="x"/><vType id="y"/><route id="q" edges="XB BC"/>'
        + CAR
        + '<rerouter id="r" edges="AB XB" probability="0.25" vTypes="y">'
        '<interval begin="0:01:00" end="90"><closingReroute id="BC" disallow="bus"/>'
        '<destProbReroute id="BA" probability="3"/><destProbReroute id="keepDestination"/>'
        '</interval><interval><routeProbReroute id="q"/></interval></rerouter>'
    )
    names = file.network.edge_ids
    rules, closings = file.rerouters.rules, file.rerouters.closings
    assert [names[edge] for edge in rules["edge"]] == ["AB", "XB", "AB", "XB"]
    assert rules["begin_s"].tolist() == [60.0, 60.0, 0.0, 0.0]
    assert rules["end_s"][:2].tolist() == [90.0, 90.0]
    assert rules["end_s"][2] > 1e9
    assert rules["chance"].tolist() == [0.25] * 4
    assert rules["closes"].tolist() == [True, True, False, False]
    assert rules["interval"].tolist() == [0, 0, 1, 1]
    of_y = [file.type_ids[k] for k in np.flatnonzero(file.rerouters.types[0])]
    assert of_y == ["y"]
    assert names[closings["edge"][0]] == "BC"
    assert closings["classes"].tolist() == [BUS]
    goals = file.rerouters.goals.options(rules["goals"][0])
    assert [names[goals[0]], goals[1]] == ["BA", KEEP_DESTINATION]
    picked = file.rerouters.goals.pick(np.zeros(4, np.int32), np.array([0.0, 0.7, 0.8, 0.99]))
    assert (picked == KEEP_DESTINATION).tolist() == [False, False, True, True]
    (route,) = file.rerouters.routes.options(rules["routes"][2])
    assert file.route_ids[route] == "q"
    assert rules["goals"][2] == rules["routes"][0] == -1


@pytest.mark.parametrize(
    ("attrs", "classes"),
    [
        ("", (1 << 32) - 1),
        ('allow="bus"', ((1 << 32) - 1) & ~BUS),
        ('disallow="coach rail"', BUS),
        ('allow="all"', 0),
        ('disallow="all"', (1 << 32) - 1),
    ],
)
def test_a_closing_applies_to_vehicle_classes(demand: Reader, attrs: str, classes: int) -> None:
    file = demand(rerouter(f'<closingReroute id="BC" {attrs}/>'))
    assert file.rerouters.closings["classes"].tolist() == [classes]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (rerouter("", 'edges="AB BCC"'), ["BCC", "similar names: BC"]),
        (rerouter("", ""), ["no edges"]),
        (rerouter("", 'edges="AB" probability="1.5"'), ["probability='1.5'", "at most 1"]),
        (rerouter("", 'edges="AB" probability="-1"'), ["probability='-1'"]),
        (rerouter("", 'edges="AB" vTypes="lorry"'), ["unknown type 'lorry'"]),
        (rerouter("", span='begin="9" end="5"'), ["ends before it begins"]),
        (rerouter("", span='begin="-9" end="5"'), ["negative time"]),
        (rerouter('<closingReroute id="DE"/>'), ["DE"]),
        (rerouter("<closingReroute/>"), ["no id"]),
        (rerouter('<closingReroute id="BC" allow="bus" disallow="bus"/>'), ["keep only one"]),
        (rerouter('<closingReroute id="BC" allow="buss"/>'), ["unknown class", "bus"]),
        (rerouter('<destProbReroute id="DE"/>'), ["DE"]),
        (rerouter('<destProbReroute id="BC" probability="0"/>'), ["nothing to choose from"]),
        (rerouter('<destProbReroute id="BC" probability="-2"/>'), ["probability='-2'"]),
        (rerouter('<routeProbReroute id="q"/>'), ["unknown route 'q'"]),
        (rerouter("") + '<rerouter id="r" edges="AB"/>', ["unique"]),
    ],
)
def test_invalid_rerouters_are_refused(demand: Reader, body: str, words: list[str]) -> None:
    with pytest.raises(DemandError) as caught:
        demand(body)
    assert "x.rou.xml, line 2" in str(caught.value)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("limit", ["MAX_INTERVALS", "MAX_RULES"])
def test_too_many_rules_are_refused(
    demand: Reader, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setattr(reading, limit, 1)
    closing = '<interval begin="0" end="1"><closingReroute id="BC"/></interval>'
    demand(f'{CAR}<rerouter id="r" edges="AB">{closing}</rerouter>')
    with pytest.raises(CapacityError, match=r"line 2.*use fewer"):
        demand(f'{CAR}<rerouter id="r" edges="AB">{closing * 2}</rerouter>')


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (rerouter('<closingLaneReroute id="BC_0"/>'), "<closingLaneReroute>"),
        (rerouter('<parkingAreaReroute id="p"/>'), "<parkingAreaReroute>"),
        (rerouter('<viaProbReroute id="BC"/>'), "<viaProbReroute>"),
        (rerouter('<destProbReroute id="terminateRoute"/>'), "terminateRoute"),
        (rerouter("", 'edges="AB" timeThreshold="9"'), "timeThreshold"),
        (rerouter("", 'edges="AB" file="in.xml"'), "file"),
    ],
)
def test_ignored_parts_are_counted(demand: Reader, body: str, said: str) -> None:
    file = demand(body)
    (what,) = file.report.tolerated
    assert said in what
    assert not file.rerouters.closings.size


def test_rerouters_are_part_of_the_content_hash(demand: Reader) -> None:
    hashes = {
        demand(rerouter(inside)).content_hash
        for inside in (
            "", '<closingReroute id="BC"/>', '<closingReroute id="BA"/>',
            '<destProbReroute id="BC"/>', '<destProbReroute id="BA"/>',
        )
    }  # fmt: skip
    assert len(hashes) == 5


def devices_of(file: DemandFile) -> list[tuple[bool, int]]:
    orders = file.draw(KEY)
    return list(zip(orders["reroute"].tolist(), orders["reroute_period_ms"].tolist(), strict=True))


def params(**said: str) -> str:
    return "".join(
        f'<param key="{"has" if key == "has" else "device"}.rerouting.'
        f'{"device" if key == "has" else key}" value="{value}"/>'
        for key, value in said.items()
    )


@pytest.mark.parametrize(
    ("of_type", "of_vehicle", "found"),
    [
        ("", "", (False, 0)),
        (params(has="true", period="30"), "", (True, 30_000)),
        (params(has="true", period="30"), params(period="1:00:00"), (True, 3_600_000)),
        (params(has="true"), params(has="false"), (False, 0)),
        (params(probability="1"), params(probability="0"), (False, 0)),
        ("", params(probability="1", period="12.5"), (True, 12_500)),
    ],
)
def test_settings_of_a_vehicle_override_those_of_its_type(
    demand: Reader, of_type: str, of_vehicle: str, found: tuple[bool, int]
) -> None:
    route = '<route edges="AB BC"/>'
    file = demand(
        f'<vType id="t">{of_type}</vType>'
        f'<vehicle id="a" type="t" depart="0">{route}{of_vehicle}</vehicle>'
    )
    assert devices_of(file) == [found]
    assert file.may_look or not found[0]


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (params(period="-5"), "negative time device.rerouting.period='-5'"),
        (params(period="soon"), "device.rerouting.period='soon'"),
        (params(probability="1.5"), "device.rerouting.probability='1.5'"),
        (params(has="maybe"), "has.rerouting.device='maybe'"),
    ],
)
@pytest.mark.parametrize("where", ["vType", "vehicle"])
def test_invalid_devices_are_refused(demand: Reader, said: str, words: str, where: str) -> None:
    vehicle = CAR if where == "vType" else CAR.replace("</vehicle>", f"{said}</vehicle>")
    body = f'<vType id="t">{said if where == "vType" else ""}</vType>{vehicle}'
    with pytest.raises(DemandError) as caught:
        demand(body)
    assert f"x.rou.xml, line 2: <{where}" in str(caught.value)
    assert words in str(caught.value)


class Config:
    """Writer and reader of a `.sumocfg` with options of the rerouting device."""

    def __init__(self, folder: Path, network: RoadNetwork) -> None:
        self._folder, self._network = folder, network

    def read(self, **options: str) -> DemandFile:
        (self._folder / "x.rou.xml").write_text(f"<routes>{CAR}</routes>", encoding="utf-8")
        lines = "\n".join(
            f'<device.rerouting.{key.replace("_", "-")} value="{value}"/>'
            for key, value in options.items()
        )
        path = self._folder / "run.sumocfg"
        path.write_text(
            f'<configuration><route-files value="x.rou.xml"/>\n{lines}</configuration>',
            encoding="utf-8",
        )
        return read_demand([path], self._network)


@pytest.fixture
def config(town: RoadNetwork, tmp_path: Path) -> Config:
    return Config(tmp_path, town)


def test_a_configuration_applies_to_all_vehicles(config: Config) -> None:
    assert config.read().device == DeviceOptions()
    assert not config.read().may_look
    assert not config.read(probability="-1").may_look
    file = config.read(
        probability="1", period="60", adaptation_steps="18", adaptation_interval="10"
    )
    assert file.device == DeviceOptions(1.0, 60_000, 18, 10_000)
    assert devices_of(file) == [(True, 60_000)]
    assert file.may_look
    assert config.read(adaptation_weight="0").device == DeviceOptions()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"probability": "2"}, "device.rerouting.probability='2'"),
        ({"period": "-1:00:00"}, "device.rerouting.period='-1:00:00'"),
        ({"adaptation_steps": "0"}, "device.rerouting.adaptation-steps='0'"),
        ({"adaptation_interval": "0.5"}, "whole seconds"),
        ({"adaptation_weight": "0.5"}, "adaptation-steps"),
    ],
)
def test_invalid_configurations_are_refused(
    config: Config, options: dict[str, str], words: str
) -> None:
    with pytest.raises(DemandError) as caught:
        config.read(**options)
    assert "run.sumocfg, line 2" in str(caught.value)
    assert words in str(caught.value)
