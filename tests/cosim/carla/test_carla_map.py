"""The map for clients equals the network: lanes, spawn points, lights and their states."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pytest

from cavmarl.cosim.carla.carla_map import GREEN, OFF, RED, YELLOW, CarlaMap, make_carla_map
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.exports.opendrive import carla_document, write_opendrive
from cavmarl.maps.exports.opendrive_carla import (
    DEFAULT_ORIGIN,
    LIGHT_TYPE,
    fit_to_carla,
    origin_of,
)
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import SIGNAL_STATES, GeoReference, RoadNetwork


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_network(find_map("grid4x4"))


@pytest.fixture(scope="module")
def carla_map(network: RoadNetwork) -> CarlaMap:
    document = carla_document(find_map("grid4x4"), network)
    return make_carla_map(network, "grid4x4", document, origin_of(network))


@pytest.fixture(scope="module")
def root(carla_map: CarlaMap) -> Element:
    return fromstring(carla_map.document)


def test_each_approach_has_one_signal_of_the_type_that_carla_uses(
    carla_map: CarlaMap, root: Element
) -> None:
    signals = list(root.iter("signal"))
    assert {signal.get("type") for signal in signals} == {LIGHT_TYPE}
    assert sorted(str(one.get("id")) for one in signals) == sorted(
        one.signal_id for one in carla_map.approaches
    )
    for road in root.iter("road"):
        assert len(road.findall("signals/signal")) <= 1


def test_each_junction_names_its_controller(root: Element) -> None:
    controlled = {str(one.get("id")) for one in root.iterfind("controller")}
    named = {str(one.get("id")) for one in root.iterfind("junction/controller")}
    assert named == controlled
    known = {str(one.get("id")) for one in root.iter("signal")}
    assert {str(one.get("signalId")) for one in root.iterfind("controller/control")} == known


def test_long_ids_of_signals_are_replaced() -> None:
    long = "cluster_" + "1234567890_" * 4 + "7"
    root = fromstring(
        '<OpenDRIVE><road id="1"><link><successor elementType="junction" elementId="9"/></link>'
        '<lanes><laneSection><right><lane id="-1" type="driving"/></right></laneSection></lanes>'
        f'<signals><signal id="{long}" orientation="+" dynamic="yes" type="1000011"/></signals>'
        '</road><road id="2"><lanes><laneSection><right><lane id="-1" type="tram"/></right>'
        '</laneSection></lanes><signals><signal id="tram_0" orientation="+" dynamic="yes" '
        'type="1000011"/></signals></road>'
        f'<controller id="c"><control signalId="{long}"/><control signalId="tram_0"/></controller>'
        '<controller id="t"><control signalId="tram_0"/></controller><junction id="9"/></OpenDRIVE>'
    )
    fit_to_carla(root, DEFAULT_ORIGIN)
    (signal,) = root.iter("signal")
    assert (signal.get("id"), signal.get("name")) == ("light_0", long)
    assert [one.get("signalId") for one in root.iter("control")] == ["light_0"]
    assert [one.get("id") for one in root.iterfind("controller")] == ["c"]
    assert [one.get("id") for one in root.iterfind("junction/controller")] == ["c"]


def test_junctions_connect_only_lanes_for_cars() -> None:
    root = fromstring(
        '<OpenDRIVE><road id="1"><lanes><laneSection><right><lane id="-1" type="restricted"/>'
        '<lane id="-2" type="driving"/></right></laneSection></lanes></road><road id="2"><lanes>'
        '<laneSection><right><lane id="-1" type="biking"/></right></laneSection></lanes></road>'
        '<junction id="9"><connection id="0" connectingRoad="1"><laneLink from="-1" to="-1"/>'
        '<laneLink from="-2" to="-2"/></connection><connection id="1" connectingRoad="2">'
        '<laneLink from="-1" to="-1"/></connection></junction></OpenDRIVE>'
    )
    fit_to_carla(root, DEFAULT_ORIGIN)
    (connection,) = root.iter("connection")
    assert connection.get("connectingRoad") == "1"
    assert [link.get("to") for link in connection] == ["-2"]


def test_the_header_has_a_geographic_reference(root: Element) -> None:
    header = root.find("header")
    assert header is not None
    assert header.get("revMinor") == "4"
    place = header.findtext("geoReference", "")
    assert f"+lat_0={DEFAULT_ORIGIN[0]:.9f} +lon_0={DEFAULT_ORIGIN[1]:.9f}" in place


def test_the_origin_of_a_map_with_a_geoid_needs_no_geoid_file(network: RoadNetwork) -> None:
    """The projection of CARLA's towns names a geoid, for which PROJ would need a file."""
    pytest.importorskip("pyproj", reason="needs the extra 'maps'")
    projection = (
        "+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m "
        "+geoidgrids=egm96_15.gtx +vunits=m +no_defs"
    )
    there = replace(network, geo=GeoReference(projection, 0.0, 0.0))
    assert origin_of(there) == pytest.approx((49.0, 8.0))


