"""Exchange of ghosts between the zones of a world, and removal of vehicles that leave.

The twin of the exchange is a slow, plain version in `tests/naive`.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records import codes
from cavmarl.core.records.arrays import DepartureQueue, Worlds, ZoneState
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.shards.shard import make_worlds, make_zone_state
from cavmarl.traffic.departure_queue import make_departure_queue
from cavmarl.traffic.kernels.leaving import drop_ghosts, leave
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ghost_exchange import exchange, gather, note_gathered, take_own
from cavmarl.zones.kernels.ownership_changes import BATCH_SIZE, make_book
from cavmarl.zones.kernels.zone_lookup import Halo
from cavmarl.zones.partition.zone_halo import zone_halo
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.naive import zones as naive
from tests.support.builders import vehicles
from tests.support.partitions import four, partitions, places
from tests.support.traffic import network
from tests.support.zoned import NO_BORDERS, SIDE, exchanged, ghosts_of, zoned_of

TICKS_PER_STEP = 2


def cars(number: int) -> NDArray[np.void]:
    """Return cars with ids from 100 on and different speeds."""
    ids = 100 + np.arange(number)
    return vehicles([(0.0, 0.0, 0.0)] * number, id=ids, speed=0.5 * ids)


def ids(rows: NDArray[np.void]) -> list[int]:
    return [int(vehicle) for vehicle in rows["id"]]


@given(st.data(), partitions(), st.booleans())
def test_each_vehicle_is_taken_by_one_zone_in_unchanged_order(
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
        assert (rows["owner"][:found] == zone).all()
        rows["owner"] = 0
        assert (rows[:found] == everybody[expected]).all()


def spread(data: st.DataObject, partition: ZonePartition) -> list[NDArray[np.void]]:
    """Draw rows of each zone; they may be outside of the zone, because a transfer may be late."""
    parts, next_id = [], 0
    for _ in range(partition.count):
        xy = data.draw(places(partition, size=4))
        rows = vehicles([(x, y, 0.0) for x, y in xy.tolist()])
        rows["id"] = next_id + np.arange(len(rows))
        rows["speed"] = 0.5 * rows["id"]
        next_id += len(rows)
        parts.append(rows)
    return parts


@given(
    st.data(),
    partitions(3),
    st.sampled_from([0.0, 7.5, 30.0, 1000.0]),
    st.sampled_from([0.0, 5.0]),
    st.sampled_from([0.0, 3.0]),
)
def test_exchange_equals_twin(
    data: st.DataObject, partition: ZonePartition, halo_m: float, touching_m: float, border_m: float
) -> None:
    parts = spread(data, partition)
    zoned = exchanged(partition, halo_m, parts, touching_m, Borders(2.0, 1.0, border_m))
    rects = partition.reaching
    for zone, own in enumerate(parts):
        others = [row for other, part in enumerate(parts) for row in part if other != zone]
        ghosts = ghosts_of(zoned, zone)
        assert (zoned.rows[SIDE, zone, 0, : len(own)] == own).all()
        expected = naive.within(rects[zone], halo_m, others)
        assert sorted(ids(ghosts)) == sorted(row["id"] for row in expected)
        for ghost in ghosts:
            assert ghost == next(row for row in others if row["id"] == ghost["id"])
        near = zoned.num_near[zone, 0] - len(own)
        touching = naive.within(rects[zone], min(halo_m, touching_m), others)
        assert sorted(ids(ghosts[:near])) == sorted(row["id"] for row in touching)
        elsewhere = [rect for other, rect in enumerate(rects) if other != zone]
        at_border = {
            row["id"]
            for rect in elsewhere
            for row in naive.within(rect, min(halo_m, border_m), list(own))
        }
        noted = max(zoned.num_border[zone, 0], 0)
        assert ids(own[zoned.border[zone, 0, :noted]]) == sorted(at_border)


@given(
    st.data(),
    partitions(3),
    st.sampled_from([0.0, 7.5, 30.0, 1000.0]),
    st.sampled_from([0.0, 5.0, 40.0]),
    st.sampled_from([0.0, 3.0, 40.0]),
    st.booleans(),
)
def test_gather_gives_the_same_rows_as_exchange(
    data: st.DataObject,
    partition: ZonePartition,
    halo_m: float,
    touching_m: float,
    border_m: float,
    are_noted: bool,
) -> None:
    parts = spread(data, partition)
    borders = Borders(2.0, 1.0, border_m)
    book, other = (make_book(1, sum(map(len, parts)) * partition.count) for _ in range(2))
    expected = exchanged(partition, halo_m, parts, touching_m, borders, book)
    zoned, halo = zoned_of(parts), zone_halo(partition, halo_m)
    if are_noted:
        note_outer(zoned, halo, parts)
    for zone in data.draw(st.permutations(range(partition.count))):
        gather(partition.arrays, halo, touching_m, border_m, zoned, SIDE, zone, 0)
    note_gathered(partition.arrays, borders, zoned, SIDE, other)
    names = ["rows", "num_rows", "num_near", "num_outer"]
    if partition.count > 1:
        names.append("num_border")
        for zone, number in enumerate(expected.num_border[:, 0].tolist()):
            found = zoned.border[zone, 0, :number]
            assert found.tolist() == expected.border[zone, 0, :number].tolist()
    for name in names:
        assert getattr(zoned, name).tobytes() == getattr(expected, name).tobytes(), name
    for name, array in other._asdict().items():
        assert name == "due" or array.tobytes() == getattr(book, name).tobytes(), name


def test_gather_equals_exchange_for_several_batches_of_ghosts() -> None:
    rng, rects = np.random.default_rng(3), four().reaching
    middle = np.array([rects[0, 2], rects[0, 3]])
    xy = middle + rng.uniform(-9.0, 9.0, (6 * BATCH_SIZE, 2))
    rows = vehicles([(x, y, 0.0) for x, y in xy.tolist()], id=np.arange(len(xy)))
    owners = np.array([naive.owners(rects, x, y)[0] for x, y in xy.tolist()])
    parts = [rows[owners == zone] for zone in range(4)]
    borders, halo = Borders(2.0, 1.0, 4.0), zone_halo(four(), 6.0)
    sent, gathered = exchanged(four(), 6.0, parts, 3.0, borders), zoned_of(parts)
    for zone, own in enumerate(parts):
        gather(four().arrays, halo, 3.0, 4.0, gathered, SIDE, zone, 0)
        found = [int(zoned.num_border[zone, 0]) for zoned in (sent, gathered)]
        assert found[0] == found[1] < len(own)
        noted = [zoned.border[zone, 0, : found[0]].tolist() for zoned in (sent, gathered)]
        assert noted[0] == noted[1]
    for name in ("rows", "num_rows", "num_near"):
        assert getattr(sent, name).tobytes() == getattr(gathered, name).tobytes(), name
    assert (sent.num_rows - sent.num_owned).sum() > 4 * BATCH_SIZE, (
        "too few ghosts for several batches"
    )


def note_outer(zoned: ZoneState, halo: Halo, parts: list[NDArray[np.void]]) -> None:
    """Fill `outer`, the list of rows that other zones may see, as `advance` does."""
    for zone, rows in enumerate(parts):
        left, low, right, high = halo.inner[zone]
        x, y = rows["x"], rows["y"]
        outer = np.flatnonzero(~((left < x) & (x < right) & (low < y) & (y < high)))
        note(zoned.outer[zone, 0], rows, outer)
        zoned.num_outer[zone, 0] = len(outer)


def note(noted: NDArray[np.void], rows: NDArray[np.void], places: NDArray[np.int64]) -> None:
    """Write the rows at `places` as OUTER records."""
    noted["row"][: len(places)] = places
    for name in ("x", "y", "s", "speed", "lane", "driver"):
        noted[name][: len(places)] = rows[name][places]


def test_ghosts_have_the_route_steps_of_the_owned_vehicles() -> None:
    """The exchange moves rows: ghosts that can touch owned vehicles precede the other ghosts."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-10.0, 50.0, (40, 2))
    rows = vehicles([(x, y, 0.0) for x, y in xy.tolist()], id=np.arange(len(xy)))
    owners = np.array([naive.owners(four().reaching, x, y)[0] for x, y in xy.tolist()])
    zoned = zoned_of([rows[owners == zone] for zone in range(4)])
    zoned.step_at[:] = -1
    for zone in range(4):
        own = np.flatnonzero(owners == zone)
        zoned.step_at[zone, 0, : len(own)] = 1000 + own
        zoned.step["next"][zone, 0, : len(own)] = own
    book = make_book(1, zoned.rows.shape[-1] * 4)
    exchange(four().arrays, zone_halo(four(), 30.0), 4.0, NO_BORDERS, zoned, SIDE, 0, 1, book)
    assert (zoned.num_owned < zoned.num_near).any()
    assert (zoned.num_near < zoned.num_rows).any()
    for zone in range(4):
        there = zoned.rows[SIDE, zone, 0, : zoned.num_rows[zone, 0]]["id"]
        assert zoned.step_at[zone, 0, : len(there)].tolist() == (1000 + there).tolist()
        assert zoned.step["next"][zone, 0, : len(there)].tolist() == there.tolist()


