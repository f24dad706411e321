"""Random draws of a demand file depend only on the key and have the given probabilities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import DemandError
from cavmarl.core.math.rng import world_key
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import Choices, read_demand
from cavmarl.traffic.demand.demand_records import (
    LANE_BEST,
    LANE_FIRST,
    POS_BASE,
    POS_GIVEN,
    SPEED_AVERAGE,
    SPEED_GIVEN,
    SPEED_MAX,
    UNTIL_DEPARTURE,
    UNTIL_FLOW,
    Options,
)
from cavmarl.traffic.demand.drawing import departures_ms
from tests.traffic.demand.conftest import Reader

KEY = int(world_key(7, 0, 0))


def test_draws_depend_only_on_the_key(demand: Reader) -> None:
    flows = '<flow id="f" end="900" period="exp(0.5)"><route edges="AB BC"/></flow>'
    flows += '<flow id="g" end="900" probability="0.3"><route edges="AB BC"/></flow>'
    file, again = demand(flows), demand(flows)
    orders = file.draw(KEY)
    assert orders.tobytes() == again.draw(KEY).tobytes()
    assert orders.tobytes() != file.draw(KEY + 1).tobytes()
    early = file.draw(KEY, until_s=300.0)
    assert early.tobytes() == orders[: len(early)].tobytes()
    assert len(early) == np.count_nonzero(orders["depart"] < 300.0)


def test_the_hash_covers_fields_and_not_padding(demand: Reader) -> None:
    file = demand('<flow id="f" end="900" period="9"><route edges="AB BC"/></flow>')
    assert file.routes.dtype.itemsize > sum(file.routes.dtype[k].itemsize for k in range(5))
    routes = np.full(len(file.routes), 0xA5, dtype=np.uint8).repeat(file.routes.dtype.itemsize)
    routes = routes.view(file.routes.dtype)
    for name in file.routes.dtype.names or ():
        routes[name] = file.routes[name]
    assert routes.tobytes() != file.routes.tobytes()
    assert replace(file, routes=routes).content_hash == file.content_hash
    other = file.routes.copy()
    other["num_edges"] += 1
    assert replace(file, routes=other).content_hash != file.content_hash


def test_an_added_flow_does_not_change_the_draws_of_other_flows(demand: Reader) -> None:
    flow = '<flow id="f" end="900" period="exp(0.5)"><route edges="AB BC"/></flow>'
    alone = demand(flow).draw(KEY)
    beside = demand(flow + flow.replace('"f"', '"g"')).draw(KEY)
    assert alone["depart"].tolist() == beside["depart"][beside["element"] == 0].tolist()


@pytest.mark.parametrize("rate", ['period="exp(0.5)"', 'probability="0.5"', 'vehsPerHour="1800"'])
def test_flows_have_their_given_rate(demand: Reader, rate: str) -> None:
    file = demand(f'<flow id="f" end="10000" {rate}><route edges="AB BC"/></flow>')
    orders = file.draw(KEY)
    assert len(orders) == pytest.approx(5000, abs=4 * 5000**0.5)
    assert orders["number"].tolist() == list(range(len(orders)))
    assert file.vehicle_id(orders[3]) == "f.3"


@pytest.mark.parametrize("rate", ['period="2"', 'period="exp(0.5)"', 'probability="0.5"'])
def test_a_departure_at_the_end_of_a_time_span_is_in_the_next_span(
    demand: Reader, rate: str
) -> None:
    file = demand(f'<flow id="f" end="100" {rate}><route edges="AB BC"/></flow>')
    *_, times = departures_ms(file.elements, KEY, 0, 100_000)
    border = int(times[len(times) // 2])
    *_, early = departures_ms(file.elements, KEY, 0, border)
    *_, late = departures_ms(file.elements, KEY, border, 100_000)
    assert early.tolist() + late.tolist() == times.tolist()
    assert late[0] == border


def test_distributions_are_drawn_with_their_weights(demand: Reader) -> None:
    file = demand(
        '<vTypeDistribution id="d"><vType id="a" probability="3"/><vType id="b" probability="1"/>'
        '<vType id="never" probability="0"/></vTypeDistribution>'
        '<route id="x" edges="AB BC"/><route id="y" edges="CB BA"/>'
        '<routeDistribution id="r" routes="x y" probabilities="1 4"/>'
        '<flow id="f" type="d" route="r" end="10000" number="10000"/>'
    )
    orders = file.draw(KEY)
    share = {
        field: np.bincount(orders[field], minlength=2)[:2] / len(orders)
        for field in ("vtype", "route")
    }
    np.testing.assert_allclose(share["vtype"], [0.75, 0.25], atol=0.02)
    np.testing.assert_allclose(share["route"], [0.2, 0.8], atol=0.02)


def test_the_largest_random_number_below_1_picks_an_option_of_its_own_list() -> None:
    choices = Choices([Options((k,), (1.0,)) for k in range(5000)])
    most = np.nextafter(1.0, 0.0)
    picked = choices.pick(np.arange(5000, dtype=np.int32), np.full(5000, most))
    assert picked.tolist() == list(range(5000))


def test_equal_routes_are_stored_once_and_orders_are_sorted(demand: Reader) -> None:
    file = demand(
        '<vehicle id="b" depart="9"><route edges="AB BC" color="red"/></vehicle>'
        '<vehicle id="a" depart="3"><route edges="AB  BC"/></vehicle>'
        '<vehicle id="c" depart="3"><route edges="AB BC"/></vehicle>'
    )
    assert len(file.routes) == 1
    assert [file.vehicle_id(order) for order in file.draw(0)] == ["a", "c", "b"]
    assert sum(tally.count for tally in file.report.tolerated.values()) == 2


def test_the_route_of_a_trip_lists_its_start_its_via_edges_and_its_goal(demand: Reader) -> None:
    file = demand('<trip id="t" depart="0" from="AB" via="BC" to="CB"/>')
    (order,) = file.draw(0)
    route = file.routes[order["route"]]
    assert not route["exact"]
    names = [file.network.edge_ids[edge] for edge in file.route_edges]
    assert names == ["AB", "BC", "CB"]


def test_attributes_of_departure_and_arrival_are_read(demand: Reader) -> None:
    file = demand(
        '<vehicle id="a" depart="0" departLane="1" departPos="-20" departSpeed="max" '
        'arrivalPos="30" speedFactor="1.1"><route edges="AB BC"/></vehicle>'
        '<vehicle id="b" depart="0" departLane="best"><route edges="AB BC"/></vehicle>'
    )
    first, second = file.draw(0)
    network = file.network
    edge = network.edges[network.edge_ids.index("AB")]
    assert network.lane_ids[first["depart_lane"]] == "AB_1"
    assert first["depart_pos_code"] == POS_GIVEN
    assert first["depart_pos"] == pytest.approx(float(edge["length_m"]) - 20.0)
    assert first["depart_speed_code"] == SPEED_MAX
    assert first["arrival_pos"] == 30.0
    assert first["speed_factor"] == 1.1
    assert second["depart_lane"] == LANE_BEST
    assert np.isnan(second["speed_factor"])


def test_stops_of_routes_and_vehicles_are_read(demand: Reader) -> None:
    file = demand(
        '<busStop id="s" lane="BC_0" startPos="10" endPos="30"/>'
        '<route id="r" edges="AB BC"><stop busStop="s" duration="20" until="60"/></route>'
        '<flow id="f" route="r" number="1" end="9">'
        '<stop lane="AB_1" endPos="-50" until="40" parking="true"/></flow>'
        '<vehicle id="a" route="r" depart="0"/>'
    )
    flow, single = file.draw(0)
    stops = file.stops[flow["first_stop"] :][: flow["num_stops"]]
    assert stops["at_edge"].tolist() == [0, 1]
    assert stops["until_from"].tolist() == [UNTIL_FLOW, UNTIL_DEPARTURE]
    assert stops["parking"].tolist() == [True, False]
    assert stops["duration"].tolist() == [0.0, 20.0]
    assert single["num_stops"] == 1
    stop = file.stops[single["first_stop"]]
    assert file.network.lane_ids[stop["lane"]] == "BC_0"
    assert stop["end"] == pytest.approx(30.0)


def test_reroute_chances_are_drawn(demand: Reader) -> None:
    file = demand(
        '<flow id="f" end="4000" number="4000"><route edges="AB BC"/>'
        '<param key="device.rerouting.probability" value="0.25"/></flow>'
    )
    assert file.draw(KEY)["reroute"].mean() == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize(
    ("options", "own", "lane", "speed"),
    [("", "", LANE_BEST, (SPEED_AVERAGE, 0.0)),
     ('<default.departspeed value="max"/><default.departlane value="first"/>', "", LANE_FIRST,
      (SPEED_MAX, 0.0)),
     ('<default.departspeed value="3.5"/>', "", LANE_BEST, (SPEED_GIVEN, 3.5)),
     ('<default.departspeed value="max"/>', 'departSpeed="2"', LANE_BEST, (SPEED_GIVEN, 2.0))],
)  # fmt: skip
def test_default_departure_lanes_and_speeds_come_from_sumo_or_the_configuration(
    town: RoadNetwork, tmp_path: Path, options: str, own: str, lane: int, speed: tuple[int, float]
) -> None:
    car = f'<vehicle id="a" depart="0" {own}><route edges="AB"/></vehicle>'
    (tmp_path / "x.rou.xml").write_text(f"<routes>{car}</routes>", encoding="utf-8")
    path = tmp_path / "run.sumocfg"
    files = '<route-files value="x.rou.xml"/>'
    path.write_text(f"<configuration>{files}{options}</configuration>", encoding="utf-8")
    element = read_demand([path], town).elements[0]
    assert element["depart_lane"] == lane
    assert (element["depart_speed_code"], element["depart_speed"]) == speed


def test_an_invalid_default_departure_speed_is_refused(town: RoadNetwork, tmp_path: Path) -> None:
    path = tmp_path / "run.sumocfg"
    text = '<configuration>\n<default.departspeed value="fast"/></configuration>'
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DemandError, match=r"run\.sumocfg, line 2.*fast"):
        read_demand([path], town)


def test_a_trip_of_od2trips_uses_its_edges_and_ignores_its_zones(demand: Reader) -> None:
    plain = '<trip id="v0" depart="0" from="AB" to="BC" departLane="free" departSpeed="max"'
    file = demand(f'{plain} fromTaz="1" toTaz="2" fromJunction="x"/>')
    assert file.draw(0).tobytes() == demand(f"{plain}/>").draw(0).tobytes()
    assert not file.report.tolerated


STOP = '<stop lane="AB_1" endPos="70" duration="5"/>'


@pytest.mark.parametrize(
    ("word", "stop", "code", "position"),
    [
        ("base", "", POS_BASE, 0.0),
        ("splitFront", "", POS_BASE, 0.0),
        ("random_location", "", POS_BASE, 0.0),
        ("stop", "", POS_BASE, 0.0),
        ("stop", STOP.replace("AB", "BC"), POS_BASE, 0.0),
        ("stop", STOP, POS_GIVEN, 70.0),
    ],
)
def test_departure_positions_follow_sumos_rules(
    demand: Reader, word: str, stop: str, code: int, position: float
) -> None:
    """SUMO 1.28 inserts these vehicles with their fronts at 70 m or at 5.1 m."""
    file = demand(
        f'<vehicle id="a" depart="0" departPos="{word}"><route edges="AB BC"/>{stop}</vehicle>'
    )
    (order,) = file.draw(0)
    assert (order["depart_pos_code"], order["depart_pos"]) == (code, pytest.approx(position))
    if code == POS_GIVEN:
        assert file.network.lane_ids[order["depart_lane"]] == "AB_1"
        assert (order["depart_speed_code"], order["depart_speed"]) == (SPEED_GIVEN, 0.0)


def test_a_vehicle_departs_at_the_stop_of_its_route(demand: Reader) -> None:
    file = demand(
        f'<route id="r" edges="AB BC">{STOP}</route>'
        '<flow id="a" number="2" end="9" departPos="stop" route="r"/>'
    )
    assert file.draw(0)["depart_pos"].tolist() == pytest.approx([70.0, 70.0])


@pytest.mark.parametrize("word", ["random", "center", "20"])
def test_arrival_positions_without_effect_are_counted(demand: Reader, word: str) -> None:
    file = demand(
        f'<vehicle id="a" depart="0" arrivalPos="{word}" arrivalLane="current">'
        '<route edges="AB"/></vehicle>'
    )
    ((what, tally),) = file.report.tolerated.items()
    assert what.startswith("arrivalPos of vehicle has no effect")
    assert tally.count == 1
