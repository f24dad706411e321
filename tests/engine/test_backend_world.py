"""Backends of zones: cavmarl's own give the undivided world, another simulator's fits in.

The other is CARLA's client, of which there is a fake alone: `tests/support/carla_shard.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.driving.vehicles import STATE_FIELDS
from cavmarl.engine.backend_world import BackendWorld
from cavmarl.engine.kinematic_shard import KinematicShard
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World, load_world
from cavmarl.shards.shard import Commands
from cavmarl.shards.shard_backend import ShardBackend, VehicleControl
from tests.support.carla_shard import CarlaShard, FakeCarlaWorld
from tests.support.driving import idle, start, suggested

ROOT = Path(__file__).resolve().parents[2]
CLOSED = {"population.mode": "closed", "traffic.origins": [], "traffic.destinations": []}
Make = Callable[[World], ShardBackend]


def world_of(env: str, zones: int) -> World:
    return load_world(env, zones=zones, agents=4, background=14, overrides=CLOSED)


def whole_of(env: str) -> Simulation:
    world = world_of(env, 1)
    whole = Simulation(world.config, world.network, partition=world.partition)
    start(whole, 5)
    return whole


def by_id(vehicles: NDArray[np.void]) -> NDArray[np.void]:
    return vehicles[np.argsort(vehicles["id"])].copy()


def controls_of(whole: Simulation, raw: NDArray[np.float64]) -> dict[int, VehicleControl]:
    rows = whole.division.vehicles(0)
    return {
        int(row["id"]): VehicleControl(*raw[0, row["agent"]].tolist())
        for row in rows
        if row["agent"] >= 0
    }


def assert_same(whole: Simulation, divided: BackendWorld, steps: int) -> None:
    """The divided world goes on as the undivided one does, bit for bit."""
    for step in range(steps):
        raw = suggested(whole)
        controls = controls_of(whole, raw)
        whole.step(Commands(raw, idle(whole).meta_actions))
        for tick in range(whole.config.clock.ticks_per_step):
            divided.step(controls if tick == 0 else {})
        ours, theirs = by_id(whole.division.vehicles(0)), divided.vehicles()
        for name in STATE_FIELDS:
            assert ours[name].tobytes() == theirs[name].tobytes(), (step, name)
        seen = divided.observations()
        assert len(seen) == 4
        for row in ours[ours["agent"] >= 0]:
            expected = whole.outputs.observations[0, row["agent"]]
            np.testing.assert_array_equal(seen[int(row["id"])], expected)


@pytest.mark.parametrize(("env", "zones"), [("ring", 2), ("grid4x4", 4)])
def test_a_world_over_own_backends_is_the_undivided_one(env: str, zones: int) -> None:
    whole, world = whole_of(env), world_of(env, zones)
    backends = [
        KinematicShard(world.config, world.network, world.partition, zone) for zone in range(zones)
    ]
    divided = BackendWorld(world.partition, backends)
    divided.reset(5, whole.division.vehicles(0).copy())
    assert_same(whole, divided, 40)
    saved = [backend.snapshot() for backend in backends]
    other = [
        KinematicShard(world.config, world.network, world.partition, zone) for zone in range(zones)
    ]
    for backend, data in zip(other, saved, strict=True):
        backend.restore(data)
        assert backend.snapshot() == data
    divided.resume(other)
    assert_same(whole, divided, 40)
    assert divided.handed_over > 3


def own_backend(world: World) -> ShardBackend:
    return KinematicShard(world.config, world.network, world.partition, 0)


def carla_backend(world: World) -> ShardBackend:
    return CarlaShard(FakeCarlaWorld(), 0, world.config.clock.sim_dt_s)


@pytest.mark.parametrize("make", [own_backend, carla_backend])
def test_a_backend_does_what_the_protocol_says(make: Make) -> None:
    backend = make(world_of("ring", 2))
    backend.reset(1)
    vehicles = by_id(whole_of("ring").division.vehicles(0))
    own, ghosts = vehicles[:6], vehicles[6:9]
    driven = own["id"][own["agent"] >= 0].tolist()
    backend.spawn(own)
    backend.upsert_ghosts(ghosts)
    backend.apply_controls({driven[0]: VehicleControl(2.0, 0.0)})
    before = backend.read_vehicles()
    assert before["id"].tolist() == own["id"].tolist()
    backend.advance()
    moved = backend.read_vehicles()
    backend.upsert_ghosts(ghosts)  # known ones, where they are now
    assert backend.commit() == 1
    assert backend.read_vehicles().tobytes() == moved.tobytes()
    assert moved["speed"][moved["id"] == driven[0]] > before["speed"][before["id"] == driven[0]]
    assert set(backend.read_sensors()) <= set(driven)

    for wrong in (
        lambda: backend.spawn(own[:1]),
        lambda: backend.spawn(ghosts[:1]),
        lambda: backend.upsert_ghosts(own[:1]),
        lambda: backend.destroy([int(ghosts["id"][0])]),
        lambda: backend.apply_controls({int(ghosts["id"][0]): VehicleControl(0.0, 0.0)}),
    ):
        with pytest.raises(ConfigError, match="vehicle"):
            wrong()
        assert backend.read_vehicles().tobytes() == moved.tobytes()

    backend.remove_ghosts(ghosts["id"].tolist())
    data = backend.snapshot()
    backend.advance()
    backend.commit()
    then = by_id(backend.read_vehicles())
    backend.restore(data)
    backend.apply_controls({driven[0]: VehicleControl(2.0, 0.0)})
    backend.advance()
    assert backend.commit() == 2
    assert by_id(backend.read_vehicles())["x"].tolist() == then["x"].tolist()
    backend.destroy(own["id"].tolist())
    assert len(backend.read_vehicles()) == 0


def test_a_vehicle_goes_from_an_own_zone_to_one_of_another_simulator() -> None:
    world, whole = world_of("ring", 2), whole_of("ring")
    carla = FakeCarlaWorld()
    backends = [own_backend(world), CarlaShard(carla, 1, world.config.clock.sim_dt_s)]
    mixed = BackendWorld(world.partition, backends)
    vehicles = by_id(whole.division.vehicles(0))
    x, y = vehicles["x"], vehicles["y"]
    left, low, right, high = world.partition.arrays.rects[0]
    mixed.reset(5, vehicles[(left <= x) & (x < right) & (low <= y) & (y < high)])
    count = len(mixed.vehicles())
    assert count == len(backends[0].read_vehicles())
    while not mixed.handed_over:
        mixed.step({})
        assert mixed.tick < 600
    (moved,) = backends[1].read_vehicles()["id"].tolist()
    assert len(mixed.vehicles()) == count
    assert moved not in backends[0].read_vehicles()["id"]
    places = [
        (one.transform.location.x, -one.transform.location.y) for one in carla.actors.values()
    ]
    (row,) = backends[1].read_vehicles()
    assert (row["x"], row["y"]) in places
    near = sum(not one.has_physics for one in carla.actors.values())
    assert near == len(carla.actors) - 1  # its ghosts are those that stay


def test_features_that_share_more_than_vehicles_are_refused() -> None:
    world = load_world("ring", zones=2, overrides={"clock.control_latency_ticks": 2})
    with pytest.raises(ConfigError, match="control_latency_ticks"):
        own_backend(world)


def test_each_zone_needs_one_backend() -> None:
    world = world_of("ring", 2)
    with pytest.raises(ConfigError, match="one for each of the 2 zones"):
        BackendWorld(world.partition, [own_backend(world)])


def test_an_invalid_snapshot_is_refused() -> None:
    backend = own_backend(world_of("ring", 2))
    before = backend.snapshot()
    for data in (b"", b"no snapshot", before[:-40], own_backend(world_of("grid4x4", 2)).snapshot()):
        with pytest.raises(MessageError, match="snapshot"):
            backend.restore(data)
    assert backend.snapshot() == before


def test_the_page_s_example_runs() -> None:
    page = (ROOT / "docs" / "guides" / "extending.md").read_text(encoding="utf-8")
    block = re.search(r"```python\n(.*?)```", page.split("## A simulator for zones")[1], re.DOTALL)
    assert block
    names: dict[str, Any] = {}
    exec(compile(block[1], "docs/guides/extending.md", "exec"), names)
    assert names["seen"].size > 0