def test_a_world_of_one_zone_has_no_ghosts() -> None:
    whole = ZonePartition((0.0, 0.0, 9.0, 9.0), np.array([[0.0, 0.0, 9.0, 9.0]]))
    zoned = exchanged(whole, 5.0, [cars(3)], touching_m=5.0)
    assert zoned.num_rows.tolist() == zoned.num_near.tolist() == [[3]]


def test_an_exchange_changes_only_the_ghosts_of_its_world() -> None:
    halo = zone_halo(four(), 5.0)
    zoned = make_zone_state(4, 3, 2)
    zoned.num_rows[:] = 2
    exchange(four().arrays, halo, 1.0, NO_BORDERS, zoned, SIDE, 1, 2, make_book(3, 2))
    assert zoned.num_rows.tolist() == [[2, 0, 2]] * 4


@given(st.data(), partitions(3), st.sampled_from([0.0, 7.5, 30.0]))
def test_an_exchange_with_listed_rows_equals_one_without_lists(
    data: st.DataObject, partition: ZonePartition, halo_m: float
) -> None:
    parts = spread(data, partition)
    borders = Borders(2.0, 1.0, 3.0)
    expected = exchanged(partition, halo_m, parts, 5.0, borders)
    zoned, halo = zoned_of(parts), zone_halo(partition, halo_m)
    note_outer(zoned, halo, parts)
    book = make_book(1, zoned.rows.shape[-1] * partition.count)
    exchange(partition.arrays, halo, 5.0, borders, zoned, SIDE, 0, 1, book)
    for name in ("rows", "num_rows", "num_near", "border", "num_border"):
        assert getattr(zoned, name).tobytes() == getattr(expected, name).tobytes()
    assert partition.count == 1 or (zoned.num_outer == -1).all(), "the lists of outer rows remain"


