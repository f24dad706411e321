"""Vehicles search for routes while they drive, as in SUMO, on a map with two routes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import CapacityError
from cavmarl.engine.simulation import Simulation
from cavmarl.traffic import way_search as way_slots
from tests.engine.test_row_order import shuffle_rows
from tests.support.driving import drive, start
from tests.support.rerouting import (
    CARS,
    DEVICE,
    FLOW,
    make_map,
    passed,
    rerouter,
    sumo_passed,
    two_ways,
    write_demand,
)
from tests.support.world import traffic_of

SECONDS = 1200
ONCE = '<param key="has.rerouting.device" value="true"/>'
NONE = '<param key="has.rerouting.device" value="false"/>'
SOME = (
    '<param key="device.rerouting.probability" value="0.5"/>'
    '<param key="device.rerouting.period" value="20"/>'
)
ROUTES = (
    '<route id="near" edges="in short narrow out"/><route id="far" edges="in long1 long2 out"/>'
)
# Sparse traffic: the short route is always faster.
SPARSE = '<flow id="f" type="car" route="near" begin="0" end="900" period="6" departSpeed="max"/>'
CLOSED = '<closingReroute id="narrow"/>'


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_map(tmp_path_factory.mktemp("two"))


def cars(device: str = "") -> str:
    return CARS.format(device=device)


@pytest.mark.parametrize("device", [DEVICE, ONCE, "", NONE])
def test_vehicles_without_a_given_route_choose_their_route_as_in_sumo(
    net: Path, tmp_path: Path, device: str
) -> None:
    body = cars(device) + FLOW
    simulation = two_ways(net, tmp_path, body)
    ours = passed(simulation, SECONDS)
    sumo = sumo_passed(net, write_demand(tmp_path, body), tmp_path)
    assert sumo["long1"] > 60, "the short route was not jammed in SUMO"
    for edge in ("short", "long1", "long2", "out"):
        assert ours[edge] == pytest.approx(sumo[edge], rel=0.15), edge
    stats = simulation.traffic_stats()
    assert stats.rerouted >= ours["long1"]
    assert stats.arrived == stats.departed == 300
    assert stats.contacts == 0


def test_vehicles_with_a_given_route_stay_in_the_jam(net: Path, tmp_path: Path) -> None:
    flow = FLOW.replace('from="in" to="out"', 'route="near"')
    simulation = two_ways(net, tmp_path, cars() + ROUTES + flow)
    assert traffic_of(simulation).rerouting is None
    assert passed(simulation, SECONDS)["long1"] == 0
    assert simulation.traffic_stats().rerouted == 0
    assert simulation.traffic_stats().mean_delay_s > 45.0


def test_vehicles_drive_around_a_closed_edge_as_in_sumo(net: Path, tmp_path: Path) -> None:
    files = cars() + ROUTES + SPARSE, rerouter(CLOSED)
    ours = passed(two_ways(net, tmp_path, *files), SECONDS)
    sumo = sumo_passed(net, write_demand(tmp_path, *files), tmp_path)
    assert 60 < sumo["long1"] < 80
    for edge in ("short", "narrow", "long1", "out"):
        assert ours[edge] == pytest.approx(sumo[edge], rel=0.15), edge


@pytest.mark.parametrize(
    ("inside", "attrs", "least", "most"),
    [
        (CLOSED, 'probability="0.5"', 20, 50),
        (CLOSED, 'probability="0"', 0, 0),
        (CLOSED, 'vTypes="truck"', 0, 0),
        (CLOSED, 'off="true"', 0, 0),
        ('<closingReroute id="narrow" disallow="bus"/>', "", 0, 0),
        ('<closingReroute id="narrow" allow="bus"/>', "", 65, 75),
        ('<closingReroute id="out"/>', "", 0, 0),  # a vehicle without another route continues
        ('<closingReroute id="out"/><destProbReroute id="long2"/>', "", 65, 75),
        ('<destProbReroute id="long2"/>', "", 65, 75),
        ('<destProbReroute id="long2"/><destProbReroute id="keepDestination"/>', "", 22, 48),
        ('<routeProbReroute id="far"/>', "", 65, 75),
        ('<routeProbReroute id="far"/><routeProbReroute id="near" probability="3"/>', "", 8, 30),
    ],
)
def test_rerouters_send_their_vehicles_to_their_goals(
    net: Path, tmp_path: Path, inside: str, attrs: str, least: int, most: int
) -> None:
    types = cars() + '<vType id="truck" vClass="truck"/>'
    simulation = two_ways(net, tmp_path, types + ROUTES + SPARSE, rerouter(inside, attrs))
    found = passed(simulation, SECONDS)
    assert least <= found["long1"] == found["long2"] <= most
    assert simulation.traffic_stats().arrived == 150
    ends = "destProbReroute" in inside
    assert found["out"] == 150 - (found["long1"] if ends else 0)


def test_vehicles_with_a_stop_or_an_edge_to_pass_keep_their_route(
    net: Path, tmp_path: Path
) -> None:
    simulation = two_ways(
        net,
        tmp_path,
        cars() + ROUTES + '<vehicle id="s" type="car" route="near" depart="110">'
        '<stop lane="narrow_0" endPos="30" duration="2"/></vehicle>'
        '<trip id="v" type="car" depart="120" from="in" via="short" to="out"/>'
        '<trip id="t" type="car" depart="130" from="in" to="out"/>',
        rerouter(CLOSED),
    )
    found = passed(simulation, 400)
    assert (found["short"], found["long1"]) == (2, 1)


def jam(net: Path, folder: Path, num_worlds: int = 1) -> Simulation:
    """Make worlds with rerouting devices and a rerouter; the caller resets them first."""
    sometimes = rerouter(CLOSED, 'probability="0.5"', 'begin="90" end="120"')
    body = cars(SOME) + FLOW.replace('period="3"', 'period="exp(0.4)"')
    return two_ways(net, folder, body, sometimes, num_worlds=num_worlds, seed=None)


def test_shuffled_rows_give_the_same_bytes(net: Path, tmp_path: Path) -> None:
    tidy, shuffled = jam(net, tmp_path), jam(net, tmp_path)
    for simulation in (tidy, shuffled):
        start(simulation, seed=5)
    rng = np.random.default_rng(0)
    for second in range(400):
        shuffle_rows(shuffled, rng)
        drive(tidy)
        drive(shuffled)
        if second % 20 == 0:
            assert shuffled.state_hash() == tidy.state_hash(), f"second {second}"
    assert shuffled.state_hash() == tidy.state_hash()
    assert tidy.traffic_stats().rerouted > 10


def test_joint_worlds_equal_single_worlds_and_a_reset_repeats_them(
    net: Path, tmp_path: Path
) -> None:
    together = jam(net, tmp_path, num_worlds=3)
    start(together, seed=9)
    hashes: list[str] = []
    for world in range(3):
        alone = jam(net, tmp_path)
        alone.seed(9, first_world=world)
        alone.reset()
        for _ in range(300):
            drive(alone)
        hashes.append(alone.state_hash())
        assert alone.traffic_stats().rerouted > 10
    for attempt in range(2):
        for _ in range(300):
            drive(together)
        assert [together.state_hash(world) for world in range(3)] == hashes, f"run {attempt}"
        start(together, seed=9)
    assert len(set(hashes)) == 3


def test_a_reset_of_one_world_does_not_change_other_worlds(net: Path, tmp_path: Path) -> None:
    simulation = jam(net, tmp_path, num_worlds=2)
    start(simulation, seed=3)
    for _ in range(200):
        drive(simulation)
    before = simulation.state_hash(1)
    simulation.reset(np.array([True, False]))
    assert simulation.state_hash(1) == before


def test_the_hash_covers_measured_speeds_and_found_routes(net: Path, tmp_path: Path) -> None:
    simulation = jam(net, tmp_path)
    start(simulation, seed=5)
    while simulation.traffic_stats().rerouted < 3:
        drive(simulation)
    before = simulation.state_hash()
    rerouting = traffic_of(simulation).rerouting
    assert rerouting is not None
    past, speed_sums, looks, steps = rerouting.arrays()
    # A vehicle is on the first step of `steps`, so the hash covers that step.
    for array in (past, speed_sums, looks["next"], looks["goal"], steps["to_go"]):
        value = array.reshape(-1)[:1].copy()
        array[(0,) * array.ndim] -= 1
        assert simulation.state_hash() != before
        array[(0,) * array.ndim] = value[0]
    assert simulation.state_hash() == before


def test_memory_does_not_grow_and_slots_are_reused(net: Path, tmp_path: Path) -> None:
    simulation = two_ways(net, tmp_path, cars(DEVICE) + FLOW)
    traffic = traffic_of(simulation)
    assert traffic.slots is not None
    assert traffic.rerouting is not None
    sizes = [array.size for array in (traffic.travel.steps, *traffic.rerouting.arrays())]
    while simulation.traffic_stats().rerouted < 90:
        drive(simulation)
    arrays = (traffic.travel.steps, *traffic.rerouting.arrays())
    assert [array.size for array in arrays] == sizes
    # Fewer slots were written than routes were found, so slots were reused.
    written = (arrays[-1]["to_go"].reshape(-1, traffic.slots.steps) > 0.0).any(axis=1)
    assert 0 < np.count_nonzero(written) < 60


def test_too_many_routes_for_the_memory_are_refused(
    net: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(way_slots, "MAX_STEPS", 100)
    with pytest.raises(CapacityError, match=r"may search for a route.*fewer worlds"):
        two_ways(net, tmp_path, cars(DEVICE) + FLOW)
