"""Traffic metrics of samples whose results are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import find_entry
from cavmarl.core.records.codes import SIGNAL_GREEN_MAJOR, SIGNAL_NONE, SIGNAL_RED
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.evaluate.traffic.junction_locks import STOP_LINE_M
from cavmarl.evaluate.traffic.traffic_metrics import (
    TrafficCounts,
    TrafficMeter,
    TrafficRun,
    headways_s,
)
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network

COUNTS = TrafficCounts(departed=3, waiting=2, arrived=1, mean_delay_s=4.5, teleports=7)


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return read_network(find_entry("grid4x4") / "map" / "map.net.xml")


@pytest.fixture(scope="module")
def link(network: RoadNetwork) -> int:
    """Return a straight link with a signal."""
    straight = (network.links["signal"] >= 0) & (network.links["direction"] == ord("s"))
    return int(np.flatnonzero(straight)[0])


def car(
    network: RoadNetwork, number: int, lane: int, to_end_m: float = 1.0, speed: float = 0.0
) -> NDArray[np.void]:
    """Return a car with its front `to_end_m` before the lane end. Its x avoids overlaps."""
    row = blank_vehicle()
    row["id"] = number
    row["lane"] = lane
    row["s"] = network.lanes["length_m"][lane] - to_end_m - 0.5 * row["length"]
    row["x"] = 10.0 * number
    row["speed"] = speed
    return row


def rows(*cars: NDArray[np.void]) -> NDArray[np.void]:
    return np.concatenate([np.zeros(0, VEHICLE), *cars])


def codes(network: RoadNetwork, letter: int) -> NDArray[np.uint8]:
    shown = np.full(len(network.links), SIGNAL_NONE, np.uint8)
    shown[network.links["signal"] >= 0] = letter
    return shown


def measure(
    network: RoadNetwork, samples: list[NDArray[np.void]], letter: int = SIGNAL_GREEN_MAJOR
) -> TrafficRun:
    meter = TrafficMeter(network)
    for sample in samples:
        meter.see(sample)
        meter.sample(sample, codes(network, letter))
    return meter.result(COUNTS)


def inside(network: RoadNetwork, link: int) -> int:
    """Return the first lane of a link inside its junction."""
    return int(np.flatnonzero(network.lanes["internal"] & (network.lanes["link"] == link))[0])


def test_the_figures_contain_the_counts_of_the_simulator(network: RoadNetwork) -> None:
    figures = measure(network, []).figures
    assert (figures.departed, figures.waiting, figures.arrived) == (3, 2, 1)
    assert (figures.mean_delay_s, figures.teleports) == (4.5, 7)
    assert figures.mean_speed_mps is None
    assert (figures.queue, figures.contacts, figures.longest_lock_s) == (0.0, 0, 0.0)


def test_the_mean_speed_averages_all_vehicles_of_all_samples(
    network: RoadNetwork, link: int
) -> None:
    lane = int(network.links["from_lane"][link])
    fast, slow = (car(network, k, lane, 50.0, speed) for k, speed in ((0, 9.0), (1, 3.0)))
    figures = measure(network, [rows(fast, slow), rows(fast)]).figures
    assert figures.mean_speed_mps == pytest.approx(7.0)


def test_the_queue_counts_vehicles_that_stand_on_lanes_to_a_signal(
    network: RoadNetwork, link: int
) -> None:
    lane = int(network.links["from_lane"][link])
    free = int(np.flatnonzero(~network.lanes["internal"] & (network.lanes["num_links"] == 0))[0])
    queued = rows(
        car(network, 0, lane, 1.0),
        car(network, 1, lane, 40.0, 0.09),
        car(network, 2, lane, 60.0, 0.11),
        car(network, 3, free, 1.0),
    )
    assert measure(network, [queued, rows()]).figures.queue == 1.0


def test_a_contact_counts_once_when_two_vehicles_begin_to_touch(
    network: RoadNetwork, link: int
) -> None:
    lane = int(network.links["from_lane"][link])
    apart = rows(car(network, 0, lane), car(network, 1, lane))
    touching = apart.copy()
    touching["x"] = 0.0, 4.9
    above = touching.copy()
    above["z"] = 0.0, 6.0
    samples = [apart, touching, touching, above, apart, touching]
    assert measure(network, samples).figures.contacts == 2


def test_a_lock_lasts_while_vehicles_wait_and_no_vehicle_passes(
    network: RoadNetwork, link: int
) -> None:
    lane = int(network.links["from_lane"][link])
    into, way = inside(network, link), rows(car(network, 0, lane))
    junction = network.junction_ids[network.edges["to_junction"][network.lanes["edge"][lane]]]
    run = measure(network, [way] * 5 + [rows(car(network, 0, into, speed=3.0))] + [way] * 3)
    assert run.locks_s == {junction: 5.0}
    assert (run.figures.longest_lock_s, run.figures.locked_junction) == (5.0, junction)


def test_a_vehicle_that_stands_inside_a_junction_locks_the_junction_until_it_vanishes(
    network: RoadNetwork, link: int
) -> None:
    stuck = rows(car(network, 0, inside(network, link)))
    lane = int(network.links["from_lane"][link])
    other = car(network, 1, lane)
    assert measure(network, [stuck] * 4, SIGNAL_RED).figures.longest_lock_s == 4.0
    gone = [rows(stuck, other)] * 4 + [rows(other)] * 6
    assert measure(network, gone).figures.longest_lock_s == 5.0


def test_time_at_red_neither_counts_nor_ends_a_lock(network: RoadNetwork, link: int) -> None:
    way = rows(car(network, 0, int(network.links["from_lane"][link])))
    meter = TrafficMeter(network)
    for letter, seconds in ((SIGNAL_GREEN_MAJOR, 3), (SIGNAL_RED, 20), (SIGNAL_GREEN_MAJOR, 4)):
        for _ in range(seconds):
            meter.sample(way, codes(network, letter))
    assert meter.result(COUNTS).figures.longest_lock_s == 7.0


@pytest.mark.parametrize(("to_end_m", "speed"), [(STOP_LINE_M + 0.1, 0.0), (1.0, 0.2)])
def test_moving_vehicles_and_vehicles_far_from_the_line_do_not_wait(
    network: RoadNetwork, link: int, to_end_m: float, speed: float
) -> None:
    way = rows(car(network, 0, int(network.links["from_lane"][link]), to_end_m, speed))
    assert measure(network, [way] * 3).locks_s == {}


def test_flow_and_density_follow_edies_definitions(network: RoadNetwork, link: int) -> None:
    lane = int(network.links["from_lane"][link])
    edge = network.edges[network.lanes["edge"][lane]]
    lane_km = edge["length_m"] * edge["num_lanes"] / 1000.0
    pair = rows(car(network, 0, lane, 20.0, 4.0), car(network, 1, lane, 60.0, 8.0))
    samples = [pair] * 30 + [rows()] * 30 + [pair[:1]] * 15
    found = measure(network, samples).edge_minutes
    assert found["edge"].tolist() == [network.lanes["edge"][lane]] * 2
    assert found["minute"].tolist() == [0, 1]
    assert found["density_per_km"] == pytest.approx([1.0 / lane_km, 1.0 / lane_km])
    assert found["speed_mps"] == pytest.approx([6.0, 4.0])
    assert found["flow_per_h"] == pytest.approx([6.0 * 3.6 / lane_km, 4.0 * 3.6 / lane_km])
    assert found["length_m"] == pytest.approx([edge["length_m"]] * 2)


def test_a_vehicle_off_the_map_counts_only_for_the_mean_speed(network: RoadNetwork) -> None:
    lost = car(network, 0, 0, speed=2.0)
    lost["lane"] = -1
    run = measure(network, [rows(lost)])
    assert run.figures.mean_speed_mps == 2.0
    assert len(run.edge_minutes) == 0


def test_headways_are_measured_between_front_bumpers_on_one_lane(
    network: RoadNetwork, link: int
) -> None:
    lane = int(network.links["from_lane"][link])
    other = int(network.links["to_lane"][link])
    truck = car(network, 2, lane, 20.0, speed=5.0)
    truck["length"] = 10.0
    truck["s"] -= 2.5  # its front stays 20 m before the end of the lane
    found = headways_s(
        rows(
            car(network, 0, lane, 60.0, speed=10.0),  # 40 m behind the truck
            car(network, 1, lane, 5.0, speed=5.0),  # the first vehicle of its lane
            truck,  # 15 m behind the first vehicle
            car(network, 3, lane, 70.0, speed=0.5),  # too slow to follow
            car(network, 4, other, 50.0, speed=9.0),  # alone on its lane
        )
    )
    np.testing.assert_allclose(np.sort(found), [3.0, 4.0])
    assert len(headways_s(rows())) == 0
    far = rows(car(network, 0, lane, 80.0, speed=2.0), car(network, 1, lane, 5.0, speed=2.0))
    assert len(headways_s(far)) == 0, "a vehicle 37.5 s behind another one counts as following"


def test_flow_and_contact_rate_use_the_driven_distance(network: RoadNetwork, link: int) -> None:
    lane = int(network.links["from_lane"][link])
    cars = rows(car(network, 0, lane, 30.0, speed=8.0), car(network, 1, lane, 10.0, speed=12.0))
    figures = measure(network, [cars] * 50).figures
    assert figures.distance_km == pytest.approx(1.0)
    edges = network.edges[~network.edges["internal"]]
    lanes_km = float((edges["length_m"] * edges["num_lanes"]).sum()) / 1000.0
    assert figures.flow_per_h == pytest.approx(1.0 / lanes_km / (50.0 / 3600.0))
    assert figures.median_headway_s == pytest.approx(20.0 / 8.0)
    assert (figures.contacts, figures.contacts_per_1000_km) == (0, 0.0)
    touching = cars.copy()
    touching["x"] = 0.0
    assert measure(network, [touching] * 50).figures.contacts_per_1000_km == pytest.approx(1000.0)
    assert measure(network, []).figures.contacts_per_1000_km is None
