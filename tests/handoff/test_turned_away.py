"""`zones.policy: reroute`: vehicles take a way around a zone that does not answer."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.arrays import Gate, RoadArrays, Travel, Worlds
from cavmarl.driving.kernels.lanes.route_following import next_step_of_plan
from cavmarl.engine.simulation import Simulation
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.ownership.transport import Rates
from cavmarl.traffic.found_ways import FoundWays
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.parted import HOLD, PARTED, REROUTE, run
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand

CLOCK = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
HEALED = 300  # ticks: 60 s


def edges_of(roads: RoadArrays, travel: Travel, row: Any) -> list[int]:
    """The edges that a vehicle's way leads along from where it is, to its end."""
    lane, way, found = int(row["lane"]), int(row["way"]), []
    while lane >= 0:
        if not roads.lanes[lane]["internal"]:
            found.append(int(roads.lanes[lane]["edge"]))
        lane, way, _ = next_step_of_plan(roads, travel, lane, way)
    return found


def test_a_new_way_leads_to_the_same_place_and_keeps_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    turned = FoundWays.turn_away
    told = further = 0

    def watched(ways: FoundWays, gate: Gate, worlds: Worlds) -> None:
        nonlocal told, further
        wanted = ways.turned_away[0]
        rows = {int(row["id"]): row for row in worlds.next_rows[0] if int(row["id"]) in wanted}
        roads, travel = ways._roads, ways._travel
        before = {v: (int(row["leg"]), edges_of(roads, travel, row)) for v, row in rows.items()}
        turned(ways, gate, worlds)
        for vehicle, row in rows.items():
            leg, old = before[vehicle]
            if row["leg"] == leg:
                continue
            told += 1
            new = edges_of(roads, travel, row)
            assert new[-1] == old[-1], "it goes where it went"
            assert not wanted[vehicle][new].any()
            assert wanted[vehicle][old].any()
            further += len(new) > len(old)

    monkeypatch.setattr(FoundWays, "turn_away", watched)
    found = run(PARTED, 30, **REROUTE)
    assert told == found.vec.simulation.traffic_stats().rerouted > 10
    assert further > 0


def parted_ways(
    net: Path, files: list[Path], folder: Path, policy: dict[str, Any], faults: Faults
) -> Simulation:
    """A world on two ways, with a zone of its own around the middle of the short one."""
    rects = [
        [-100.0, -100.0, 400.0, 500.0],
        [400.0, 300.0, 600.0, 400.0],
        [400.0, 400.0, 600.0, 500.0],
        [400.0, -100.0, 600.0, 300.0],
        [600.0, -100.0, 1200.0, 500.0],
    ]
    write_zones(
        folder / "zones.json", ZonePartition((-100.0, -100.0, 1200.0, 500.0), np.array(rects))
    )
    overrides = {
        **CLOCK, **policy, "zones.layout": str(folder / "zones.json"), "zones.count": 5,
        "zones.faults": faults.to_json(),
    }  # fmt: skip
    simulation = make(net, files, overrides=overrides)
    start(simulation, seed=1)
    return simulation


def seen_on(simulation: Simulation, seconds: int) -> dict[str, set[int]]:
    """Edge → vehicles that were on it in the next seconds."""
    network, found = simulation.network, defaultdict(set)
    for _ in range(seconds):
        drive(simulation)
        for row in simulation.vehicles():
            found[network.edge_ids[network.lanes["edge"][row["lane"]]]].add(int(row["id"]))
    return found


@pytest.mark.parametrize("device", ["", DEVICE], ids=["none looks for ways", "all do"])
def test_vehicles_of_a_demand_turn_off_before_the_zone(tmp_path: Path, device: str) -> None:
    net = make_map(tmp_path)
    files = write_demand(tmp_path, CARS.format(device=device) + FLOW)
    parted = Faults(messages={"Ack": Rates(drop=1.0)}, until=HEALED)
    held, turned = (parted_ways(net, files, tmp_path, policy, parted) for policy in (HOLD, REROUTE))
    stood, went = seen_on(held, 60), seen_on(turned, 60)
    assert len(went["long1"]) > 5 + len(stood["long1"])
    assert turned.traffic_stats().rerouted >= len(went["long1"])
    assert not (went["narrow"] | stood["narrow"]), "none came through the zone"
    for simulation in (held, turned):
        assert len(seen_on(simulation, 90)["out"]) > 8, "all go on when it is healed"
        stats = simulation.traffic_stats()
        assert stats.departed == stats.running + stats.arrived + stats.removed


def test_a_vehicle_that_has_to_pass_an_edge_stops(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    via = (
        '<flow id="f" type="car" from="in" to="out" via="short" begin="0" end="900" period="3" '
        'departSpeed="max"/>'
    )
    files = write_demand(tmp_path, CARS.format(device="") + via)
    parted = Faults(messages={"Prepare": Rates(drop=1.0)}, until=HEALED)
    simulation = parted_ways(net, files, tmp_path, REROUTE, parted)
    found = seen_on(simulation, 50)
    assert not found["long1"]
    assert simulation.traffic_stats().rerouted == 0
    assert (simulation.vehicles()["speed"] < 0.01).sum() > 2


def test_several_worlds_turn_vehicles_away_each_as_if_alone(tmp_path: Path) -> None:
    """Ways lie in slots of the world's own: the first world of two is the one alone."""
    one, two = (run(PARTED, 20, num_envs=number, **REROUTE) for number in (1, 2))
    assert one.vec.simulation.traffic_stats(0).rerouted > 5
    assert one.hashes == two.hashes
    assert two.vec.simulation.traffic_stats(1).rerouted > 5
