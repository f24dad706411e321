"""Owners and ghosts of a divided world between its steps."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicles import GHOST_FIELDS, PLACEMENT_FIELDS, STATE_FIELDS
from cavmarl.engine.simulation import Simulation
from cavmarl.handoff import shard_setup as dividing
from cavmarl.ownership.messages import Switch
from cavmarl.zones.kernels.zone_lookup import squared_distance
from tests.support.driving import drive, idle, make_simulation, start

STEPS = 80
HYSTERESIS_M = 2.0


def divided(zones: int = 4, **overrides: Any) -> Simulation:
    simulation = make_simulation(
        "grid4x4",
        mode="respawn",
        agents=4,
        background=60,
        num_worlds=2,
        overrides={"zones.count": zones, "clock.sim_dt_s": 0.1, **overrides},
    )
    start(simulation, seed=1)
    return simulation


def owned(simulation: Simulation, world: int) -> list[NDArray[np.void]]:
    """Return the owned rows of each shard."""
    parts = [shard.worlds for shard in simulation.shards]
    return [worlds.rows[world, : worlds.num_owned[world]] for worlds in parts]


def ghosts(simulation: Simulation, world: int) -> list[NDArray[np.void]]:
    """Return the ghosts of each shard."""
    parts = [shard.worlds for shard in simulation.shards]
    return [
        worlds.rows[world, worlds.num_owned[world] : worlds.num_rows[world]] for worlds in parts
    ]


def test_each_vehicle_has_one_owner_and_a_ghost_in_each_near_zone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dividing, "halo_m", lambda *_: 60.0)  # a zone sees less than the whole map
    simulation = divided(9)
    rects = simulation.partition.reaching
    owners: list[dict[int, int]] = [{}, {}]
    moved = 0
    same = list(GHOST_FIELDS)
    for _ in range(STEPS):
        drive(simulation)
        for world in range(2):
            parts = owned(simulation, world)
            all_rows = {int(row["id"]): row for part in parts for row in part}
            assert len(all_rows) == sum(map(len, parts)) == len(simulation.vehicles(world))
            now = {int(i): zone for zone, part in enumerate(parts) for i in part["id"]}
            moved += sum(now[i] != zone for i, zone in owners[world].items() if i in now)
            owners[world] = now
            for zone, seen in enumerate(ghosts(simulation, world)):
                away = {
                    i: squared_distance(rects, zone, row["x"], row["y"]) ** 0.5
                    for i, row in all_rows.items()
                }
                beyond = HYSTERESIS_M + 0.1 * max(row["speed"] for row in all_rows.values())
                assert max((away[i] for i in now if now[i] == zone), default=0) <= beyond
                near = {i for i, distance in away.items() if distance <= 60.0 and now[i] != zone}
                assert Counter(seen["id"].tolist()) == Counter(near)
                for row in seen:
                    assert row[same] == all_rows[int(row["id"])][same]
    assert moved > 20


def test_a_vehicle_that_enters_a_zone_without_a_ghost_is_an_error() -> None:
    simulation = divided()
    drive(simulation)
    here, there = (int(owned(simulation, 0)[zone]["id"][0]) for zone in (0, 3))
    for shard in simulation.shards:
        shard.worlds.num_rows[:] = shard.worlds.num_owned
    division = simulation.division
    with pytest.raises(ConfigError, match=f"vehicle {here} entered zone 3, which has no ghost"):
        division.changes.hand_over(0, Switch(here, 0, 3, 1, False))
    with pytest.raises(ConfigError, match=f"zone 0 does not own vehicle {there}"):
        division.changes.hand_over(0, Switch(there, 0, 3, 1, False))


def test_a_collision_over_a_border_is_detected_for_both_vehicles() -> None:
    # All agents accelerate without braking, in strips that are only a little longer than a car.
    settings: dict[str, Any] = {
        "mode": "respawn",
        "agents": 40,
        "background": 40,
        "overrides": {"zones.layout": "strips", "clock.ctrl_dt_s": 0.05},
    }
    whole = make_simulation("grid4x4", **settings)
    settings["overrides"] |= {"zones.count": 48, "zones.hysteresis_m": 0.0}
    parts = make_simulation("grid4x4", **settings)
    for simulation in (whole, parts):
        start(simulation, seed=1)
    over_borders = set()
    for _ in range(150):
        commands = idle(whole)
        commands.controls[..., 0] = 3.0
        for simulation in (whole, parts):
            simulation.step(commands)
        touching = {}
        owner = {}
        for zone, part in enumerate(owned(parts, 0)):
            owner |= {int(row["id"]): zone for row in part}
            touching |= {int(row["id"]): int(row["hit"]) for row in part if row["hit"] >= 0}
        for vehicle, other in touching.items():
            assert other in touching
            if touching[other] == vehicle and owner[vehicle] != owner[other]:
                over_borders.add(frozenset((vehicle, other)))
        assert parts.traffic_stats() == whole.traffic_stats()
        for simulation in (whole, parts):
            simulation.retire_agents()
        assert parts.state_hash() == whole.state_hash()
    assert len(over_borders) > 1


def test_all_shards_together_equal_the_undivided_world() -> None:
    whole, parts = divided(1), divided(4)
    for _ in range(5):
        drive(whole)
        drive(parts)
    first, second = whole.worlds, parts.worlds
    for world in range(2):
        rows = [w.rows[world, : w.num_owned[world]] for w in (first, second)]
        one, other = (part[np.argsort(part["id"])] for part in rows)
        assert (one[list(STATE_FIELDS)] == other[list(STATE_FIELDS)]).all()
        assert len(one) == parts.division.running()[world]
    assert set(PLACEMENT_FIELDS).isdisjoint(STATE_FIELDS)


def test_changes_in_the_rows_of_all_shards_return_to_the_shards() -> None:
    simulation = divided()
    drive(simulation)
    for shard in simulation.shards:
        np.copyto(shard.worlds.next_rows, shard.worlds.rows)
    before = [[part.copy() for part in owned(simulation, world)] for world in range(2)]
    with simulation.division.all_next_rows() as all_rows:
        for world in range(2):
            num = all_rows.num_owned[world]
            assert num == len(simulation.vehicles(world))
            rows = all_rows.next_rows[world, :num]
            rows["leg"] += rows["id"] % 3
    for world in range(2):
        for shard, part in zip(simulation.shards, before[world], strict=True):
            after = shard.worlds.next_rows[world, : len(part)]
            part["leg"] += part["id"] % 3
            assert (after == part).all()


def test_a_reset_of_one_world_does_not_change_other_worlds() -> None:
    simulation = divided()
    for _ in range(20):
        drive(simulation)
    hashes = [simulation.state_hash(world) for world in range(2)]
    simulation.reset(np.array([False, True]))
    assert simulation.state_hash(0) == hashes[0]
    assert simulation.state_hash(1) != hashes[1]
    assert simulation.ticks().tolist()[1] == 0
    rects = simulation.partition.reaching
    for zone, part in enumerate(owned(simulation, 1)):
        assert all(squared_distance(rects, zone, row["x"], row["y"]) == 0.0 for row in part)
