"""Rows that go from shard to shard, and rows that leave: who goes, who stays, what lies where."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.kernels import codes
from cavmarl.kernels.arrays import Gate, Worlds
from cavmarl.kernels.exchange import take_ghosts, take_own
from cavmarl.kernels.leaving import drop_ghosts, leave
from cavmarl.roads.zones import ZonePartition
from cavmarl.shard.shard import make_worlds
from cavmarl.shard.vehicles import VEHICLE
from cavmarl.traffic.departures import make_gate
from tests.kernels.builders import vehicles
from tests.kernels.traffic import network
from tests.naive import zones as naive
from tests.partitions import partitions, places

TICKS_PER_STEP = 2


def cars(number: int) -> NDArray[np.void]:
    """Ids from 100 on, each with a speed of its own."""
    ids = 100 + np.arange(number)
    return vehicles([(0.0, 0.0, 0.0)] * number, id=ids, speed=0.5 * ids)


def ids(rows: NDArray[np.void]) -> list[int]:
    return [int(vehicle) for vehicle in rows["id"]]


@given(st.data(), partitions(), st.booleans())
def test_each_vehicle_is_taken_by_one_zone_in_the_given_order(
    data: st.DataObject, partition: ZonePartition, in_place: bool
) -> None:
    xy = data.draw(places(partition))
    everybody = vehicles([(x, y, 0.0) for x, y in xy.tolist()])
    for zone in range(partition.count):
        source = everybody.copy()
        rows = source if in_place else np.zeros_like(source)
        found = take_own(partition.arrays, zone, source, len(source), rows)
        expected = [
            k for k, (x, y) in enumerate(xy.tolist())
            if naive.owners(partition.reaching, x, y) == [zone]
        ]  # fmt: skip
        assert ids(rows[:found]) == expected
        assert (rows[:found] == everybody[expected]).all()


def test_ghosts_are_copied_behind_the_rows_that_are_there() -> None:
    source, rows = cars(5), np.zeros(6, VEHICLE)
    rows["id"] = -1
    take_ghosts(source, np.array([4, 0, 2, 3], np.int32), 1, 3, rows, 2)
    assert ids(rows) == [-1, -1, 100, 102, -1, -1]
    assert rows[3] == source[2]


def world(rows: NDArray[np.void], owned: int) -> tuple[Worlds, Gate]:
    """One world with owned rows and ghosts, and its gate."""
    roads = network("merge")
    worlds = make_worlds(1, len(rows), roads)
    worlds.rows[0] = rows
    worlds.num_owned[0], worlds.num_rows[0], worlds.num_through[0] = owned, len(rows), 1
    return worlds, make_gate(1, len(rows), roads.arrays, VEHICLE)


def test_background_vehicles_leave_when_they_have_arrived() -> None:
    rows = cars(6)
    rows["driver"] = codes.DRIVER_BACKGROUND
    rows["events"] = codes.EVENT_ARRIVED
    rows["events"][1] = codes.EVENT_COLLIDED
    rows["driver"][2] = codes.DRIVER_AGENT
    worlds, gate = world(rows, owned=4)
    leave(gate, worlds, worlds.rows, codes.DRIVER_BACKGROUND, 1)
    assert set(ids(gate.passing[0, : gate.num_passing[0]])) == {100, 103}
    assert (worlds.num_owned[0], worlds.num_rows[0]) == (2, 4)
    assert set(ids(worlds.rows[0, :2])) == {101, 102}
    assert set(ids(worlds.rows[0, 2:4])) == {104, 105}, "ghosts leave where they are owned"


def test_agents_leave_when_their_trip_has_ended_and_they_have_acted() -> None:
    rows = cars(5)
    rows["driver"] = codes.DRIVER_AGENT
    rows["tick"] = 10
    rows["events"][:3] = codes.EVENT_ARRIVED, codes.EVENT_COLLIDED, codes.EVENT_OFF_ROAD
    rows["events"][4] = codes.EVENT_COLLIDED
    rows["departed"][2] = 10 - TICKS_PER_STEP + 1
    worlds, gate = world(rows, owned=5)
    leave(gate, worlds, worlds.rows, codes.DRIVER_AGENT, TICKS_PER_STEP)
    assert set(ids(gate.passing[0, : gate.num_passing[0]])) == {100, 101, 104}
    assert set(ids(worlds.rows[0, : worlds.num_rows[0]])) == {102, 103}


def test_ghosts_of_those_who_left_are_dropped_once() -> None:
    worlds, gate = world(cars(6), owned=2)
    gate.passing[0, :3]["id"] = [105, 102, 999]
    gate.num_passing[0] = 3
    drop_ghosts(gate, worlds, worlds.rows)
    assert (worlds.num_owned[0], worlds.num_rows[0]) == (2, 4)
    assert ids(worlds.rows[0, :2]) == [100, 101]
    assert set(ids(worlds.rows[0, 2:4])) == {103, 104}
