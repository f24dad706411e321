"""Invalid demand is refused with its place and a remedy; ignored parts are counted."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from cavmarl.core.errors import CapacityError, DemandError, RouteError
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import read_demand
from tests.traffic.demand.conftest import Reader

CAR = '<vehicle id="a" depart="0"><route edges="AB BC"/></vehicle>'
ROUTE = '<route id="r" edges="AB BC"/>'


def refused(demand: Reader, body: str, *words: str, error: type[Exception] = DemandError) -> None:
    with pytest.raises(error) as caught:
        demand(body)
    message = str(caught.value)
    assert "x.rou.xml, line " in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "attribute",
    [
        'length="0"', 'length="1e9"', 'width="100"', 'accel="1e9"', 'decel="1e-9"', 'tau="1e9"',
        'minGap="1e9"', 'maxSpeed="1e-9"', 'maxSpeed="1e9"', 'probability="-1"', 'length="-1"',
        'length="nan"', 'length="five"', 'length="1_0"', 'width="0"', 'height="-1"', 'decel="-1"',
        'accel="0"', 'accel="1e400"', 'emergencyDecel="0"', 'tau="0"', 'sigma="1.5"',
        'sigma="-0.1"', 'maxSpeed="0"', 'maxSpeed="inf"', 'minGap="-1"', 'speedDev="-1"',
        'speedFactor="-1"', 'speedFactor="3"', 'speedFactor="unif(0.8,1.2)"',
        'speedFactor="normc(1)"', 'vClass="boat"', 'carFollowModel="Foo"',
    ],
)  # fmt: skip
def test_invalid_types_are_refused(demand: Reader, attribute: str) -> None:
    refused(demand, f'<vType id="t" {attribute}/>', "line 2", '<vType id="t">')


@pytest.mark.parametrize(
    "timing",
    [
        'begin="0" end="10"', 'begin="0" end="10" period="2" number="3"',
        'begin="0" end="10" period="2" probability="0.3"', 'begin="5" end="2" period="1"',
        'begin="-5" end="20" period="7"', 'begin="0" end="10" probability="1.2"',
        'begin="0" end="10" period="0"', 'begin="0" end="10" period="exp(0)"',
        'begin="0" end="10" period="exp(x)"', 'begin="0" end="10" vehsPerHour="0"',
        'begin="0" end="10" number="-1"', 'begin="soon" end="10" number="1"',
    ],
)  # fmt: skip
def test_flows_that_sumo_refuses_are_refused(demand: Reader, timing: str) -> None:
    refused(demand, f'{ROUTE}<flow id="f" route="r" {timing}/>', '<flow id="f">')


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<vehicle id="a" depart="-5" route="r"/>', ("negative time",)),
        ('<vehicle id="a" depart="1:0" route="r"/>', ("HH:MM:SS",)),
        ('<vehicle id="a" route="r"/>', ("no depart",)),
        ('<vehicle depart="0" route="r"/>', ("no id",)),
        ('<vehicle id="a" depart="0"/>', ("no route",)),
        (CAR + CAR, ("occurs twice",)),
        (ROUTE, ("line 2", "ids must be unique")),
        ('<vType id="t"/><vTypeDistribution id="t" vTypes="t"/>', ("unique",)),
        ('<vehicle id="a" depart="0" route="q"/>', ("unknown route 'q'", "similar names: r")),
        ('<vehicle id="a" depart="0" route="r" type="t"/>', ("unknown type 't'",)),
        ('<vehicle id="a" depart="0" route="r" departLane="2"/>', ("departLane='2'", "'AB'")),
        ('<vehicle id="a" depart="0" route="r" departPos="middle"/>',
         ("departPos='middle'", "a finite number or base or random")),
        ('<vehicle id="a" depart="0" route="r" departLane="left"/>',
         ("departLane='left'", "or first or random or free or allowed or best")),
        ('<vehicle id="a" depart="0" route="r" departSpeed="-1"/>', ("departSpeed='-1'",)),
        ('<vehicle id="f.1" depart="0" route="r"/><flow id="f" route="r" number="2"/>', ("'f'",)),
        ('<vTypeDistribution id="d"/><vehicle id="a" type="d" depart="0" route="r"/>', ("choose",)),
        ('<vTypeDistribution id="d" vTypes="x"/><vehicle id="a" type="d" depart="0" route="r"/>',
         ("unknown type 'x'",)),
        ('<trip id="a" depart="0" from="AB"/>', ("no to",)),
        ('<trip id="a" depart="0" fromTaz="1" toTaz="2"/>', ("fromTaz", "duarouter")),
        ('<trip id="a" depart="0" from="AB" fromXY="1,2" to="BC"/>', ("fromXY", "duarouter")),
        ('<trip id="a" depart="0" from="AB" to="BC" viaXY="1,2"/>', ("viaXY", "duarouter")),
        ('<vehicle id="a" depart="0"><route edges="AB BC CD"/></vehicle>',
         ("'CD'", "made for this map", "similar names: ")),
        ('<vehicle id="a" depart="0"><route edges="1 2 3 AB"/></vehicle>',
         ("made for this map", "AB")),
        ('<vehicle id="a" depart="0"><route edges=" "/></vehicle>', ("no edges",)),
    ],
)  # fmt: skip
def test_contradictory_attributes_are_refused(
    demand: Reader, body: str, words: tuple[str, ...]
) -> None:
    refused(demand, f"{ROUTE}\n{body}", *words)


@pytest.mark.parametrize(
    ("edges", "words"),
    [
        ("AB BA", ("no connection from edge 'AB' to 'BA'",)),
        ("AB BX", ("'BX' is forbidden for passenger",)),
        ("BC AB", ("no connection from edge 'BC' to 'AB'",)),
    ],
)
def test_routes_that_a_class_cannot_drive_are_refused(
    demand: Reader, edges: str, words: tuple[str, ...]
) -> None:
    body = f'<vehicle id="a" depart="0"><route edges="{edges}"/></vehicle>'
    refused(demand, body, "line 2", "on_bad_route", *words, error=RouteError)


def test_bad_routes_can_be_skipped_and_are_counted(demand: Reader) -> None:
    bad = '<vehicle id="b" depart="0"><route edges="AB BX"/></vehicle>'
    file = demand(bad + CAR, on_bad_route="skip")
    assert file.element_ids == ("a",)
    tally = file.report.tolerated["vehicle or flow that cannot drive its route is left out"]
    assert tally.count == 1
    assert tally.first.endswith("line 2")


def test_allowed_classes_and_vehicles_that_ignore_permissions_may_use_a_restricted_edge(
    demand: Reader,
) -> None:
    types = '<vType id="i" vClass="ignoring"/><vType id="b" vClass="bus"/>'
    cars = "".join(
        f'<vehicle id="{t}" type="{t}" depart="0"><route edges="AB BX"/></vehicle>' for t in "ib"
    )
    assert len(demand(types + cars).draw(0)) == 2


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        ('lane="CB_0" endPos="9" duration="5"', ("off the route",)),
        ('lane="AB_0" endPos="9000" duration="5"', ("friendlyPos",)),
        ('lane="AB_0" startPos="10" endPos="5" duration="5"', ("startPos='10'",)),
        ('lane="AB_7" duration="5"', ("'AB_7'", "similar names: AB_")),
        ('busStop="s" duration="5"', ("unknown busStop 's'",)),
        ('duration="5"', ("no lane",)),
        ('lane="AB_0" duration="-5"', ("negative time",)),
    ],
)
def test_invalid_stops_are_refused(demand: Reader, stop: str, words: tuple[str, ...]) -> None:
    body = f'<vehicle id="a" depart="0"><route edges="AB BC"/>\n<stop {stop}/></vehicle>'
    refused(demand, body, "line 3", *words)


def test_stops_in_the_wrong_order_are_refused(demand: Reader) -> None:
    stops = '<stop lane="BC_0" endPos="9" duration="5"/>\n<stop lane="AB_0" endPos="9" until="5"/>'
    body = f'<vehicle id="a" depart="0"><route edges="AB BC"/>{stops}</vehicle>'
    refused(demand, body, "line 3", "order of the route")


@pytest.mark.parametrize("body", [
    f'{ROUTE}<flow id="f" route="r" begin="0" end="10000" period="0.001"/>',
    f'{ROUTE}<flow id="f" route="r" begin="0" end="10" number="1000000000000"/>',
    f'{ROUTE}<flow id="f" route="r" begin="0" end="10000" period="exp(1000)"/>',
])  # fmt: skip
def test_a_flow_of_over_a_million_vehicles_is_refused(demand: Reader, body: str) -> None:
    with pytest.raises(CapacityError, match=r'line 2: <flow id="f"> makes more than 1000000'):
        demand(body, max_departures=1_000_000)


def test_a_route_with_too_many_repetitions_is_refused(demand: Reader) -> None:
    body = '<vehicle id="a" depart="0"><route edges="AB BC" repeat="99999999999"/></vehicle>'
    refused(demand, body, "repeat", error=CapacityError)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("line 1",)),
        ("<routes>", ("broken XML",)),
        ("<net/>", ("<net>", "not the root")),
        ('<!DOCTYPE r [<!ENTITY a "b">]><routes>&a;</routes>', ("document type",)),
        ('<?xml version="1.0" encoding="foo"?><routes/>', ("UTF-8",)),
    ],
)
def test_files_without_demand_are_refused(
    town: RoadNetwork, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / "x.rou.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DemandError) as caught:
        read_demand([path], town)
    for word in ("x.rou.xml", *words):
        assert word in str(caught.value)


def test_missing_files_and_files_that_include_themselves_are_refused(
    town: RoadNetwork, tmp_path: Path
) -> None:
    with pytest.raises(DemandError, match="cannot be read"):
        read_demand([tmp_path / "none.rou.xml"], town)
    with pytest.raises(DemandError, match=r"name a \.rou\.xml"):
        read_demand([], town)
    path = tmp_path / "a.rou.xml"
    path.write_text('<routes><include href="a.rou.xml"/></routes>', encoding="utf-8")
    with pytest.raises(DemandError, match="include themselves"):
        read_demand([path], town)


def test_included_gzip_files_and_byte_order_marks_are_read(
    town: RoadNetwork, tmp_path: Path
) -> None:
    (tmp_path / "b.rou.xml.gz").write_bytes(gzip.compress(f"<routes>{CAR}</routes>".encode()))
    path = tmp_path / "a.rou.xml"
    head = '\ufeff<?xml version="1.0" encoding="UTF-8"?>'
    text = head + '<routes><include href="b.rou.xml.gz"/></routes>'
    path.write_text(text, encoding="utf-8")
    file = read_demand([path], town)
    assert file.element_ids == ("a",)
    assert [Path(name).name for name in file.report.files] == ["a.rou.xml", "b.rou.xml.gz"]


def test_elements_other_than_demand_are_counted(demand: Reader) -> None:
    file = demand(
        '<person id="p" depart="0"><walk from="AB" to="BC"/></person>'
        '<e1Detector id="e" lane="AB_0" pos="1" file="x"/><foo><vehicle id="inside"/></foo>'
        '<vType id="t" lcStrategic="2" carFollowModel="EIDM" color="red"/>'
        '<vType id="train" vClass="rail"/>'
        '<vehicle id="t" type="train" depart="0"><route edges="AB"/></vehicle>'
        '<vehicle id="w" depart="triggered"><route edges="AB"/></vehicle>' + CAR
    )
    assert file.element_ids == ("a",)
    assert {what: tally.count for what, tally in file.report.tolerated.items()} == {
        "<person> is not read": 1,
        "<e1Detector> is not read": 1,
        "unknown element <foo>": 1,
        "attribute lcStrategic of vType is not modelled": 1,
        "carFollowModel EIDM is treated as IDM": 1,
        "vehicle of a class that drives on no road is left out": 1,
        "vehicle that departs 'triggered' is left out": 1,
    }
    assert "<person> is not read (first: " in file.to_report()


def test_the_number_of_nested_elements_of_a_definition_is_limited(demand: Reader) -> None:
    route = f'<route edges="AB BC">{"<param/>" * 999}</route>'
    body = (
        f'<vehicle id="a" depart="0"><routeDistribution>{route * 101}</routeDistribution></vehicle>'
    )
    refused(demand, body, '<vehicle id="a">', "contains more than 100000 elements", "split it")