def test_the_map_file_for_carla_has_the_same_roads(tmp_path: Path) -> None:
    trip = write_opendrive(find_map("grid4x4"), tmp_path / "map.xodr", for_carla=True)
    assert trip.same
    assert trip.read.links == trip.map.links


def test_a_light_is_green_only_if_all_of_its_movements_are_green(
    carla_map: CarlaMap, network: RoadNetwork
) -> None:
    seen = set()
    for number, approach in enumerate(carla_map.approaches):
        program = network.programs[network.signals["program"][approach.signal]]
        for phase in range(program["first_phase"], program["first_phase"] + program["num_phases"]):
            first = int(network.phases["first_state"][phase])
            letters = [
                SIGNAL_STATES[network.phase_states[first + index]] for index in approach.indices
            ]
            state = carla_map.states[number, phase]
            seen.add(int(state))
            assert (state == GREEN) == all(letter in "gG" for letter in letters)
            assert (state == RED) == any(letter in "rus" for letter in letters)
    assert {RED, YELLOW, GREEN} <= seen <= {RED, YELLOW, GREEN, OFF}


def test_the_times_of_a_light_add_up_to_its_cycle(
    carla_map: CarlaMap, network: RoadNetwork
) -> None:
    for approach, times in zip(carla_map.approaches, carla_map.times_s, strict=True):
        program = network.programs[network.signals["program"][approach.signal]]
        assert times.sum() == pytest.approx(program["cycle_s"])
        assert (times > 0.0).all()


def test_spawn_points_are_on_lanes_in_their_direction(
    carla_map: CarlaMap, network: RoadNetwork
) -> None:
    outside = np.flatnonzero(~network.lanes["internal"])
    for pose in carla_map.spawn_points[::10]:
        found = [
            (abs(d), math.degrees(math.atan2(sin, cos)))
            for lane in outside.tolist()
            for s, d, cos, sin in [network.beside(lane, pose.x, -pose.y)]
            if 0.0 < s < network.lanes["length_m"][lane]
        ]
        away, heading = min(found)
        assert away < 0.01
        assert math.remainder(heading + pose.yaw, 360.0) == pytest.approx(0.0, abs=0.1)


def test_every_spawn_point_can_reach_every_other_spawn_point(
    carla_map: CarlaMap, network: RoadNetwork
) -> None:
    """Lanes that lead into the map or out of it have no spawn points."""
    lanes = [
        lane
        for lane in np.flatnonzero(~network.lanes["internal"]).tolist()
        for pose in carla_map.spawn_points
        for s, d, _, _ in [network.beside(lane, pose.x, -pose.y)]
        if abs(d) < 0.5 and 0.0 < s < network.lanes["length_m"][lane]
    ]
    edges = set(network.lanes["edge"][lanes].tolist())
    after = {
        edge: set(
            network.lanes["edge"][
                network.links["to_lane"][network.lanes["edge"][network.links["from_lane"]] == edge]
            ].tolist()
        )
        & edges
        for edge in edges
    }
    assert len(edges) == 48
    for first in edges:
        seen = {first}
        while new := set().union(*(after[edge] for edge in seen)) - seen:
            seen |= new
        assert seen == edges


def test_a_light_stands_at_its_stop_line(carla_map: CarlaMap, network: RoadNetwork) -> None:
    approach = carla_map.approaches[0]
    ends = [network.lane_polyline(lane)[-1] for lane in approach.lanes]
    assert np.hypot(*(np.mean(ends, axis=0)[:2] - (approach.pose.x, -approach.pose.y))) < 0.01
    assert approach.half_width_m == pytest.approx(
        0.5 * network.lanes["width_m"][list(approach.lanes)].sum()
    )
