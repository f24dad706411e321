"""Low, medium and high density: the environment `rush` with different numbers of vehicles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import find_settings
from cavmarl.driving.vehicles import STATE_FIELDS
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.suite import load_suite
from cavmarl.verify.equivalence import verify_zones
from cavmarl.zones.partition.zone_statistics import imbalance, zone_statistics
from tests.support.driving import drive, start

LOW, MEDIUM, HIGH = 25, 50, 100
DENSITIES = (LOW, MEDIUM, HIGH)
ZONES = 4
# The fullest of the four zones has at least this share of all vehicles. The imbalance (maximum
# divided by mean) is therefore at least four times this share.
SHARE = 0.6
APPROACH_TICKS = 100
EPISODE = 600  # steps
CITY = "net/Town10HD.net.xml"


def world(
    vehicles: int, seed: int = 0, env: str = "rush", zones: int = ZONES, approach_ticks: int = 2
) -> Simulation:
    config, network, demand, partition = load_world(
        env,
        agents=vehicles,
        background=0,
        zones=zones,
        overrides={"zones.approach_ticks": approach_ticks},
    )
    simulation = Simulation(config, network, demand=demand, partition=partition)
    start(simulation, seed)
    return simulation


def places(simulation: Simulation) -> NDArray[np.float64]:
    rows = simulation.vehicles()
    return np.stack([rows["x"], rows["y"]], axis=1)


def by_id(simulation: Simulation) -> NDArray[np.void]:
    rows = simulation.vehicles()
    return rows[np.argsort(rows["id"])]


def first_minute(simulation: Simulation) -> Iterator[None]:
    for _ in range(EPISODE // 2):
        drive(simulation)
        yield


@pytest.mark.parametrize("seed", [0, 77])
def test_the_first_vehicles_are_the_same_in_all_densities(seed: int) -> None:
    suite = load_suite(find_settings("suite", "density"))
    assert suite.maps == ("rush",)
    assert suite.agents == (*DENSITIES, 200, 400)
    first = by_id(world(LOW, seed))
    assert len(first) == LOW
    for vehicles in suite.agents:
        rows = by_id(world(vehicles, seed))[:LOW]
        for name in STATE_FIELDS:
            np.testing.assert_array_equal(rows[name], first[name], err_msg=name)


@pytest.mark.parametrize("seed", [0, 77])
@pytest.mark.parametrize("vehicles", DENSITIES)
def test_vehicles_that_start_in_one_zone_cause_imbalance(vehicles: int, seed: int) -> None:
    simulation = world(vehicles, seed)
    owned = simulation.zones.loads().owned[:, 0].tolist()
    assert sum(owned) == vehicles
    assert max(owned) >= SHARE * vehicles
    assert imbalance(owned) >= SHARE * ZONES
    found = zone_statistics(simulation.partition, simulation.network, positions=places(simulation))
    assert found.vehicles == tuple(owned)
    assert found.vehicle_imbalance == imbalance(owned)
    anywhere = world(vehicles, seed, env="town").zones.loads().owned[:, 0].tolist()
    assert imbalance(anywhere) < SHARE * ZONES


def test_in_low_density_vehicles_cross_some_border_only_one_at_a_time() -> None:
    simulation = world(LOW)
    at_once: Counter[tuple[int, int]] = Counter()
    for _ in first_minute(simulation):
        assert simulation.zones.loads().owned.sum() == len(simulation.vehicles())
        in_flight = simulation.zones.view().transfers
        at_once |= Counter((transfer.source, transfer.target) for transfer in in_flight)
    assert simulation.migrations >= 1
    assert min(at_once.values()) == 1, "two vehicles crossed at once at every border"


def test_medium_density_has_twice_as_many_vehicle_updates_as_low_density() -> None:
    updates = []
    for vehicles in (LOW, MEDIUM):
        simulation = world(vehicles)
        updates.append(sum(len(simulation.vehicles()) for _ in first_minute(simulation)))
    assert updates[1] == pytest.approx(2 * updates[0], rel=0.05)


def test_high_density_has_many_vehicles_at_borders_at_once() -> None:
    # A vehicle is offered to the next zone 100 ticks (5 s) before it would be there.
    simulation = world(HIGH, zones=9, approach_ticks=APPROACH_TICKS)
    in_flight = []
    for _ in first_minute(simulation):
        in_flight.append(len({transfer.vehicle for transfer in simulation.zones.view().transfers}))
        ids = simulation.vehicles()["id"]
        assert len(set(ids.tolist())) == len(ids), "a vehicle is duplicated"
        stats = simulation.traffic_stats()
        assert stats.departed - stats.arrived - stats.removed == len(ids), "a vehicle is lost"
    assert max(in_flight) >= 10
    assert simulation.migrations >= 50
    (transfers,) = simulation.transfers
    assert len(transfers.rows) == simulation.migrations
    assert all(0 <= row.tick - row.approached for row in transfers.rows), (
        "a transfer was not announced"
    )
    assert {row.forced for row in transfers.rows} == {False}


@pytest.mark.parametrize("vehicles", DENSITIES)
def test_a_divided_city_equals_the_undivided_city(vehicles: int) -> None:
    check_divisions("rush", vehicles, steps=60)


@pytest.mark.parametrize("vehicles", DENSITIES)
def test_a_divided_town_of_carla_equals_the_undivided_town(
    vehicles: int, shared_maps: Path
) -> None:
    # Not all of the 100 agents find room at the start; the others wait.
    check_divisions(
        shared_maps / CITY, vehicles, steps=60, overrides={"population.mode": "respawn"}
    )


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["bisection", "grid", "strips"])
@pytest.mark.parametrize("vehicles", [*DENSITIES, 200, 400])
def test_whole_episodes_of_divided_worlds_equal_undivided_ones_in_all_layouts(
    vehicles: int, layout: str
) -> None:
    check_divisions("rush", vehicles, steps=EPISODE, layout=layout, seed=vehicles)


def check_divisions(env: str | Path, vehicles: int, steps: int, **settings: Any) -> None:
    found = verify_zones(env, (2, ZONES, 9), steps=steps, agents=vehicles, background=0, **settings)
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == steps
    assert sum(result.crossings for result in found.results) > 0