def test_unlisted_rows_are_not_read() -> None:
    zoned = zoned_of([cars(3)] * 4)
    zoned.num_outer[:] = 0
    halo, book = zone_halo(four(), 50.0), make_book(1, 12)
    exchange(four().arrays, halo, 1.0, NO_BORDERS, zoned, SIDE, 0, 1, book)
    assert zoned.num_rows.tolist() == [[3]] * 4


def world(rows: NDArray[np.void], owned: int) -> tuple[Worlds, DepartureQueue]:
    """Return one world with owned rows and ghosts, and its departure queue."""
    roads = network("merge")
    worlds = make_worlds(1, len(rows), roads)
    worlds.rows[0] = rows
    worlds.num_owned[0], worlds.num_rows[0], worlds.num_through[0] = owned, len(rows), 1
    return worlds, make_departure_queue(1, len(rows), roads.arrays, VEHICLE)


def test_arrived_background_vehicles_leave() -> None:
    rows = cars(6)
    rows["driver"] = codes.DRIVER_BACKGROUND
    rows["events"] = codes.EVENT_ARRIVED
    rows["events"][1] = codes.EVENT_COLLIDED
    rows["driver"][2] = codes.DRIVER_AGENT
    worlds, departures = world(rows, owned=4)
    leave(departures, worlds, worlds.rows, codes.DRIVER_BACKGROUND, 1)
    assert set(ids(departures.passing[0, : departures.num_passing[0]])) == {100, 103}
    assert (worlds.num_owned[0], worlds.num_rows[0]) == (2, 4)
    assert set(ids(worlds.rows[0, :2])) == {101, 102}
    assert set(ids(worlds.rows[0, 2:4])) == {104, 105}, "a ghost was removed"


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=9))
def test_a_leaving_vehicle_is_removed_from_the_list_of_outer_rows(
    fates: list[tuple[bool, bool]],
) -> None:
    rows = cars(len(fates))
    rows["driver"] = codes.DRIVER_BACKGROUND
    rows["x"] = np.arange(len(fates))
    rows["events"] = [codes.EVENT_ARRIVED * arrives for arrives, _ in fates]
    seen = {int(row["id"]) for row, (_, is_seen) in zip(rows, fates, strict=True) if is_seen}
    worlds, departures = world(rows, owned=len(rows))
    note(worlds.outer[0], rows, np.flatnonzero([is_seen for _, is_seen in fates]))
    worlds.num_outer[0] = len(seen)
    leave(departures, worlds, worlds.rows, codes.DRIVER_BACKGROUND, 1)
    left = worlds.rows[0, : worlds.num_owned[0]]
    expected = np.zeros_like(worlds.outer[0])
    places = np.flatnonzero([int(row["id"]) in seen for row in left])
    note(expected, left, places)
    assert worlds.num_outer[0] == len(places)
    assert worlds.outer[0, : len(places)].tolist() == expected[: len(places)].tolist()


def test_agents_leave_when_their_trip_ends_but_not_in_the_step_in_which_they_entered() -> None:
    rows = cars(5)
    rows["driver"] = codes.DRIVER_AGENT
    rows["tick"] = 10
    rows["events"][:3] = codes.EVENT_ARRIVED, codes.EVENT_COLLIDED, codes.EVENT_OFF_ROAD
    rows["events"][4] = codes.EVENT_COLLIDED
    rows["departed"][2] = 10 - TICKS_PER_STEP + 1
    worlds, departures = world(rows, owned=5)
    leave(departures, worlds, worlds.rows, codes.DRIVER_AGENT, TICKS_PER_STEP)
    assert set(ids(departures.passing[0, : departures.num_passing[0]])) == {100, 101, 104}
    assert set(ids(worlds.rows[0, : worlds.num_rows[0]])) == {102, 103}


def test_ghosts_of_vehicles_that_left_are_removed() -> None:
    worlds, departures = world(cars(6), owned=2)
    departures.passing[0, :3]["id"] = [105, 102, 999]
    departures.num_passing[0] = 3
    drop_ghosts(departures, worlds, worlds.rows)
    assert (worlds.num_owned[0], worlds.num_rows[0]) == (2, 4)
    assert ids(worlds.rows[0, :2]) == [100, 101]
    assert set(ids(worlds.rows[0, 2:4])) == {103, 104}
