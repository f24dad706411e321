"""Difficult crossings of borders: many vehicles at once, thin zones, corners, U-turns and resets.

Each test runs a world divided and undivided. After every tick, the hashes must be equal, and no
vehicle may be lost.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.engine.simulation import Simulation
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_layouts import cut_map
from tests.support.borders import bounds_around, cut_at, write_platoon, write_roads
from tests.support.demand_worlds import make
from tests.support.driving import drive, make_simulation, start
from tests.support.rerouting import sumo_binary

MANY = 100
TICK_S = 0.1
SPEED_MPS = 10.0
ONE_TICK = {"clock.sim_dt_s": TICK_S, "clock.ctrl_dt_s": TICK_S}
Build = Callable[[dict[str, Any]], Simulation]


def zones_by_id(simulation: Simulation, world: int = 0) -> dict[int, int]:
    """Return the zone of each vehicle by its id."""
    rows = simulation.vehicles(world)
    places: NDArray[np.float64] = np.stack([rows["x"], rows["y"]], axis=1)
    zones = simulation.partition.zones_of(places)
    return dict(zip(rows["id"].tolist(), zones.tolist(), strict=True))


def start_both(
    build: Build, layout: Path, count: int, **overrides: Any
) -> tuple[Simulation, Simulation]:
    """Return the undivided and the divided world at the start of the same episode."""
    zones = {"zones.layout": str(layout), "zones.count": count}
    pair = build(ONE_TICK | overrides), build(ONE_TICK | zones | overrides)
    for simulation in pair:
        start(simulation, seed=5)
    return pair


def run_both(whole: Simulation, divided: Simulation, ticks: int) -> Iterator[dict[int, int]]:
    """Run both worlds and check that they are equal; yield the zones by vehicle after each tick."""
    for _ in range(ticks):
        drive(whole)
        drive(divided)
        check(whole, divided)
        yield zones_by_id(divided)


def check(whole: Simulation, divided: Simulation) -> None:
    for world in range(whole.num_worlds):
        assert divided.state_hash(world) == whole.state_hash(world)
        assert divided.traffic_stats(world) == whole.traffic_stats(world)
        ids = divided.vehicles(world)["id"]
        assert len(np.unique(ids)) == len(ids) == len(whole.vehicles(world))


@pytest.fixture
def platoon(tmp_path: Path) -> Build:
    """Return a function that makes a world of a hundred parallel roads with a car on each."""
    roads = [((0.0, 4.0 * k), (200.0, 4.0 * k)) for k in range(MANY)]
    net = write_roads(tmp_path / "rows.net.xml", roads, SPEED_MPS)
    cars = write_platoon(tmp_path / "rows.rou.xml", MANY, 40.0, SPEED_MPS)
    return lambda overrides: make(net, [cars], overrides=overrides)


def strips(tmp_path: Path, xs: Sequence[float], ys: Sequence[float] = ()) -> Path:
    return cut_at(tmp_path / "zones.json", (-10.0, -10.0, 210.0, 410.0), xs, ys)


def test_a_hundred_vehicles_cross_a_border_in_the_same_tick(platoon: Build, tmp_path: Path) -> None:
    whole, divided = start_both(platoon, strips(tmp_path, [80.0]), 2)
    before: dict[int, int] = {}
    crossed = []
    for now in run_both(whole, divided, 80):
        crossed.append(sum(zone != before.get(car, zone) for car, zone in now.items()))
        before = now
    assert max(crossed) == sum(crossed) == MANY
    assert divided.zones.loads().owned[:, 0].tolist() == [0, MANY]


def test_a_hundred_vehicles_cross_in_both_directions_in_the_same_tick(tmp_path: Path) -> None:
    ways = [((0.0, 4.0 * k), (160.0, 4.0 * k)) for k in range(MANY)]
    roads = [(b, a) if k % 2 else (a, b) for k, (a, b) in enumerate(ways)]
    net = write_roads(tmp_path / "rows.net.xml", roads, SPEED_MPS)
    cars = write_platoon(tmp_path / "rows.rou.xml", MANY, 60.0, SPEED_MPS)
    whole, divided = start_both(
        lambda overrides: make(net, [cars], overrides=overrides), strips(tmp_path, [80.0]), 2
    )
    starts = zones_by_id(divided)
    *_, ends = run_both(whole, divided, 60)
    assert len(ends) == MANY
    assert sorted(ends.values()).count(0) == MANY // 2
    assert all(ends[car] != zone for car, zone in starts.items())


@pytest.mark.parametrize("side_m", [4.0, 1.5])
def test_vehicles_cross_a_zone_border_in_every_tick(side_m: float, tmp_path: Path) -> None:
    # At 25 m/s and 0.2 s per tick, cars move 5 m per tick. They enter zones of 4 m one by one, and
    # skip some zones of 1.5 m.
    roads = [((0.0, 4.0 * k), (200.0, 4.0 * k)) for k in range(10)]
    net = write_roads(tmp_path / "rows.net.xml", roads, 25.0)
    cars = write_platoon(tmp_path / "rows.rou.xml", 10, 20.0, 25.0)
    cuts = [60.0 + side_m * k for k in range(12)]
    whole, divided = start_both(
        lambda overrides: make(net, [cars], overrides=overrides),
        strips(tmp_path, cuts),
        len(cuts) + 1,
        **{"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 0.2, "zones.hysteresis_m": 0.0},
    )
    visited = [zones[min(zones)] for zones in run_both(whole, divided, 30) if zones]
    steps = np.diff(visited)
    run = np.flatnonzero(steps)
    assert len(run) >= 3
    assert (np.diff(run) == 1).all(), "a car has not changed its zone in every tick"
    assert (steps.max() > 1) == (side_m < 5.0)


def test_vehicles_that_cross_a_corner_of_four_zones_change_nothing(tmp_path: Path) -> None:
    # The diagonal roads lead through the corner, or so close to it that they touch a third zone.
    aside = np.array([-6.0, -3.0, -1.0, 0.0, 1.0, 3.0, 6.0])
    forth = [((20.0 + a, 20.0 - a), (180.0 + a, 180.0 - a)) for a in aside.tolist()]
    roads = [*forth, ((20.0, 180.0), (180.0, 20.0))]
    net = write_roads(tmp_path / "x.net.xml", roads, 14.0)
    cars = write_platoon(tmp_path / "x.rou.xml", len(roads), 60.0, 14.0)
    layout = cut_at(tmp_path / "zones.json", (-10.0, -10.0, 210.0, 210.0), [100.0], [100.0])
    whole, divided = start_both(lambda overrides: make(net, [cars], overrides=overrides), layout, 4)
    visits: dict[int, list[int]] = {}
    for zones in run_both(whole, divided, 90):
        for car, zone in zones.items():
            if visits.setdefault(car, [zone])[-1] != zone:
                visits[car].append(zone)
    ways = list(visits.values())
    assert [0, 3] in ways, "no car crosses the corner in one tick"
    assert [0, 1, 3] in ways
    assert [0, 2, 3] in ways
    assert len(ways) == len(roads)


def test_a_vehicle_that_arrives_on_a_border_is_removed_once(platoon: Build, tmp_path: Path) -> None:
    # The road ends beyond the border but within the hysteresis, so the old zone still owns the cars
    # when they arrive.
    whole, divided = start_both(platoon, strips(tmp_path, [199.0]), 2)
    for _ in run_both(whole, divided, 200):
        pass
    assert whole.traffic_stats().arrived == MANY
    assert divided.traffic_stats().running == 0


@pytest.mark.parametrize("ticks", range(43, 49))
def test_a_reset_close_to_the_tick_of_a_crossing_changes_nothing(
    ticks: int, platoon: Build, tmp_path: Path
) -> None:
    # After 45 ticks, the centres are 2 m beyond the border, which is the hysteresis.
    whole, divided = start_both(platoon, strips(tmp_path, [80.0]), 2)
    for simulation in (whole, divided):
        for _ in range(ticks):
            drive(simulation)
        simulation.reset()
    check(whole, divided)
    *_, zones = run_both(whole, divided, 60)
    assert set(zones.values()) == {1}


def test_each_episode_may_have_another_partition(tmp_path: Path) -> None:
    def build(overrides: dict[str, Any]) -> Simulation:
        return make_simulation(
            "grid4x4", mode="respawn", agents=6, background=60, overrides=ONE_TICK | overrides
        )

    whole = build({})
    start(whole, seed=3)
    network = whole.network
    partitions = [cut_map(network, layout, k) for layout, k in (("grid", 4), ("strips", 9))]
    for episode, partition in enumerate(partitions):
        divided = Simulation(whole.config, network, partition=partition)
        start(divided, seed=3)
        for _ in range(episode):
            divided.reset()
        for _ in run_both(whole, divided, 60):
            pass
        assert divided.migrations > 5
        whole.reset()


TURN_NODES = """<nodes>
  <node id="w" x="0" y="0"/><node id="m" x="100" y="0"/><node id="e" x="200" y="0"/>
</nodes>"""
TURN_EDGES = """<edges>
  <edge id="east" from="w" to="m" numLanes="1" speed="10"/>
  <edge id="on" from="m" to="e" numLanes="1" speed="10"/>
  <edge id="back" from="e" to="m" numLanes="1" speed="10"/>
  <edge id="west" from="m" to="w" numLanes="1" speed="10"/>
</edges>"""
TURN_CARS = """<routes>
  <flow id="f" begin="0" end="60" period="4"><route edges="east on back west east on"/></flow>
</routes>"""


@pytest.mark.parametrize("cut", [97.0, 196.0, 199.5])
def test_u_turns_near_a_border_change_nothing(cut: float, tmp_path: Path) -> None:
    nodes, edges, net = (tmp_path / name for name in ("x.nod.xml", "x.edg.xml", "x.net.xml"))
    nodes.write_text(TURN_NODES, encoding="utf-8")
    edges.write_text(TURN_EDGES, encoding="utf-8")
    command = [sumo_binary("netconvert"), "-n", str(nodes), "-e", str(edges), "-o", str(net)]
    subprocess.run(command, check=True, capture_output=True)
    cars = tmp_path / "x.rou.xml"
    cars.write_text(TURN_CARS, encoding="utf-8")
    layout = cut_at(tmp_path / "zones.json", bounds_around(load_network(net)), [cut])
    whole, divided = start_both(lambda overrides: make(net, [cars], overrides=overrides), layout, 2)
    changes: dict[int, int] = {}
    before: dict[int, int] = {}
    for now in run_both(whole, divided, 900):
        for car, zone in now.items():
            changes[car] = changes.get(car, 0) + (zone != before.get(car, zone))
        before = now
    assert max(changes.values()) >= 2
